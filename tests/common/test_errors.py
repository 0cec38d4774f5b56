"""A user's mistake gets an error that names the argument, its value and what is allowed, and nothing is lost."""

import numpy as np
import pytest
import torch as th
from environments import Corridor
from models import all_kinds, make, plain
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce.diagnostics import check_gradient
from sb3_reinforce.policies.evaluation import floor_std, set_temperature

NAN = float("nan")


@pytest.mark.parametrize(
    ("baseline", "error", "words"),
    [
        (lambda rollout: rollout.returns[0], ValueError, ["shape", "(8, 2)", "(2,)"]),
        (lambda rollout: rollout.returns * NAN, ValueError, ["finite", "nan", "step 0"]),
        (lambda rollout: 3.0, TypeError, ["tensor", "float"]),
    ],
)
def test_a_users_baseline_is_checked(baseline, error, words):
    model = make("steps", make_vec_env(lambda: Corridor((4,)), 2), baseline=baseline)
    with pytest.raises(error, match="baseline") as caught:
        model.learn(16)
    assert all(word in str(caught.value) for word in words)


def test_an_episode_longer_than_max_episode_steps_is_an_error():
    """The limit is for each episode, not for all of a rollout."""
    model = make("episodes", Corridor((7,)), n_episodes=5, max_episode_steps=6)
    with pytest.raises(ValueError, match="max_episode_steps=6"):
        model.learn(35)
    assert model.num_timesteps == 6 and model._n_updates == 0
    model.max_episode_steps = 7
    assert model.learn(35)._n_updates == 1


@pytest.mark.parametrize("kwargs", [{"n_steps": 128}, {"n_episodes": 2, "reward_to_go": False}])
def test_numbers_may_underflow_where_numpy_raises_errors(kwargs):
    """γ^t and returns in float32, where a user looks for the source of a NaN by ``np.seterr(all="raise")``."""
    env = VecNormalize(make_vec_env(lambda: Corridor((200,), lambda t, action: 1e-41)))
    kind = "episodes" if "n_episodes" in kwargs else "steps"
    with np.errstate(all="raise"):
        model = make(kind, env, gamma=1e-3, discount_scores=True, **kwargs).learn(256)
        assert model._n_updates >= 1
        check_gradient(model, n_episodes=2)


def test_train_needs_a_rollout():
    with pytest.raises(ValueError, match="train needs a rollout: call learn"):
        make("steps").train()


def test_temperature_needs_an_action_net_and_min_std_a_log_std():
    with pytest.raises(ValueError, match="action_net"):
        set_temperature(th.nn.Linear(1, 1), 0.5)
    with pytest.raises(ValueError, match="log_std"):
        floor_std(th.nn.Linear(1, 1), 0.1)


@all_kinds
def test_a_gradient_that_is_not_finite_is_refused(kind):
    extra = {"standardize_utilities": False} if kind == "search" else {"normalize_advantage": False}
    model = make(kind, Corridor((7,), reward=lambda t, action: 3e38 * (1 - 2 * (action == 0))), **extra)
    before = plain(model.policy.state_dict())
    with np.errstate(over="ignore"), pytest.raises(ValueError, match=r"gradient of the (policy|utility) is not finite"):
        model.learn(1)
    assert plain(model.policy.state_dict()) == before and model._n_updates == 0
    model.set_env(Corridor((7,)))
    model.learn(64, reset_num_timesteps=False)


def test_the_gradient_of_a_critic_that_is_not_finite_is_named():
    model = make("steps")
    model.policy.value_net.weight.register_hook(lambda gradient: gradient * NAN)
    before = plain(model.policy.value_net.state_dict())
    with pytest.raises(ValueError, match="The gradient of the critic is not finite"):
        model.learn(8)
    assert plain(model.policy.value_net.state_dict()) == before


class Unreached(Corridor):
    """The last entry of the observation is always 0, and so is its gradient."""

    def observe(self):
        return super().observe() * np.array([1, 1, 0])


def optimizer(**kwargs):
    return {"policy_kwargs": {"net_arch": [4], "optimizer_class": th.optim.SGD, "optimizer_kwargs": kwargs}}


# Finite gradients that lead to parameters that are not: 0 / 0 in Adam, and an overflow
EXPLODING = {
    "steps": (Unreached(), {"policy_kwargs": {"net_arch": [4], "optimizer_kwargs": {"eps": 0.0}}}),
    "search": (Corridor((20,)), {"learning_rate": 1.0, **optimizer(weight_decay=1e12, momentum=0.9)}),
}


@pytest.mark.parametrize("kind", EXPLODING)
def test_a_step_to_parameters_that_are_not_finite_is_undone(kind, tmp_path):
    env, arguments = EXPLODING[kind]
    model = make(kind, env, **arguments)
    with pytest.raises(ValueError, match=r"update of the policy left a parameter that is not finite.*optimizer_kwargs"):
        model.learn(4000)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    model.save(tmp_path / "model")
    type(model).load(tmp_path / "model")


def test_a_critic_whose_passes_end_in_parameters_that_are_not_finite_keeps_those_before():
    model = make("steps", learning_rate=0.0, critic_learning_rate=1e3, **optimizer(weight_decay=1e38))
    before = plain(model.policy.state_dict())
    with pytest.raises(ValueError, match="update of the critic left a parameter that is not finite"):
        model.learn(8)
    assert plain(model.policy.state_dict()) == before


@all_kinds
def test_another_default_device_is_refused(kind):
    model = make(kind)
    with th.device("meta"), pytest.raises(ValueError, match="default device must be the CPU, got meta"):
        model.learn(8)
