"""A DummyVecEnv stepped without its copies returns what its own ``step`` returns."""

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_reinforce.envs.stepping import step_in_turn, stepper

SPACES = {
    "box": spaces.Box(-1, 1, (2, 3)),
    "image": spaces.Box(0, 255, (4, 4, 1), dtype=np.uint8),
    "discrete": spaces.Discrete(5),
    "binary": spaces.MultiBinary(3),
    "dict": spaces.Dict(vector=spaces.Box(-1, 1, (2,)), choice=spaces.Discrete(3)),
}


class Drawn(gym.Env[Any, Any]):
    """Observations, rewards and ends are drawn; one and the same info is returned at every step."""

    def __init__(self, observation_space: spaces.Space[Any]):
        self.observation_space, self.action_space = deepcopy(observation_space), spaces.Box(-1, 1, (2,))
        self.info = {"steps": 0}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {"drawn": float(self.np_random.random())}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.info["steps"] += 1
        terminated, truncated = (self.np_random.random(2) < 0.3).tolist()
        return self.observation_space.sample(), float(action.sum()), terminated, truncated, self.info


class OneArray(gym.ObservationWrapper[Any, Any, Any]):
    """Every observation is written into the same array."""

    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.array = env.observation_space.sample()

    def observation(self, observation: np.ndarray) -> np.ndarray:
        self.array[:] = observation
        return self.array


def make(space: str, wrap: Any = lambda env: env) -> DummyVecEnv:
    env = DummyVecEnv([lambda: wrap(Drawn(SPACES[space]))] * 3)
    env.seed(0)
    return env


def assert_same(ours: Any, theirs: Any) -> None:
    np.testing.assert_equal(ours, theirs)
    if isinstance(theirs, dict):
        assert all(ours[key].dtype == theirs[key].dtype for key in theirs)
    else:
        assert ours.dtype == theirs.dtype


@pytest.mark.parametrize("space", SPACES)
def test_it_returns_what_step_returns(space: str) -> None:
    ours, theirs = make(space), make(space)
    assert_same(ours.reset(), theirs.reset())
    for action in np.random.default_rng(0).normal(size=(50, 3, 2)):
        obs, rewards, dones, infos = step_in_turn(ours, action)
        their_obs, their_rewards, their_dones, their_infos = theirs.step(action)
        for mine, other in ((obs, their_obs), (rewards, their_rewards), (dones, their_dones)):
            assert_same(mine, other)
        for done, info, other in zip(dones, infos, their_infos, strict=True):
            # The one info of Drawn keeps what DummyVecEnv has once written into it
            wanted = {key: value for key, value in other.items() if done or key != "terminal_observation"}
            np.testing.assert_equal(info, wanted)
        assert ours.reset_infos == theirs.reset_infos
        # What a callback may look at
        for name in ("actions", "buf_rews", "buf_dones"):
            assert_same(getattr(ours, name), getattr(theirs, name))
        assert ours.buf_infos == infos


def test_what_was_returned_stays_as_it_was() -> None:
    """Also where the environment writes all its observations into one array."""
    separate, one = make("box"), make("box", OneArray)
    separate.reset(), one.reset()
    returned = []
    for action in np.random.default_rng(0).normal(size=(50, 3, 2)):
        returned.append((separate.step(action), step_in_turn(one, action)))
    n_ended = 0
    for (obs, rewards, dones, infos), ours in returned:
        for mine, other in zip(ours[:3], (obs, rewards, dones), strict=True):
            assert_same(mine, other)
        for i in np.flatnonzero(dones):
            assert_same(ours[3][i]["terminal_observation"], infos[i]["terminal_observation"])
            n_ended += 1
    assert n_ended > 50


@pytest.mark.parametrize("method", ["step", "step_async", "step_wait"])
def test_a_replaced_method_is_called(method: str) -> None:
    env = make("box")
    setattr(env, method, lambda *args: None)
    assert stepper(env) == env.step


def test_only_a_plain_dummy_vec_env_is_stepped_so() -> None:
    class Own(DummyVecEnv):
        pass

    assert stepper(make("box")).func is step_in_turn  # type: ignore[attr-defined]
    for env in (VecNormalize(make("box")), make_vec_env("CartPole-v1", 2, vec_env_cls=Own)):
        assert stepper(env) == env.step
