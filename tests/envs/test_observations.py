"""Observations and rewards of another form are named, unless they stand for the right ones."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
import torch as th
from environments import Corridor, Faulty, Random, of_two
from gymnasium import spaces
from models import all_kinds, both, make
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

MALFORMED = {
    "too long": np.zeros(8, np.float32),
    "one number": np.zeros(1, np.float32),
    "a scalar": 0.0,
    "a string": "x",
    "strings": np.array(["x"] * 7),
    "None": None,
    "a dict": {"x": 1},
    "complex": np.ones(7) * 1j,
    "objects": np.array([None] * 7),
    "ragged": [[0.0], [0.0, 1.0]],
}
# Where the second environment returns it, and in which step of all of them
WHEN = {
    "step": (dict(fault="observation", at=5), 4),
    "end": (dict(fault="observation", at=7), 6),
    "truncation": (dict(fault="observation", at=7, truncate=True), 6),
    "reset": (dict(fault="first observation", at=2), 6),
}


@both
@pytest.mark.parametrize(
    ("when", "name"), [*product(["step"], MALFORMED), *product(("end", "truncation", "reset"), ["too long"])]
)
@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
def test_observations_of_another_form(wrapper, when, name, kind):
    fault, step = WHEN[when]
    # The search resets its environments once more before its first step
    fault = fault | {"at": 3} if (when, kind) == ("reset", "search") else fault
    model = make(kind, wrapper(of_two(value=MALFORMED[name], **fault)))
    with pytest.raises(ValueError, match=rf"observation of environment 1 must .*\(num_timesteps={2 * step}\)"):
        model.learn(400)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


INTEGERS = [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)]


@both
@pytest.mark.parametrize(
    ("space", "value"),
    [
        *product(INTEGERS, (-1, 3, 256, 0.5)),
        *product([spaces.Box(0, 255, (4,), np.uint8)], (-1, 300, -1.0, 0.5, np.nan)),
    ],
)
def test_numbers_that_the_space_does_not_have(space, value, kind):
    value = np.full(space.shape, value)[()]
    env = of_two(fault="observation", at=5, value=value, observation_space=space)
    with pytest.raises(ValueError, match=r"observation of environment 1 must .*\(num_timesteps=8\)"):
        make(kind, env).learn(400)


@both
@pytest.mark.parametrize("space", [*INTEGERS, spaces.Box(0, 255, (4,), np.uint8)], ids=str)
def test_whole_numbers_stand_for_integers(space, kind):
    env = of_two(fault="observation", at=5, value=np.ones(space.shape)[()], observation_space=space)
    assert make(kind, env).learn(40).num_timesteps >= 40


@both
def test_a_dict_observation_names_its_keys(kind):
    env = Corridor()
    env.observation_space = spaces.Dict(a=spaces.Box(0, 1, (2,)), b=spaces.Discrete(2))
    env.observe = lambda: {"a": np.zeros(2, np.float32)}
    with pytest.raises(ValueError, match=r"environment 0 must be a dict with keys \['a', 'b'\], got \['a'\]"):
        make(kind, env, "MultiInputPolicy").learn(8)


@both
@pytest.mark.parametrize("form", [list, np.float64, lambda obs: obs.astype(int)])
def test_other_forms_of_an_observation_are_accepted(form, kind):
    """NumPy turns lists, other floats and integers into numbers of the space."""
    env = Corridor((3,))
    env.observe = lambda: form(Corridor.observe(env))
    assert make(kind, env).learn(32).num_timesteps >= 32


@both
@pytest.mark.parametrize("value", ["x", "1.0", np.ones(2), 1j, None], ids=repr)
@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
def test_rewards_that_are_no_numbers(wrapper, value, kind):
    model = make(kind, wrapper(of_two(fault="reward", at=5, value=value)))
    with pytest.raises(ValueError, match=r"reward of environment 1 must be a number.*\(num_timesteps=8\)"):
        model.learn(400)


@all_kinds
def test_a_reward_that_monitor_refuses(kind):
    """Monitor's own error, after which training goes on."""
    faulty = Faulty("reward", 5, "x")
    model = make(kind, DummyVecEnv([lambda: Monitor(Faulty()), lambda: Monitor(faulty)]))
    with pytest.raises(ValueError, match="could not convert string to float: 'x'"):
        model.learn(400)
    faulty.fault = ""
    assert model.learn(400).num_timesteps >= 400


@both
@pytest.mark.filterwarnings("ignore:Converting a tensor")
@pytest.mark.parametrize(
    "value",
    [np.float64(2), np.int64(2), np.array(2.0), th.tensor(2.0, requires_grad=True), True, 2, Fraction(3, 2)],
    ids=repr,
)
def test_other_forms_of_a_reward_are_accepted(value, kind):
    """Monitor warns of the output of a network, but PPO and A2C train."""
    model = make(kind, Corridor((3,), reward=lambda t, action: value)).learn(32)
    assert model.ep_info_buffer[0]["r"] == 3 * float(value)


@both
def test_what_a_dict_has_besides_its_space_is_left_alone(kind):
    """Also in the last observation before a time limit, whose value the critic predicts."""

    class Noted(Random):
        def observe(self):
            return {**super().observe(), "note": "text"}

    space = spaces.Dict({"x": spaces.Box(-1, 1, (3,))})
    model = make(kind, Noted(space), policy="MultiInputPolicy")
    assert model.learn(64).num_timesteps >= 64
