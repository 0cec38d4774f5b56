"""Policies that are not built as Stable-Baselines3 builds them, or that a callback exchanges during a rollout."""

import pytest
import torch as th
from callbacks import At
from environments import Corridor
from gymnasium import spaces
from models import FromDistribution, all_kinds, make, moved_by_learning
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.common.tensors import to_vector
from sb3_reinforce.diagnostics import check_gradient, compare_baselines


class WithoutParts(FromDistribution):
    """Has neither an ``mlp_extractor`` nor an ``action_net``."""

    def _build(self, lr_schedule):
        self.actor = th.nn.Linear(self.features_dim, self.action_space.n)
        self.critic = th.nn.Linear(self.features_dim, 1)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def get_distribution(self, obs):
        return self.action_dist.proba_distribution(self.actor(self.extract_features(obs)))

    def predict_values(self, obs):
        return self.critic(self.extract_features(obs))


@all_kinds
def test_a_policy_without_the_usual_parts_trains(kind):
    env = Corridor((3,), lambda t, action: float(action))
    assert "actor.weight" in moved_by_learning(make(kind, env, WithoutParts, policy_kwargs={}), 32)


class NotSummed(DiagGaussianDistribution):
    """Its log π has the shape (n, 1)."""

    def log_prob(self, actions):
        return self.distribution.log_prob(actions)


class Column(ActorCriticPolicy):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.action_dist = NotSummed(1)


@pytest.mark.parametrize("kwargs", [{}, {"step": "natural"}, {"baseline": "none"}], ids=str)
def test_a_log_prob_of_the_wrong_shape_is_named(kwargs):
    """Multiplied by n weights it would be an n × n matrix."""
    model = REINFORCE(Column, Corridor(action_space=spaces.Box(-1, 1, (1,))), device="cpu", **kwargs)
    before = to_vector(model.policy.parameters())
    sentence = r"log π of Column must have shape \(n,\), got \(\d+, 1\)"
    for use in (lambda: model.learn(1), lambda: check_gradient(model)):
        with pytest.raises(ValueError, match=sentence):
            use()
    assert th.equal(to_vector(model.policy.parameters()), before)


class Ones(ActorCriticPolicy):
    """Its features are 1 in ``forward`` and ``evaluate_actions``, but not in Stable-Baselines3's ``predict_values``."""

    def extract_features(self, obs, features_extractor=None):
        return th.ones_like(super().extract_features(obs, features_extractor))


def test_the_critic_is_fitted_to_the_values_that_are_the_baseline():
    env = Corridor((1,), reward=lambda t, action: 5.0)
    model = REINFORCE(Ones, env, n_steps=16, learning_rate=0.02, seed=0, device="cpu").learn(1000)
    assert model.rollout.values.mean().item() == pytest.approx(5, abs=0.2)


def test_a_checkpoint_of_the_middle_of_a_rollout_can_be_measured(tmp_path):
    model = make("steps", Corridor((3,)))
    model.learn(16, callback=At(5, lambda model: model.save(tmp_path / "model")))
    loaded = REINFORCE.load(tmp_path / "model", env=Corridor((3,)), device="cpu")
    assert len(compare_baselines(loaded, n_episodes=4)) > 0
