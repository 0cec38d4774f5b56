"""Worker processes of a ``SubprocVecEnv``: a dead one is named, with its exception, instead of being waited for."""

import os
import shutil
import signal
import sys
import traceback
import weakref
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_reinforce.common.interruptions import uninterrupted
from sb3_reinforce.envs.checks import as_reward, check_observation


class Watched:
    """
    The learner's end of the pipe to a worker, which raises an error when the worker has died.

    A plain one may never return: with ``start_method="fork"`` the other workers hold the dead one's end of the pipe
    open. Nor does it know whether an answer is that to an earlier question, which Ctrl-C has left in the pipe.

    :param remote: The plain end of the pipe
    :param process: The worker
    :param env: The number of its environment
    :param workers: The environments that it is one of
    :param note: A file in which the worker tells about its end
    """

    def __init__(self, remote: Any, process: Any, env: int, workers: SubprocVecEnv, note: Path):
        self.remote, self.process, self.env, self.note = remote, process, env, note
        # With a reference to its owner, the folder of the notes would wait for the garbage collector
        self.workers: Any = weakref.proxy(workers)
        self.question = ""
        # A worker may die in the middle of an answer that does not fit into the pipe; those of Windows are others
        if hasattr(remote, "_recv"):
            remote._recv = partial(remote._recv, read=self.read)

    def send(self, message: tuple[str, Any]) -> None:
        """
        Send a question to the worker.

        :param message: The question and its data
        :raises ConnectionError: If the worker is dead and is asked for more than its end
        """
        is_last = message[0] == "close"
        try:
            if self.question:
                self.answer()
            with uninterrupted:
                self.remote.send(message)
                self.question = "" if is_last else message[0]
        except Exception as error:
            # Whoever closes does not ask any more what a worker had to say
            if is_last:
                return
            raise (self.died() if isinstance(error, ConnectionError) else error) from error

    def recv(self) -> Any:
        """
        What the worker answers; None where it has not been asked, as by ``close`` after a step that was broken off.

        :raises BadData: If what the environment returned is malformed
        :raises ConnectionError: If it dies instead
        """
        question = self.question
        if not question:
            return None
        try:
            answer = self.answer()
            answer = self.checked(question, answer)
        except BaseException:
            # The others' answers are left to the next question, not to ``close``
            self.workers.waiting = False
            raise
        return answer

    def checked(self, question: str, answer: Any) -> Any:
        """
        Check what the environment returned.

        :param question: What it was asked for
        :param answer: What it answered
        :return: The answer, its reward as a number
        :raises BadData: If that is malformed
        """
        space = self.workers.observation_space
        if question in ("step", "reset"):
            check_observation(space, answer[0], self.env)
        if question == "step":
            obs, reward, done, info, reset_info = answer
            if done:
                check_observation(space, info["terminal_observation"], self.env)
            return obs, as_reward(reward, self.env), done, info, reset_info
        return answer

    def answer(self) -> Any:
        """
        What the worker answers.

        :raises ConnectionError: If it dies instead
        """
        try:
            self.wait()
            with uninterrupted:
                # Even if it cannot be unpickled, it has been read
                self.question = ""
                return self.remote.recv()
        except (EOFError, ConnectionError) as error:
            self.question = ""
            raise self.died() from error

    def wait(self) -> None:
        """
        Wait until there is something to read.

        :raises EOFError: If the worker dies first
        """
        if self.remote not in wait([self.remote, self.process.sentinel]):
            raise EOFError

    def read(self, descriptor: int, size: int) -> bytes:
        """
        ``os.read`` of a part of an answer.

        :param descriptor: The pipe
        :param size: The most bytes to read
        """
        self.wait()
        return os.read(descriptor, size)

    def died(self) -> ConnectionError:
        """The error that tells how the worker died."""
        # A pipe may close a moment before its process is gone
        self.process.join(timeout=5)
        code = self.process.exitcode
        if code is not None and code < 0:
            end = f"was killed by {signal.Signals(-code).name}"
        elif self.note.exists():
            end = f"raised {self.note.read_text(encoding='utf-8')}"
        else:
            end = f"ended with exit code {code}"
        return ConnectionError(f"The worker of environment {self.env} died: it {end}")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.remote, name)


class NoteLastException:
    """
    As soon as a worker has read it, it will note its last exception.

    Only so can this be asked for: the worker of a ``SubprocVecEnv`` prints its exception and closes the pipe.

    :param note: The file to note it in
    """

    def __init__(self, note: Path):
        self.note = note

    def __reduce__(self) -> tuple[Any, tuple[Path]]:
        return note_last_exception, (self.note,)


def note_last_exception(note: Path) -> str:
    """
    Let this process write the exception that ends it to a file, besides printing it.

    :param note: The file
    :return: The name of an attribute that every environment has
    """
    print_exc = traceback.print_exc

    def print_and_note(*args: Any, **kwargs: Any) -> None:
        lines = traceback.format_exception_only(*sys.exc_info()[:2])
        note.write_text("".join(lines).strip(), encoding="utf-8")
        print_exc(*args, **kwargs)

    # What multiprocessing calls with the exception that a process ends with
    traceback.print_exc = print_and_note
    return "unwrapped"


def watch(env: SubprocVecEnv) -> None:
    """
    From now on, whatever is asked of a dead worker raises an error.

    :param env: The environments
    :raises ConnectionError: If a worker is dead
    """
    workers: Any = env
    if all(isinstance(remote, Watched) for remote in workers.remotes):
        return
    notes = mkdtemp(prefix="sb3_reinforce_")
    weakref.finalize(env, shutil.rmtree, notes, ignore_errors=True)
    workers.remotes = tuple(
        Watched(remote, process, i, env, Path(notes, str(i)))
        for i, (remote, process) in enumerate(zip(workers.remotes, workers.processes, strict=True))
    )
    for remote in workers.remotes:
        remote.send(("has_attr", NoteLastException(remote.note)))
    for remote in workers.remotes:
        remote.recv()
