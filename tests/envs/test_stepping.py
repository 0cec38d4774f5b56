"""While a model learns, a DummyVecEnv returns what its own ``step`` returns."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
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


class Drawn(gym.Env):
    """Draws observations, rewards and ends; if ``reuse``, all infos are one dict and all observations one array."""

    def __init__(self, space, reuse=False):
        self.observation_space, self.action_space = deepcopy(SPACES[space]), spaces.Box(-1, 1, (2,))
        self.reuse, self.info, self.array = (
            reuse,
            {"steps": 0, "position": np.zeros(2)},
            self.observation_space.sample(),
        )

    def observe(self):
        obs = self.observation_space.sample()
        if not self.reuse or not isinstance(obs, np.ndarray):
            return obs
        self.array[:] = obs
        return self.array

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observe(), {"drawn": float(self.np_random.random())}

    def step(self, action):
        self.info["steps"] += 1
        terminated, truncated = (self.np_random.random(2) < 0.3).tolist()
        self.info["position"][:] = self.info["steps"]
        info = self.info if self.reuse else deepcopy(self.info)
        return self.observe(), float(action.sum()), terminated, truncated, info


def make(space, **kwargs):
    env = DummyVecEnv([lambda: Drawn(space, **kwargs)] * 3)
    env.seed(0)
    return env


def assert_same(ours, theirs):
    np.testing.assert_equal(ours, theirs)
    if isinstance(theirs, dict):
        assert all(ours[key].dtype == theirs[key].dtype for key in theirs)
    else:
        assert ours.dtype == theirs.dtype


@pytest.mark.parametrize("space", SPACES)
def test_it_returns_what_step_returns_and_that_stays_as_it_was(space):
    """Also where the environment writes into what it has returned."""
    ours, theirs, returned = make(space, reuse=True), make(space), []
    with guard(ours):
        assert_same(ours.reset(), theirs.reset())
    for action in np.random.default_rng(0).normal(size=(50, 3, 2)):
        with guard(ours):
            returned.append((ours.step(action), theirs.step(action)))
        assert ours.reset_infos == theirs.reset_infos
        # What a callback may look at
        for name in ("actions", "buf_rews", "buf_dones"):
            assert_same(getattr(ours, name), getattr(theirs, name))
        np.testing.assert_equal(ours.buf_infos, returned[-1][0][3])
    for (*arrays, infos), (*their_arrays, their_infos) in returned:
        for mine, other in zip(arrays, their_arrays, strict=True):
            assert_same(mine, other)
        np.testing.assert_equal(infos, their_infos)
    assert sum(dones.sum() for (_, _, dones, _), _ in returned) > 50


class Wordless(Drawn):
    """All infos are one dict, which is empty."""

    own = {}  # noqa: RUF012

    def step(self, action):
        return *super().step(action)[:4], self.own


def test_an_empty_info_of_the_environment_stays_empty():
    env = DummyVecEnv([lambda: Wordless("box")])
    with guard(env):
        env.reset()
        infos = [env.step(np.zeros((1, 2)))[3][0] for _ in range(20)]
    assert Wordless.own == {} and len({*map(id, infos)}) == 20


class Silent(Drawn):
    """Returns None for the info of a step."""

    def step(self, action):
        return *super().step(action)[:4], None


class OldReset(Drawn):
    """Returns the observation alone, as in OpenAI Gym."""

    def reset(self, **kwargs):
        return super().reset(**kwargs)[0]


def test_a_reset_without_an_info_is_named():
    model = make_model("steps", DummyVecEnv([lambda: Drawn("box"), lambda: OldReset("box")]))
    with pytest.raises(ValueError, match=r"reset of environment 1 must return \(observation, info\), got"):
        model.learn(8)


def test_an_info_that_is_not_a_dict_is_named():
    model = make_model("steps", DummyVecEnv([lambda: Drawn("box"), lambda: Silent("box")]))
    with pytest.raises(ValueError, match=r"The info of environment 1 must be a dict, got None \(num_timesteps=0\)"):
        model.learn(8)


@pytest.mark.parametrize("method", ["step", "step_async", "step_wait", "reset"])
def test_methods_of_the_users_own_are_called(method):
    """Whether a subclass overrides them, or the user replaces them on one VecEnv."""
    calls = []

    def own(self, *args):
        calls.append(method)
        return getattr(DummyVecEnv, method)(self, *args)

    subclass = type("Own", (DummyVecEnv,), {method: own})
    make_model("steps", subclass([lambda: Drawn("box")])).learn(8)
    n_calls = len(calls)
    env = make("box")
    setattr(env, method, lambda *args: own(env, *args))
    make_model("steps", env).learn(8)
    assert 0 < n_calls < len(calls) and method in vars(env)
