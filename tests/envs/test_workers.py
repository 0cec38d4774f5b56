"""Workers that end in unusual ways: learning ends with an error that names the cause, and nothing hangs."""

import signal
import threading

import numpy as np
import pytest
from environments import Corridor, Faulty
from models import make
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

# Python warns of fork beside threads; here it is what is tested
pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
KILLED = "was killed by SIGKILL"


@pytest.fixture
def workers():
    """Makes three environments, of which the second has a fault; the watchdog kills them where a test hangs."""
    made = []

    def kill():
        for env in made:
            for process in env.processes:
                process.kill()
                process.join()

    def of_three(start_method="fork", env_class=Faulty, **fault):
        truncate = {"truncate": True} if fault.get("truncate") else {}
        env_fns = [lambda: env_class(**truncate), lambda: env_class(**fault), lambda: env_class(**truncate)]
        made.append(SubprocVecEnv(env_fns, start_method=start_method))
        return made[-1]

    watchdog = threading.Timer(120, kill)
    watchdog.start()
    yield of_three
    watchdog.cancel()
    kill()


class Kill(BaseCallback):
    """Kills a worker between two steps."""

    def _on_step(self):
        if self.n_calls == 20:
            process = self.training_env.unwrapped.processes[1]
            process.kill()
            process.join()
        return True


@pytest.mark.parametrize("kind", ["episodes", "search"])
@pytest.mark.parametrize(
    ("start_method", "fault", "end"),
    [
        ("fork", "raise in step", "ended with exit code 1"),
        ("fork", "raise in reset", "ended with exit code 1"),
        ("fork", "die in step", KILLED),
        ("fork", "die in reset", KILLED),
        ("fork", "between two steps", KILLED),
        ("forkserver", "die in step", KILLED),
        ("spawn", "raise in step", "ended with exit code 1"),
    ],
)
def test_a_worker_that_dies_is_named(start_method, fault, end, kind, workers, tmp_path):
    """Also with fork, where the other workers hold its pipe open and a plain step would wait for ever."""
    env = workers(start_method, fault=fault, at=2)
    model = make(kind, env, **({"common_random_numbers": True} if kind == "search" else {}))
    with pytest.raises(ConnectionError, match=f"worker of environment 1 died: it {end}"):
        model.learn(10_000, callback=Kill() if fault == "between two steps" else None)
    env.close()
    assert all(not process.is_alive() for process in env.processes)
    model.save(tmp_path / "model")
    model.set_env(DummyVecEnv([Faulty] * 3))
    assert model.learn(32).num_timesteps >= 32


def test_the_only_worker_dies():
    """Nobody else holds its end of the pipe open then."""
    env = SubprocVecEnv([lambda: Faulty("die in step", at=2)], start_method="fork")
    with pytest.raises(ConnectionError, match=f"worker of environment 0 died: it {KILLED}"):
        make("steps", env).learn(24)
    env.close()
    assert env.closed


def test_a_worker_that_died_between_two_runs(workers):
    """The plain VecEnv would wait for ever in its reset, and in a call of a callback."""
    env = workers()
    model = make("steps", env).learn(24)
    env.processes[1].kill()
    for call in (lambda: model.learn(24), env.reset, lambda: env.get_attr("n_steps")):
        with pytest.raises(ConnectionError, match=f"worker of environment 1 died: it {KILLED}"):
            call()


class Together(Faulty):
    """Every copy has the fault."""

    def __init__(self, **fault):
        super().__init__("raise in step", at=3)


class Short(Faulty):
    """Every observation is too short."""

    def observe(self):
        return super().observe()[:2]


@pytest.mark.parametrize("env_class", [Together, Short])
def test_environments_that_fail_together_can_be_closed(env_class, workers):
    env = workers(env_class=env_class)
    with pytest.raises((ConnectionError, ValueError), match=r"environment 0 (died|must have shape \(7,\))"):
        make("steps", env).learn(100)
    env.close()
    assert env.closed and not any(process.is_alive() for process in env.processes)


class TwoArguments(Exception):
    """Cannot be unpickled: its message has only the first argument."""

    def __init__(self, first, second):
        super().__init__(first)


def test_an_answer_that_cannot_be_unpickled_is_not_waited_for_again(workers):
    env = workers(fault="observation", at=3, value=TwoArguments("one", "two"))
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        make("steps", env).learn(100)
    env.close()
    assert env.closed


@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
@pytest.mark.parametrize("value", [np.zeros(8, np.float32), "x", np.ones(7) * 1j], ids=["long", "string", "complex"])
@pytest.mark.parametrize(
    ("fault", "step"),
    [
        (dict(fault="observation", at=5), 4),
        (dict(fault="observation", at=7, truncate=True), 6),
        (dict(fault="first observation", at=2), 6),
    ],
)
def test_malformed_observations_are_named(fault, step, value, wrapper, workers):
    model = make("steps", wrapper(workers(value=value, **fault)))
    with pytest.raises(ValueError, match=rf"observation of environment 1 must .*\(step {step} since"):
        model.learn(400)


@pytest.mark.parametrize("value", ["x", np.ones(2), 1j], ids=repr)
def test_rewards_that_are_no_numbers_are_named(value, workers):
    with pytest.raises(ValueError, match=r"reward of environment 1 must be a number.*\(step 4 since"):
        make("steps", workers(fault="reward", at=5, value=value)).learn(400)


class ArrayRewards(Corridor):
    """Rewards are arrays of one number."""

    def __init__(self):
        super().__init__((7,), reward=lambda t, action: np.ones(1))


def test_rewards_that_are_arrays_of_one_number(workers):
    env = VecNormalize(workers(env_class=ArrayRewards))
    make("steps", env).learn(100)
    assert env.ret_rms.mean.shape == () and env.returns.shape == (3,)


@pytest.mark.parametrize("kind", ["steps", "search"])
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_a_step_that_is_broken_off(number, kind, workers):
    """The answers that nobody has waited for are not taken for those to what is asked next."""
    env = workers(fault=number, at=20)
    model = make(kind, env)
    with pytest.raises(KeyboardInterrupt):
        model.learn(400)
    before, n_steps = env.get_attr("n_steps"), model.num_timesteps
    model.learn(90, reset_num_timesteps=False)
    made = [after - each for after, each in zip(env.get_attr("n_steps"), before, strict=True)]
    assert made == [(model.num_timesteps - n_steps) // 3] * 3


def test_workers_are_closed_after_a_step_that_is_broken_off(workers):
    env = workers(fault=signal.SIGTERM.name, at=5)
    with pytest.raises(KeyboardInterrupt):
        make("steps", env).learn(400)
    env.close()
    assert [process.exitcode for process in env.processes] == [0, 0, 0]
