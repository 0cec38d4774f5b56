"""Wrong environments, spaces and arguments of ``load`` and ``set_env`` are named, and change nothing."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from environments import Corridor, Random
from gymnasium import spaces
from models import KINDS, both, make
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE, FiniteDifference


@both
@pytest.mark.parametrize(
    "env",
    [
        None,
        3,
        gym.make_vec("CartPole-v1", 2),
        type("Task", (gym.Env,), {"observation_space": spaces.Box(-1, 1, (3,)), "action_space": spaces.Discrete(2)}),
        SimpleNamespace(observation_space=spaces.Box(-1, 1, (3,)), action_space=spaces.Discrete(2)),
    ],
    ids=["None", "3", "VectorEnv", "class", "other library"],
)
def test_env_must_be_an_environment(kind, env):
    with pytest.raises(TypeError, match="env must be"):
        make(kind, env)
    with pytest.raises(TypeError, match="env must be"):
        make(kind).set_env(env)


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
    wrong = {"learning_rate": np.nan, "seed": -1, "max_grad_norm": -1, "verbose": "x", "gama": 0.9}
    wrong |= {"stats_window_size": 5, "restore_random_state": "no", "device": "gpu9"}
    wrong |= {"gamma": 2.0, "n_episodes": 4, "baseline": "x"} if kind == "steps" else {"estimator": "x", "n_top": 9}
    for name, value in wrong.items():
        with pytest.raises((TypeError, ValueError), match=name):
            KINDS[kind][0].load(tmp_path / "model", **{name: value})
    assert KINDS[kind][0].load(tmp_path / "model", max_grad_norm=0.1, seed=3, device="cpu").max_grad_norm == 0.1


@both
def test_load_replaces_arguments_of_a_subclass_and_those_that_were_not_saved(kind, tmp_path):
    algorithm = KINDS[kind][0]

    class Own(algorithm):
        def __init__(self, *args, own=1, **kwargs):
            super().__init__(*args, **kwargs)
            self.own = own

    chosen = "n_steps" if kind == "steps" else "n_delta"
    Own("MlpPolicy", "CartPole-v1", device="cpu").save(tmp_path / "model", exclude=["max_grad_norm", chosen])
    loaded = Own.load(tmp_path / "model", max_grad_norm=0.1, own=2, device="cpu", **{chosen: 8})
    assert type(loaded) is Own and (loaded.max_grad_norm, loaded.own) == (0.1, 2)
    # What load knows the class by is saved all the same
    loaded.save(tmp_path / "model", exclude=["own", "reward_to_go", "standardize_utilities"])
    assert Own.load(tmp_path / "model", own=3, device="cpu").own == 3
    assert type("Further", (Own,), {}).load(tmp_path / "model", own=3, device="cpu").own == 3
    for name in ("gama", "kwargs", "_init_setup_model"):
        with pytest.raises(TypeError, match=f"load cannot replace {name}"):
            Own.load(tmp_path / "model", **{name: 1})


@both
def test_wrong_arguments_of_set_parameters_and_set_env_are_named(kind):
    model = make(kind)
    with pytest.raises(TypeError, match="exact_match must be True or False, got 'no'"):
        model.set_parameters(model.get_parameters(), exact_match="no")
    with pytest.raises(ValueError, match=r"device must be .*gpu9"):
        model.set_parameters(model.get_parameters(), device="gpu9")
    with pytest.raises(TypeError, match="force_reset must be True or False, got 'no'"):
        model.set_env(make_vec_env("CartPole-v1", 1), force_reset="no")


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
    ("name", "space", "problem"),
    [
        ("observation_space", spaces.Box(0, 1, (3, 0)), " must not be empty"),
        ("observation_space", spaces.Dict({}), " must not be empty"),
        ("observation_space", spaces.Dict(a=spaces.Box(0, 1, (0,))), r"\['a'\] must not be empty"),
        ("observation_space", spaces.Tuple([spaces.Discrete(2)]), " must be Box"),
        ("observation_space", spaces.Text(3), " must be Box"),
        ("observation_space", spaces.Discrete(4, start=2), " must start at 0"),
        ("observation_space", spaces.MultiDiscrete([2, 2], start=[0, 1]), " must start at 0"),
        ("observation_space", spaces.Box(-1, 1, ()), " must have a dimension"),
        ("observation_space", spaces.Dict(x=spaces.Box(-1, 1, ())), r"\['x'\] must have a dimension"),
        ("observation_space", spaces.MultiDiscrete([[2, 3], [4, 5]]), " must have one dimension"),
        ("action_space", spaces.Box(-1, 1, (0,)), " must not be empty"),
        ("action_space", spaces.Box(-np.inf, np.inf, (2,)), " must have finite bounds"),
        ("action_space", spaces.MultiBinary([2, 3]), " must have one dimension"),
        ("action_space", spaces.MultiDiscrete([[2, 3], [4, 5]]), " must have one dimension"),
        ("action_space", spaces.Tuple([spaces.Discrete(2)]), " must be Box"),
        ("action_space", spaces.Dict(a=spaces.Discrete(2)), " must be Box"),
    ],
)
def test_a_space_that_no_policy_can_see_or_act_in(kind, name, space, problem):
    env = Corridor()
    setattr(env, name, space)
    with pytest.raises(ValueError, match=f"^{name}{problem}"):
        make(kind, env, "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy")


def test_an_environment_of_the_older_library_is_converted_by_stable_baselines3():
    with pytest.raises(TypeError, match=r"wrap it in DummyVecEnv\(\[lambda: env\]\), which converts"):
        make("steps", type("Task", (type("Env", (), {"__module__": "gym.core"}),), {})())


@both
def test_a_policy_goes_with_its_observations(kind):
    with pytest.raises(ValueError, match=r"policy must be MlpPolicy or CnnPolicy.*got MultiInputPolicy"):
        make(kind, Corridor(), "MultiInputPolicy")
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        make(kind, Random(spaces.Dict(a=spaces.Box(0, 1))))


def test_what_the_user_has_left_open_is_chosen_again_at_load(tmp_path):
    def loaded(n_envs, **kwargs):
        return REINFORCE.load(tmp_path / "model", make_vec_env("CartPole-v1", n_envs), device="cpu", **kwargs)

    REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 2), device="cpu").save(tmp_path / "model")
    assert (loaded(2).n_steps, loaded(2).n_episodes) == (32, None)
    other = loaded(20, baseline="leave_one_out")
    assert (other.n_steps, other.n_episodes) == (None, 20)
    assert (loaded(2, n_episodes=4).n_steps, loaded(2, n_episodes=4).n_episodes) == (None, 4)
    # What the user gives stays, also where it is what would have been chosen
    assert loaded(2, n_steps=32, baseline="leave_one_out").n_steps == 32
    assert loaded(20, custom_objects={"n_steps": 64}).n_steps == 64
    given = REINFORCE.load(tmp_path / "model", None, "cpu", {"n_episodes": 4})
    assert (given.n_steps, given.n_episodes) == (None, 4)
    changed = loaded(2)
    changed.baseline = "time_mean"
    changed.save(tmp_path / "model")
    assert loaded(2).n_steps == 32
    changed.n_steps = 64
    changed.save(tmp_path / "model")
    assert loaded(20).n_steps == 64
    make("episodes", make_vec_env("CartPole-v1", 2), n_episodes=None).save(tmp_path / "model")
    assert (loaded(2).n_episodes, loaded(20).n_episodes) == (16, 20)
    make("steps", n_steps=32).save(tmp_path / "model")
    with pytest.raises(ValueError, match="n_steps=32 and n_episodes=4 are both set"):
        loaded(1, n_episodes=4)
    search = make("search", n_delta=None)
    search.save(tmp_path / "model")
    assert FiniteDifference.load(tmp_path / "model", device="cpu", n_top=2).n_top == 2
    assert search.n_delta == 60
    assert FiniteDifference.load(tmp_path / "model", device="cpu", perturbation="coordinate").n_delta == 30
    search.policy.action_net.requires_grad_(False)
    search.n_delta = None
    assert search.learn(1).n_delta == 40


@both
def test_load_replaces_other_attributes_as_stable_baselines3_does(kind, tmp_path):
    make(kind, Corridor()).learn(8).save(tmp_path / "model", include=["is_collecting"])
    of_sb3 = {"force_reset": False, "print_system_info": False, "num_timesteps": 0}
    model = KINDS[kind][0].load(tmp_path / "model", device="cpu", is_collecting=True, **of_sb3)
    assert model.num_timesteps == 0 and model.is_collecting
