"""Worker processes of a ``SubprocVecEnv``: a dead one is named instead of being waited for."""

import signal
import weakref
from multiprocessing.connection import wait
from typing import Any

from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_reinforce.common.interruptions import uninterrupted
from sb3_reinforce.envs.checks import as_reward, check_observation


class Pipe:
    """The learner's end of the pipe to the worker of environment ``env``, which names the worker when it dies."""

    # A plain pipe may wait for ever: with start_method="fork" the other workers hold its far end open. Nor does it know
    # whether an answer belongs to an earlier question, whose answer Ctrl-C has left unread.

    def __init__(self, workers: SubprocVecEnv, env: int):
        self.remote: Any = workers.remotes[env]
        self.process: Any = workers.processes[env]
        self.env = env
        # A strong reference would leave the workers of an environment that is dropped to the garbage collector
        self.workers: Any = weakref.proxy(workers)
        self.question = ""

    def send(self, message: tuple[str, Any]) -> None:
        """Send a question, a name and its data, to the worker."""
        is_last = message[0] == "close"
        try:
            if self.question:
                self.answer()
            with uninterrupted:
                self.remote.send(message)
                self.question = "" if is_last else message[0]
        except Exception as error:
            # Closing needs no answer
            if is_last:
                return
            if isinstance(error, ConnectionError):
                raise self.death() from error
            raise

    def recv(self) -> Any:
        """The worker's answer, checked; None where nothing was asked, as by ``close`` after a broken step."""
        question = self.question
        if not question:
            return None
        try:
            answer = self.answer()
            if question in ("step", "reset"):
                check_observation(self.workers.observation_space, answer[0], self.env)
            if question == "step":
                obs, reward, done, info, reset_info = answer
                if done:
                    check_observation(self.workers.observation_space, info["terminal_observation"], self.env)
                answer = obs, as_reward(reward, self.env), done, info, reset_info
            return answer
        except BaseException:
            # Otherwise ``close`` would wait for the others' answers
            self.workers.waiting = False
            raise

    def answer(self) -> Any:
        """The worker's answer, or an error if the worker dies first."""
        try:
            if self.remote not in wait([self.remote, self.process.sentinel]):
                raise EOFError
            with uninterrupted:
                # Also an answer that cannot be unpickled has been read
                self.question = ""
                return self.remote.recv()
        except (EOFError, OSError) as error:
            self.question = ""
            raise self.death() from error

    def death(self) -> ConnectionError:
        """The error that says how the worker died."""
        # A pipe may close a moment before its process ends
        self.process.join(timeout=5)
        code = self.process.exitcode
        is_killed = code is not None and code < 0
        end = f"was killed by {signal.Signals(-code).name}" if is_killed else f"ended with exit code {code}"
        return ConnectionError(f"The worker of environment {self.env} died: it {end}")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.remote, name)


def watch(env: SubprocVecEnv) -> None:
    """From now on, a question to a dead worker raises an error."""
    if not isinstance(env.remotes[0], Pipe):
        env.remotes = tuple(Pipe(env, i) for i in range(env.num_envs))
