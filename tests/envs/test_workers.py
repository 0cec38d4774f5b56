"""Workers that end in unusual ways: learning ends with an error that names the cause, and nothing hangs."""

import os
import signal
import threading
import time
import traceback

import numpy as np
import pytest
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_reinforce import REINFORCE

pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")


class TwoArguments(Exception):
    """Cannot be unpickled: its message does not tell the second argument."""

    def __init__(self, first, second):
        super().__init__(first)


class Odd(Corridor):
    """Does something of its own at the third step."""

    def __init__(self, act, lengths=(7,)):
        super().__init__(lengths)
        self.act, self.n_steps = act, 0

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        return self.act(obs, info) if self.n_steps == 3 else obs, reward, terminated, truncated, info


class Large(Odd):
    """Its observations do not fit into a pipe."""

    def __init__(self, act):
        super().__init__(act)
        self.observation_space = spaces.Box(0, 255, (512, 512), np.uint8)

    def observe(self):
        return np.zeros((512, 512), np.uint8)


@pytest.fixture
def workers():
    """Environments made from functions; they are killed where a test hangs."""
    made = []

    def kill():
        for process in made[0].processes:
            process.kill()

    def make(*functions):
        made.append(SubprocVecEnv(list(functions), start_method="fork"))
        watchdog.start()
        return made[0]

    watchdog = threading.Timer(60, kill)
    yield make
    watchdog.cancel()
    kill()


def learn(env, **kwargs):
    REINFORCE("MlpPolicy", env, n_steps=8, device="cpu", **kwargs).learn(100)


def fail(obs, info):
    raise OSError("the simulator has gone")


def wait(obs, info):
    time.sleep(1)
    return obs


@pytest.mark.parametrize("act", [fail, lambda obs, info: obs[:2]], ids=["raise", "malformed"])
def test_environments_that_fail_together_can_be_closed(act, workers):
    env = workers(*[lambda: Odd(act)] * 4)
    with pytest.raises((ConnectionError, ValueError), match=r"environment 0 (died|must)"):
        learn(env)
    env.close()
    assert env.closed and not any(process.is_alive() for process in env.processes)


def test_an_answer_that_cannot_be_unpickled_is_not_waited_for_again(workers):
    def act(obs, info):
        info["error"] = TwoArguments("one", "two")
        return obs

    env = workers(lambda: Odd(lambda obs, info: obs), lambda: Odd(act))
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        learn(env)
    env.close()
    assert env.closed


def test_a_worker_that_is_killed_in_the_middle_of_an_answer(workers):
    """The first worker holds the second one's end of the pipe open, and the first part of the answer is there."""
    env = workers(lambda: Large(wait), lambda: Large(lambda obs, info: obs))

    def kill():
        while not env.waiting or model.num_timesteps < 4:
            time.sleep(0.01)
        time.sleep(0.5)
        env.processes[1].kill()

    model = REINFORCE("MlpPolicy", env, n_steps=8, device="cpu", policy_kwargs={"net_arch": [2]})
    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(ConnectionError, match="worker of environment 1 died: it was killed by SIGKILL"):
        model.learn(100)
    killer.join()


def test_an_exception_that_was_handled_is_not_taken_for_the_end(workers):
    def act(obs, info):
        try:
            raise ValueError("a hiccup")
        except ValueError:
            traceback.print_exc()
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ConnectionError, match="environment 0 died: it was killed by SIGKILL"):
        learn(workers(lambda: Odd(act)))


def test_the_first_observation_of_a_worker(workers):
    class Short(Odd):
        def observe(self):
            return super().observe()[:2]

    with pytest.raises(ValueError, match=r"observation of environment 1 must have shape \(7,\)"):
        learn(workers(lambda: Odd(wait), lambda: Short(wait)))


def test_rewards_that_are_arrays_of_one_number(workers):
    env = VecNormalize(workers(*[lambda: Corridor((7,), reward=lambda t, action: np.ones(1))] * 3))
    learn(env)
    assert env.ret_rms.mean.shape == () and env.returns.shape == (3,)


def raise_lines(obs, info):
    raise RuntimeError("first line\nsecond line\n")


def test_the_whole_of_a_workers_exception_is_told(workers):
    with pytest.raises(ConnectionError, match=r"RuntimeError: first line\nsecond line$"):
        learn(workers(lambda: Odd(raise_lines)))
