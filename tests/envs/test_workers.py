"""Workers that end in unusual ways: learning ends with an error that names the cause, and nothing hangs."""

import itertools
import threading

import numpy as np
import pytest
from callbacks import At
from environments import Corridor, Faulty
from gymnasium.vector import AsyncVectorEnv
from models import both, make
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_reinforce import GymnasiumVecEnv

# Python warns of fork beside threads; here it is what is tested
pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
KILLED = "was killed by SIGKILL"


def faulty(**fault):
    """Three environments, of which the second has a fault."""
    truncate = fault.get("truncate", False)
    return [lambda: Faulty(truncate=truncate), lambda: Faulty(**fault), lambda: Faulty(truncate=truncate)]


@pytest.fixture
def workers():
    """Starts workers; a watchdog kills them if a test hangs."""
    started = []

    def start(env_fns, start_method="fork", cls=SubprocVecEnv):
        started.append(cls(env_fns, start_method=start_method))
        return started[-1]

    def kill():
        for env in started:
            for process in env.processes:
                process.kill()
                process.join()

    watchdog = threading.Timer(120, kill)
    watchdog.start()
    yield start
    watchdog.cancel()
    kill()


def kill_worker(model):
    process = model.get_env().unwrapped.processes[1]
    process.kill()
    process.join()


FAULTS = {
    "raise in step": "ended with exit code 1",
    "raise in reset": "ended with exit code 1",
    "die in step": KILLED,
    "die in reset": KILLED,
    "between two steps": KILLED,
}
# Workers that are not forked import PyTorch, which takes seconds: one case of each start method
DEATHS = [
    *itertools.product(["episodes", "search"], ["fork"], FAULTS),
    ("search", "forkserver", "die in step"),
    pytest.param("episodes", "spawn", "raise in step", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("kind", "start_method", "fault"), DEATHS)
def test_a_worker_that_dies_is_named(kind, start_method, fault, workers, tmp_path):
    """Also with fork, where the other workers hold its pipe open and a plain step would wait for ever."""
    env = workers(faulty(fault=fault, at=2), start_method)
    model = make(kind, env, **({"common_random_numbers": True} if kind == "search" else {}))
    with pytest.raises(ConnectionError, match=f"worker of environment 1 died: it {FAULTS[fault]}"):
        model.learn(10_000, callback=At(20, kill_worker) if fault == "between two steps" else None)
    env.close()
    assert all(not process.is_alive() for process in env.processes)
    model.save(tmp_path / "model")
    model.set_env(DummyVecEnv([Faulty] * 3))
    assert model.learn(32).num_timesteps >= 32


class Own(SubprocVecEnv):
    """A user's subclass."""


def test_a_worker_of_a_subclass_dies(workers):
    env = workers([Faulty, Faulty, lambda: Faulty("die in step", at=5)], cls=Own)
    with pytest.raises(ConnectionError, match=f"environment 2 died: it {KILLED}"):
        make("steps", env).learn(100)


def test_the_only_worker_dies(workers):
    """No other worker holds its end of the pipe open then."""
    env = workers([lambda: Faulty("die in step", at=2)])
    with pytest.raises(ConnectionError, match=f"worker of environment 0 died: it {KILLED}"):
        make("steps", env).learn(24)
    env.close()
    assert env.closed


def test_a_worker_that_died_between_two_runs(workers):
    """The plain VecEnv would wait for ever in its reset, and in a call of a callback."""
    env = workers(faulty())
    model = make("steps", env).learn(24)
    env.processes[1].kill()
    for call in (lambda: model.learn(24), env.reset, lambda: env.get_attr("n_steps")):
        with pytest.raises(ConnectionError, match=f"worker of environment 1 died: it {KILLED}"):
            call()


@pytest.mark.parametrize("fault", [("raise in step", 3), ("first observation", 1, np.zeros(2))], ids=str)
def test_environments_that_fail_together_can_be_closed(fault, workers):
    env = workers([lambda: Faulty(*fault)] * 3)
    with pytest.raises((ConnectionError, ValueError), match=r"environment 0 (died|must have shape \(7,\))"):
        make("steps", env).learn(100)
    env.close()
    assert env.closed and not any(process.is_alive() for process in env.processes)


class OneWorker(SubprocVecEnv):
    """A user's class, with several environments behind one pipe."""

    def __init__(self, env_fns):
        super().__init__(env_fns[:1], start_method="fork")
        self.envs = DummyVecEnv(env_fns)
        self.num_envs = len(env_fns)

    def step_async(self, actions):
        self.envs.step_async(actions)

    def step_wait(self):
        return self.envs.step_wait()

    def reset(self):
        return self.envs.reset()


@pytest.mark.parametrize("kind", ["episodes", "search"])
def test_several_environments_behind_one_pipe(kind):
    env = OneWorker([Corridor] * 3)
    try:
        assert make(kind, env).learn(30).num_timesteps >= 30
    finally:
        env.close()


class TwoArguments(Exception):
    """Cannot be unpickled: its message has only the first argument."""

    def __init__(self, first, second):
        super().__init__(first)


def test_an_answer_that_cannot_be_unpickled_is_not_waited_for_again(workers):
    env = workers(faulty(fault="observation", at=3, value=TwoArguments("one", "two")))
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        make("steps", env).learn(100)
    env.close()
    assert env.closed


@pytest.mark.parametrize(
    ("fault", "step", "what"),
    [
        (dict(fault="observation", at=5), 4, "observation of environment 1 must"),
        (dict(fault="observation", at=7, truncate=True), 6, "observation of environment 1 must"),
        (dict(fault="first observation", at=2), 6, "observation of environment 1 must"),
        (dict(fault="reward", at=5), 4, "reward of environment 1 must be a number"),
    ],
)
def test_malformed_observations_and_rewards_are_named(fault, step, what, workers):
    model = make("steps", VecNormalize(workers(faulty(value=np.zeros(8), **fault))))
    with pytest.raises(ValueError, match=rf"{what}.*\(num_timesteps={3 * step}\)"):
        model.learn(400)


def test_rewards_that_are_arrays_of_one_number(workers):
    env = VecNormalize(workers([lambda: Corridor((7,), reward=lambda t, action: np.ones(1))] * 3))
    make("steps", env).learn(100)
    assert env.ret_rms.mean.shape == () and env.returns.shape == (3,)


@both
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_an_interrupted_step(number, kind, workers):
    """Its unread answers are not taken for those to the next question."""
    env = workers(faulty(fault=number, at=20))
    model = make(kind, env)
    with pytest.raises(KeyboardInterrupt):
        model.learn(400)
    before, n_steps = env.get_attr("n_steps"), model.num_timesteps
    model.learn(90, reset_num_timesteps=False)
    made = [after - each for after, each in zip(env.get_attr("n_steps"), before, strict=True)]
    assert made == [(model.num_timesteps - n_steps) // 3] * 3


@pytest.mark.parametrize(
    ("kind", "fault", "at", "mode"),
    [
        ("steps", "SIGTERM", 20, "SameStep"),
        ("steps", "SIGINT", 20, "Disabled"),
        ("steps", "SIGTERM in reset", 1, "SameStep"),
        # After an episode
        ("steps", "SIGTERM in reset", 2, "SameStep"),
        ("steps", "SIGTERM in reset", 2, "Disabled"),
        # By env_method, with a seed
        ("search", "SIGTERM in reset", 3, "Disabled"),
        ("steps", "SIGTERM in a callback", 0, "SameStep"),
    ],
)
def test_an_interrupted_call_of_gymnasiums_processes(kind, fault, at, mode):
    """It is finished first: what its processes have answered could not be told from their later answers."""
    envs = AsyncVectorEnv(faulty(fault=fault, at=at), context="fork", autoreset_mode=mode)
    watchdog = threading.Timer(120, lambda: [process.kill() for process in envs.processes])
    watchdog.start()
    try:
        model = make(kind, GymnasiumVecEnv(envs), **({"common_random_numbers": True} if kind == "search" else {}))
        with pytest.raises(KeyboardInterrupt):
            model.learn(400, At(9, lambda model: model.env.env_method("go_wrong", "a callback")))
        before, n_steps = envs.get_attr("n_steps"), model.num_timesteps
        model.learn(90, reset_num_timesteps=False)
        made = [after - each for after, each in zip(envs.get_attr("n_steps"), before, strict=True)]
        assert made == [(model.num_timesteps - n_steps) // 3] * 3
    finally:
        watchdog.cancel()
        envs.close(terminate=True)


def test_workers_are_closed_after_an_interrupted_step(workers):
    env = workers(faulty(fault="SIGTERM", at=5))
    with pytest.raises(KeyboardInterrupt):
        make("steps", env).learn(400)
    env.close()
    assert [process.exitcode for process in env.processes] == [0, 0, 0]
