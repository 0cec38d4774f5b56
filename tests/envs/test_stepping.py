"""While a model learns, a DummyVecEnv returns what its own ``step`` returns, without its deep copies."""

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from models import KINDS
from models import make as make_model
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_reinforce.envs.guards import guard

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
    with guard(ours):
        assert_same(ours.reset(), theirs.reset())
    for action in np.random.default_rng(0).normal(size=(50, 3, 2)):
        with guard(ours):
            obs, rewards, dones, infos = ours.step(action)
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
        with guard(one):
            returned.append((separate.step(action), one.step(action)))
    n_ended = 0
    for (obs, rewards, dones, infos), ours in returned:
        for mine, other in zip(ours[:3], (obs, rewards, dones), strict=True):
            assert_same(mine, other)
        for i in np.flatnonzero(dones):
            assert_same(ours[3][i]["terminal_observation"], infos[i]["terminal_observation"])
            n_ended += 1
    assert n_ended > 50


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", ["step", "step_async", "step_wait", "reset"])
def test_methods_of_the_users_own_are_called(method: str, kind: str) -> None:
    """Of a subclass, or put in the place of those of one VecEnv."""
    calls = []

    def own(self: DummyVecEnv, *args: Any) -> Any:
        calls.append(method)
        return getattr(DummyVecEnv, method)(self, *args)

    subclass = type("Own", (DummyVecEnv,), {method: own})
    make_model(kind, subclass([lambda: Drawn(SPACES["box"])])).learn(8)
    n_calls = len(calls)
    env = make("box")
    setattr(env, method, lambda *args: own(env, *args))
    make_model(kind, env).learn(8)
    assert 0 < n_calls < len(calls) and method in vars(env)
