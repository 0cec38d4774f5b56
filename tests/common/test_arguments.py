"""Arguments that both algorithms have: each wrong one is named, at construction, by load, by set_env and by learn."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from models import KINDS, make
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

NAN, INF = float("nan"), float("inf")
both = pytest.mark.parametrize("kind", ["steps", "search"])

AT_CONSTRUCTION = {
    "learning_rate": (-1e-3, NAN, INF, 1e7, "x", None, lambda progress: NAN, lambda progress: np.ones(2)),
    "max_grad_norm": (0, -1, NAN),
    "max_episode_steps": (0, NAN),
    "seed": (-1, 1.5, "x", 2**32),
    "stats_window_size": (0, -1, NAN),
    "policy_kwargs": (3, "x"),
    "tensorboard_log": (3,),
    "verbose": ("x", None, -1),
    "device": ("gpu9", 3),
}


@both
@pytest.mark.parametrize(("name", "values"), AT_CONSTRUCTION.items())
def test_what_both_algorithms_take_is_checked_at_construction(kind, name, values):
    for value in values:
        with pytest.raises((TypeError, ValueError), match=name):
            make(kind, **{name: value})


@both
@pytest.mark.parametrize("form", [float, np.float32, np.array, lambda rate: np.array([rate]), th.tensor])
def test_forms_that_stand_for_the_value_of_a_schedule(form, kind):
    model = make(kind, learning_rate=lambda progress: form(1e-3), seed=2**32 - 1).learn(8)
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3)


@pytest.mark.parametrize("name", ["common_random_numbers", "standardize_utilities", "deterministic"])
def test_flags_of_the_search(name):
    for value in ("no", 1, None):
        with pytest.raises(TypeError, match=name):
            make("search", **{name: value})


@pytest.mark.parametrize(("name", "value"), [("rollout_buffer_class", 3), ("rollout_buffer_kwargs", 3)])
def test_the_rollout_buffer(name, value):
    with pytest.raises(TypeError, match=name):
        make("steps", **{name: value})


@both
@pytest.mark.parametrize("env", [None, 3, gym.make_vec("CartPole-v1", 2)], ids=["None", "3", "VectorEnv"])
def test_env_must_be_an_environment(kind, env):
    with pytest.raises(TypeError, match="env must be"):
        make(kind, env)
    with pytest.raises(TypeError, match="env must be"):
        make(kind).set_env(env)


@both
@pytest.mark.parametrize("policy", [3, None])
def test_policy_must_be_a_name_or_a_class(kind, policy):
    with pytest.raises(TypeError, match="policy must be"):
        make(kind, policy=policy)


AT_LEARN = {
    "total_timesteps": (NAN, INF, -5, "many", None, True),
    "log_interval": (0, -1, 1.5, "x"),
    "callback": (3, "x", [3], BaseCallback, [BaseCallback]),
    "tb_log_name": (3, None),
    "reset_num_timesteps": ("no", None),
    "progress_bar": ("no", 1),
}


@both
@pytest.mark.parametrize(("name", "values"), AT_LEARN.items())
def test_the_arguments_of_learn(kind, name, values):
    model = make(kind)
    for value in values:
        with pytest.raises((TypeError, ValueError), match=name):
            model.learn(**{"total_timesteps": 8, name: value})
    assert model._last_obs is None and model.num_timesteps == 0


@both
def test_learning_after_a_load_needs_an_environment(kind, tmp_path):
    make(kind).save(tmp_path / "model")
    model = KINDS[kind][0].load(tmp_path / "model", device="cpu")
    with pytest.raises(ValueError, match="env is None"):
        model.learn(8)
    model.set_env(make_vec_env("CartPole-v1", 1))
    assert model.learn(8).num_timesteps >= 8


@both
def test_load_checks_the_arguments_that_it_replaces(kind, tmp_path):
    make(kind).save(tmp_path / "model")
    wrong = {"learning_rate": NAN, "seed": -1, "max_grad_norm": -1, "verbose": "x", "gama": 0.9, "stats_window_size": 5}
    for name, value in wrong.items():
        with pytest.raises((TypeError, ValueError), match=name):
            KINDS[kind][0].load(tmp_path / "model", **{name: value})
    assert KINDS[kind][0].load(tmp_path / "model", max_grad_norm=0.1, seed=3, device="cpu").max_grad_norm == 0.1


@both
def test_load_replaces_arguments_that_a_subclass_hands_on(kind, tmp_path):
    algorithm = KINDS[kind][0]

    class Own(algorithm):
        def __init__(self, *args, own=1, **kwargs):
            super().__init__(*args, **kwargs)
            self.own = own

    Own("MlpPolicy", "CartPole-v1", device="cpu").save(tmp_path / "model")
    loaded = Own.load(tmp_path / "model", max_grad_norm=0.1, own=2, device="cpu")
    assert type(loaded) is Own and (loaded.max_grad_norm, loaded.own) == (0.1, 2)
    with pytest.raises(TypeError, match="gama"):
        Own.load(tmp_path / "model", gama=0.9)


@both
def test_load_checks_the_argument_for_the_random_state(kind, tmp_path):
    model = make(kind)
    model.save(tmp_path / "with")
    for value in ("no", 1, None):
        with pytest.raises(TypeError, match="restore_random_state"):
            KINDS[kind][0].load(tmp_path / "with", restore_random_state=value)
    model.save(tmp_path / "without", exclude=["_random_state"])
    before = th.get_rng_state()
    with pytest.raises(ValueError, match=r"restore_random_state must be False for .*without"):
        KINDS[kind][0].load(tmp_path / "without", restore_random_state=True)
    assert th.equal(th.get_rng_state(), before)
    KINDS[kind][0].load(tmp_path / "without", device="cpu")


@both
def test_set_env_checks_the_number_and_the_spaces(kind):
    model = make(kind)
    with pytest.raises(ValueError, match="num_envs=1, as the model has, got 3"):
        model.set_env(make_vec_env("CartPole-v1", 3))
    with pytest.raises(ValueError, match="spaces do not match"):
        model.set_env(gym.make("Pendulum-v1"))
    assert model.learn(8).num_timesteps >= 8


@both
@pytest.mark.parametrize(
    ("policy", "space"),
    [
        ("MlpPolicy", spaces.Box(0, 1, (0,))),
        ("MlpPolicy", spaces.Box(0, 1, (3, 0))),
        ("MultiInputPolicy", spaces.Dict({})),
        ("MultiInputPolicy", spaces.Dict(a=spaces.Box(0, 1, (0,)))),
        ("MlpPolicy", spaces.Tuple([spaces.Discrete(2)])),
        ("MlpPolicy", spaces.Discrete(4, start=2)),
    ],
)
def test_an_observation_space_that_no_policy_can_see(kind, policy, space):
    class Env(Corridor):
        observation_space = property(lambda self: space, lambda self, space: None)

    with pytest.raises(ValueError, match="observation space"):
        make(kind, Env(), policy)


@both
def test_an_action_space_without_actions(kind):
    with pytest.raises(ValueError, match="action space"):
        make(kind, Corridor(action_space=spaces.Box(-1, 1, (0,))))


@both
def test_integers_of_numpy_and_ones_that_are_too_large(kind, tmp_path):
    integers = {"seed": 3, "stats_window_size": 5, "max_episode_steps": 600}
    integers |= {"batch_size": 16, "n_steps": 8, "n_critic_updates": 2} if kind == "steps" else {"n_delta": 2}
    model = make(kind, **{name: np.int64(value) for name, value in integers.items()}).learn(16)
    assert model.ep_info_buffer.maxlen == 5
    model.save(tmp_path / "model")
    given = {name: np.int64(value) for name, value in integers.items() if name != "stats_window_size"}
    type(model).load(tmp_path / "model", env=gym.make("CartPole-v1"), **given).learn(16)
    for name in integers.keys() - {"seed", "stats_window_size"}:
        with pytest.raises(ValueError, match=rf"{name} must be at least .* and at most \d+, got {2**63}"):
            make(kind, **{name: 2**63})


def test_a_temperature_beyond_float32():
    with pytest.raises(ValueError, match="temperature"):
        make("steps", temperature=1e300)


@both
@pytest.mark.parametrize(
    "space", [spaces.Box(-1, 1, ()), spaces.MultiDiscrete([[2, 3], [4, 5]]), spaces.Dict({"x": spaces.Box(-1, 1, ())})]
)
def test_observations_of_a_number_of_dimensions_that_no_policy_can_see(space, kind):
    env = Corridor()
    env.observation_space = space
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    with pytest.raises(ValueError, match=r"observation space.* must have (a|one) dimension"):
        make(kind, env, policy)


@both
def test_actions_of_two_dimensions(kind):
    env = Corridor()
    env.action_space = spaces.MultiDiscrete([[2, 3], [4, 5]])
    with pytest.raises(ValueError, match="MultiDiscrete action space must have one dimension"):
        make(kind, env)


@both
def test_a_policy_for_dicts_needs_them(kind):
    with pytest.raises(ValueError, match=r"policy must be MlpPolicy or CnnPolicy.*got MultiInputPolicy"):
        make(kind, Corridor(), "MultiInputPolicy")
