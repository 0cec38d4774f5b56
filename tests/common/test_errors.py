"""A user's mistake gets an error that names the argument, its value and what is allowed, and nothing is lost."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from models import make, plain
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "values"),
    {
        "learning_rate": (-1e-3, NAN, INF, "fast", None),
        "n_steps": (0, -5, 2.5, NAN, "many", True),
        "n_episodes": (0, -1, 1.5, INF),
        "gamma": (-0.1, 1.1, NAN, INF, None),
        "gae_lambda": (-0.1, 1.1, NAN),
        "ent_coef": (-0.1, NAN, INF, "auto"),
        "vf_coef": (-0.5, NAN, INF),
        "max_grad_norm": (0, -1, NAN, INF),
        "n_critic_updates": (0, -1, 1.5),
        "batch_size": (0, -1, 0.5, NAN),
        "critic_learning_rate": (-1e-3, NAN, INF),
        "temperature": (0, -1.0, NAN, INF),
        "min_std": (-0.1, NAN, INF),
        "max_episode_steps": (0, -1, NAN),
        "normalize_by": ("batch", 3),
        "sde_sample_freq": (-2, 1.5),
        "stats_window_size": (0, -1, NAN),
        "seed": (-1, 1.5, "x"),
        "reward_to_go": ("no", 1),
        "discount_scores": ("no", None),
        "normalize_advantage": ("no",),
    }.items(),
)
def test_an_argument_out_of_its_range_is_named_with_its_value(name, values):
    for value in values:
        with pytest.raises((ValueError, TypeError), match=name) as error:
            REINFORCE("MlpPolicy", "CartPole-v1", **{name: value})
        assert str(value) in str(error.value)


@pytest.mark.parametrize("name", ["learning_rate", "critic_learning_rate", "ent_coef", "temperature"])
@pytest.mark.parametrize("schedule", [lambda progress: NAN, lambda progress: -1.0, lambda progress: "x"])
def test_a_schedule_that_returns_nonsense_is_named(name, schedule):
    with pytest.raises((ValueError, TypeError), match=name):
        REINFORCE("MlpPolicy", "CartPole-v1", **{name: schedule})


@pytest.mark.parametrize("schedule", [lambda progress: 0.0, lambda progress: 1 - progress])
def test_a_schedule_may_fall_to_an_excluded_bound_but_not_begin_there(schedule):
    with pytest.raises(ValueError, match=r"temperature \(at progress 1\) must be finite and > 0"):
        REINFORCE("MlpPolicy", "CartPole-v1", temperature=schedule)


def test_a_schedule_that_goes_wrong_later_stops_training_before_a_step():
    model = REINFORCE(
        "MlpPolicy", "CartPole-v1", n_steps=8, learning_rate=lambda progress: NAN if 0 < progress < 0.6 else 1e-3
    )
    with pytest.raises(ValueError, match="learning_rate"):
        model.learn(16)
    assert model._n_updates == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"baseline": "average"}, ["baseline", "'average'", "'leave_one_out'", "'optimal'", "'time_mean'"]),
        ({"baseline": 3}, ["baseline", "3", "callable"]),
        ({"n_steps": 8, "n_episodes": 4}, ["n_steps=8", "n_episodes=4"]),
        ({"gae_lambda": 0.9, "baseline": "mean"}, ["gae_lambda=0.9", "'value'", "'mean'"]),
        ({"gae_lambda": 0.9, "reward_to_go": False}, ["gae_lambda=0.9", "reward_to_go=False"]),
        ({"baseline": "optimal", "n_episodes": 1}, ["n_episodes", "at least 2", "1"]),
        ({"baseline": "leave_one_out", "n_episodes": 1}, ["n_episodes", "at least 2", "1"]),
        ({"min_std": 0.1}, ["min_std=0.1", "Discrete"]),
    ],
)
def test_arguments_that_do_not_go_together(arguments, words):
    with pytest.raises((ValueError, TypeError)) as error:
        REINFORCE("MlpPolicy", "CartPole-v1", **arguments)
    assert all(word in str(error.value) for word in words)


def test_temperature_is_for_discrete_actions():
    for temperature in (0.5, lambda progress: 1.0):
        with pytest.raises(ValueError, match=r"temperature.*Box"):
            REINFORCE("MlpPolicy", "Pendulum-v1", temperature=temperature)


def test_load_checks_what_it_brings(tmp_path):
    REINFORCE("MlpPolicy", "CartPole-v1", n_steps=8).save(tmp_path / "model")
    for arguments in ({"gamma": 2.0}, {"n_episodes": 4}, {"baseline": "x"}, {"batch_size": 0}):
        with pytest.raises(ValueError, match=next(iter(arguments))):
            REINFORCE.load(tmp_path / "model", **arguments)


@pytest.mark.parametrize("arguments", [{"total_timesteps": NAN}, {"total_timesteps": -1}, {"log_interval": 0}])
def test_learn_checks_its_arguments(arguments):
    model = REINFORCE("MlpPolicy", "CartPole-v1")
    with pytest.raises(ValueError, match=next(iter(arguments))):
        model.learn(**{"total_timesteps": 10, **arguments})


@pytest.mark.parametrize(
    "action_space",
    [
        spaces.Tuple([spaces.Discrete(2)]),
        spaces.Box(-np.inf, np.inf, (2,)),
        spaces.MultiBinary([2, 3]),
        spaces.Dict({"a": spaces.Discrete(2)}),
    ],
)
def test_an_action_space_that_no_policy_can_act_in(action_space):
    with pytest.raises(ValueError, match="action space"):
        REINFORCE("MlpPolicy", Corridor(action_space=action_space))


def test_a_discrete_observation_must_start_at_zero():
    for shifted in (spaces.Discrete(4, start=2), spaces.MultiDiscrete([2, 2], start=[0, 1])):

        class Shifted(Corridor):
            observation_space = property(lambda self, space=shifted: space, lambda self, space: None)

        with pytest.raises(ValueError, match="start at 0"):
            REINFORCE("MlpPolicy", Shifted())


@pytest.mark.parametrize(
    ("baseline", "error", "words"),
    [
        (lambda rollout: rollout.returns[0], ValueError, ["shape", "(8, 2)", "(2,)"]),
        (lambda rollout: rollout.returns * NAN, ValueError, ["finite", "nan", "step 0"]),
        (lambda rollout: 3.0, TypeError, ["tensor", "float"]),
    ],
)
def test_a_users_baseline_is_checked(baseline, error, words):
    env = make_vec_env(lambda: Corridor((4,)), 2)
    model = REINFORCE("MlpPolicy", env, baseline=baseline, n_steps=8)
    with pytest.raises(error) as caught:
        model.learn(16)
    assert "baseline" in str(caught.value) and all(word in str(caught.value) for word in words)


def parameters_of(model):
    return [parameter.clone() for parameter in model.policy.parameters()]


def assert_saveable_and_trainable(model, path):
    """The model can be saved and loaded, and trains on with an environment that is well."""
    model.save(path)
    loaded = REINFORCE.load(path, env=Corridor((7,), action_space=model.action_space))
    assert all(map(th.equal, model.policy.parameters(), loaded.policy.parameters()))
    loaded.learn(64)
    assert all(parameter.isfinite().all() for parameter in loaded.policy.parameters())
    model.set_env(Corridor((7,), action_space=model.action_space))
    model.learn(64, reset_num_timesteps=False)


def test_a_gradient_that_is_not_finite_is_refused(tmp_path):
    model = REINFORCE("MlpPolicy", Corridor((7,), reward=lambda t, action: 1e38), n_steps=14, normalize_advantage=False)
    before = parameters_of(model)
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="not finite"):
        model.learn(14)
    assert all(map(th.equal, before, model.policy.parameters()))
    assert_saveable_and_trainable(model, tmp_path / "model")


def test_an_environment_that_never_ends_is_an_error_in_whole_episode_mode(tmp_path):
    class Endless(Corridor):
        def step(self, action):
            return self.observe(), 1.0, False, False, {}

    model = REINFORCE("MlpPolicy", Endless((7,)), n_episodes=2, baseline="none", max_episode_steps=50)
    with pytest.raises(ValueError, match="max_episode_steps=50"):
        model.learn(100)
    assert model.num_timesteps == 50
    assert_saveable_and_trainable(model, tmp_path / "model")


def test_the_limit_is_for_one_episode_not_for_all():
    model = REINFORCE("MlpPolicy", Corridor((7,)), n_episodes=5, baseline="none", max_episode_steps=7)
    assert model.learn(35)._n_updates == 1
    with pytest.raises(ValueError, match="max_episode_steps=6"):
        REINFORCE("MlpPolicy", Corridor((7,)), n_episodes=5, baseline="none", max_episode_steps=6).learn(35)


class Break(BaseCallback):
    def __init__(self, error, at):
        super().__init__()
        self.error, self.at = error, at

    def _on_step(self):
        if self.n_calls == self.at:
            raise self.error
        return True


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("callback")])
@pytest.mark.parametrize("mode", [{"n_steps": 8}, {"n_episodes": 2, "baseline": "leave_one_out"}])
def test_an_interrupt_leaves_the_last_parameters(error, mode, tmp_path):
    model = REINFORCE("MlpPolicy", Corridor((7,)), **mode)
    with pytest.raises(type(error)):
        model.learn(200, callback=Break(error, at=20))
    assert model.num_timesteps == 20 and model._n_updates > 0
    assert_saveable_and_trainable(model, tmp_path / "model")


def test_temperature_needs_an_action_net_and_min_std_a_log_std():
    from sb3_reinforce.policies.evaluation import floor_std, set_temperature

    with pytest.raises(ValueError, match="action_net"):
        set_temperature(th.nn.Linear(1, 1), 0.5)
    with pytest.raises(ValueError, match="log_std"):
        floor_std(th.nn.Linear(1, 1), 0.1)


def test_mlp_policy_cannot_take_dicts():
    class Dicts(Corridor):
        observation_space = property(lambda self: spaces.Dict({"a": spaces.Box(0, 1)}), lambda self, space: None)

    with pytest.raises(ValueError, match="MultiInputPolicy"):
        REINFORCE("MlpPolicy", Dicts())


def test_gsde_is_for_box_actions():
    with pytest.raises(ValueError, match="gSDE"):
        REINFORCE("MlpPolicy", gym.make("CartPole-v1"), use_sde=True)


# Finite gradients that lead to parameters that are not
EXPLODING = {
    # The observation of a step that is never reached is 0, and so is its gradient: 0 / 0
    "steps": {"policy_kwargs": {"net_arch": [4], "optimizer_kwargs": {"eps": 0.0}}},
    "search": {
        "learning_rate": 1.0,
        "policy_kwargs": {
            "net_arch": [4],
            "optimizer_class": th.optim.SGD,
            "optimizer_kwargs": {"weight_decay": 1e12, "momentum": 0.9},
        },
    },
}


@pytest.mark.parametrize("kind", EXPLODING)
def test_a_step_to_parameters_that_are_not_finite_is_taken_back(kind, tmp_path):
    model = make(kind, Corridor((20,)) if kind == "search" else Unreached(), **EXPLODING[kind])
    with pytest.raises(ValueError, match=r"made a parameter of the policy that is not finite.*optimizer_kwargs"):
        model.learn(4000)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    model.save(tmp_path / "model")
    type(model).load(tmp_path / "model")


def test_a_critic_whose_passes_end_in_parameters_that_are_not_finite_keeps_those_before():
    kwargs = {"net_arch": [4], "optimizer_class": th.optim.SGD, "optimizer_kwargs": {"weight_decay": 1e38}}
    model = make("steps", learning_rate=0.0, critic_learning_rate=1e3, policy_kwargs=kwargs)
    before = plain(model.policy.state_dict())
    with pytest.raises(ValueError, match="made a parameter of the critic that is not finite"):
        model.learn(8)
    assert plain(model.policy.state_dict()) == before


class Unreached(Corridor):
    """Its last observation's number is always 0."""

    def observe(self):
        return super().observe() * (np.arange(len(super().observe())) < 2)
