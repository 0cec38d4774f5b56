"""Worker processes of a ``SubprocVecEnv``: a dead one is named, with its exception, instead of being waited for."""

import shutil
import signal
import traceback
import weakref
from multiprocessing.connection import wait
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from stable_baselines3.common.vec_env import SubprocVecEnv


class Watched:
    """
    The learner's end of the pipe to a worker, which raises an error when the worker has died.

    A plain one may never return: with ``start_method="fork"`` the other workers hold the dead one's end of the pipe
    open.

    :param remote: The plain end of the pipe
    :param process: The worker
    :param env: The number of its environment
    :param note: A file in which the worker tells about its end
    """

    def __init__(self, remote: Any, process: Any, env: int, note: Path):
        self.remote, self.process, self.env, self.note = remote, process, env, note

    def send(self, message: Any) -> None:
        """
        Send a message to the worker.

        :param message: Anything that can be pickled
        :raises ConnectionError: If the worker is dead
        """
        try:
            self.remote.send(message)
        except ConnectionError as error:
            raise self.died() from error

    def recv(self) -> Any:
        """
        What the worker answers.

        :raises ConnectionError: If it dies instead
        """
        try:
            if self.remote not in wait([self.remote, self.process.sentinel]):
                raise EOFError
            return self.remote.recv()
        except (EOFError, ConnectionError) as error:
            raise self.died() from error

    def died(self) -> ConnectionError:
        """The error that tells how the worker died."""
        # A pipe may close a moment before its process is gone
        self.process.join(timeout=5)
        code = self.process.exitcode
        if self.note.exists():
            end = f"raised {self.note.read_text(encoding='utf-8')}"
        elif code is not None and code < 0:
            end = f"was killed by {signal.Signals(-code).name}"
        else:
            end = f"ended with exit code {code}"
        return ConnectionError(f"The worker of environment {self.env} died: it {end}")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.remote, name)


class Question(str):
    """
    The name of an attribute, to ask a worker for. As soon as the worker has read it, it will note its last exception.

    Only so can this be asked for: the worker of a ``SubprocVecEnv`` prints its exception and closes the pipe.

    :param note: The file to note it in
    """

    def __new__(cls, note: Path) -> "Question":
        question = super().__new__(cls, "unwrapped")
        question.note = note
        return question

    note: Path

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
        note.write_text(traceback.format_exc(limit=0).splitlines()[-1], encoding="utf-8")
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
    ends = enumerate(zip(workers.remotes, workers.processes, strict=True))
    workers.remotes = tuple(Watched(remote, process, i, Path(notes, str(i))) for i, (remote, process) in ends)
    for remote in workers.remotes:
        remote.send(("has_attr", Question(remote.note)))
    for remote in workers.remotes:
        remote.recv()
