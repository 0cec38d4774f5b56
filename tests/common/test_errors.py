"""A user's mistake gets an error that names the argument, its value and what is allowed, and nothing is lost."""

import numpy as np
import pytest
import torch as th
from environments import Corridor
from models import make, plain
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE

NAN, INF = float("nan"), float("inf")


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


def test_temperature_needs_an_action_net_and_min_std_a_log_std():
    from sb3_reinforce.policies.evaluation import floor_std, set_temperature

    with pytest.raises(ValueError, match="action_net"):
        set_temperature(th.nn.Linear(1, 1), 0.5)
    with pytest.raises(ValueError, match="log_std"):
        floor_std(th.nn.Linear(1, 1), 0.1)


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
