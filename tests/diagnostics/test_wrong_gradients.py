"""The gradient check names the line where the gradient is wrong."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th
from environments import Corridor, Tree
from gradient_checks import ACTION_SPACES, HalfDetached, corridor, with_noise
from gymnasium import spaces
from models import FromDistribution
from sb3_contrib.common.envs import InvalidActionEnvDiscrete
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_reinforce import REINFORCE, ActionMaskObservation, MaskedPolicy
from sb3_reinforce.diagnostics import check_gradient
from sb3_reinforce.diagnostics.policy_errors import sampling_error
from sb3_reinforce.estimation import weights
from sb3_reinforce.estimation.rollout import timesteps_of


def altered(log_prob=lambda log_prob, actions: log_prob, actions=lambda actions: actions):
    """A policy whose ``evaluate_actions`` changes the actions or their log π."""

    class Altered(ActorCriticPolicy):
        def evaluate_actions(self, obs, given):
            values, found, entropy = super().evaluate_actions(obs, actions(given))
            return values, log_prob(found, given), entropy

    return Altered


# As if for a loss
NEGATED = altered(lambda log_prob, actions: -log_prob)
# The next action instead of the one that was taken
SHIFTED = altered(actions=lambda actions: (actions + 1) % 3)
# A constant per action, with which log π no longer is a log-probability
OFFSET = altered(lambda log_prob, actions: log_prob + 0.1 * actions)
DETACHED = altered(lambda log_prob, actions: log_prob.detach())


class Stale(ActorCriticPolicy):
    """Samples from the policy as it was made, and reports the present log π."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.first = None

    def forward(self, obs, deterministic=False):
        if self.first is None:
            self.first = self.get_distribution(obs).distribution.logits[:1].detach()
        actions = th.distributions.Categorical(logits=self.first.expand(len(obs), -1)).sample()
        values, log_prob, _ = self.evaluate_actions(obs, actions)
        return actions, values, log_prob


class WithoutBias(ActorCriticPolicy):
    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.action_net = th.nn.Linear(self.action_net.in_features, self.action_net.out_features, bias=False)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1))


class OwnHead(FromDistribution):
    """Its distribution comes from another layer."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.head = th.nn.Linear(self.action_net.in_features, self.action_net.out_features)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1))

    def get_distribution(self, obs):
        return self.action_dist.proba_distribution(
            self.head(self.mlp_extractor.forward_actor(self.extract_features(obs)))
        )


@pytest.mark.parametrize(("policy", "failures"), [(Stale, ["sign"]), (WithoutBias, []), (OwnHead, [])])
def test_policies_with_other_heads_and_samples(policy, failures):
    model = REINFORCE(policy, make_vec_env("CartPole-v1", 2, seed=0), device="cpu", seed=0)
    assert check_gradient(model).failures == failures


class WrongReturns(REINFORCE):
    """Counts the reward of each step twice."""

    def collect_rollouts(self, *args, **kwargs):
        going_on = super().collect_rollouts(*args, **kwargs)
        self.rollout = replace(self.rollout, returns=self.rollout.returns + self.rollout.rewards)
        return going_on


class WrongWeights(REINFORCE):
    """Scales the weights on their way to training."""

    def collect_rollouts(self, env, callback, rollout_buffer, n_rollout_steps):
        going_on = super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        rollout_buffer.advantages *= 1.1
        return going_on


class WrongDenominator(REINFORCE):
    """Divides by twice the number of steps."""

    def collect_rollouts(self, *args, **kwargs):
        going_on = super().collect_rollouts(*args, **kwargs)
        self.rollout = replace(self.rollout, denominator=2 * self.rollout.denominator)
        return going_on


class TwoSteps(REINFORCE):
    """Takes a second step from the same data."""

    def train(self):
        super().train()
        super().train()


def failures(algorithm=REINFORCE, policy="MlpPolicy", **kwargs):
    model = algorithm(policy, corridor(spaces.Discrete(3)), baseline="mean", device="cpu", seed=0, **kwargs)
    with th.no_grad():
        # A policy that is far from uniform
        model.policy.action_net.weight.mul_(100)
    return check_gradient(model).failures


@pytest.mark.parametrize(
    ("wrong", "lines"),
    [
        ({"policy": NEGATED}, ["log_prob", "sampling", "sign"]),
        ({"policy": SHIFTED}, ["log_prob", "sampling", "sign"]),
        ({"policy": OFFSET}, ["log_prob", "sampling"]),
        ({"policy": HalfDetached}, ["scores"]),
        ({"algorithm": WrongReturns}, ["returns", "weights"]),
        ({"algorithm": WrongWeights}, ["weights"]),
        ({"algorithm": WrongDenominator}, ["surrogate"]),
        ({"algorithm": TwoSteps}, ["surrogate"]),
    ],
)
def test_what_is_wrong_is_named(wrong, lines):
    assert failures(**wrong) == lines


def test_weights_are_not_checked_by_what_computes_them(monkeypatch):
    monkeypatch.setattr(weights, "check_baseline", lambda baseline, rollout: -baseline)
    assert failures() == ["weights"]


@pytest.mark.parametrize(
    ("function", "replacement", "argument"),
    [
        ("timesteps_of", lambda *args: timesteps_of(*args) + 1, "discount_scores"),
        ("standardize", lambda given: (given - given.mean()) / given.var(), "normalize_advantage"),
    ],
)
def test_discounts_and_normalization_are_checked_by_their_definitions(function, replacement, argument, monkeypatch):
    assert failures(**{argument: True}) == []
    monkeypatch.setattr(weights, function, replacement)
    assert failures(**{argument: True}) == ["weights"]


def test_equal_weights_are_not_normalized():
    """Their standard deviation may be a rounding error above 0."""
    env = Corridor((1,), lambda t, action: 0.1)
    model = REINFORCE("MlpPolicy", env, baseline="none", normalize_advantage=True, device="cpu", seed=0)
    assert "weights" not in check_gradient(model, n_episodes=7).failures


def test_negation_is_seen_in_every_action_space():
    for action_space in ACTION_SPACES:
        model = REINFORCE(NEGATED, corridor(action_space), baseline="none", device="cpu", seed=0)
        assert {"log_prob", "sign"} <= set(check_gradient(model).failures)


class Mirrored(ActorCriticPolicy):
    """Acts opposite to what it evaluates, with the log π of what it returns."""

    def forward(self, obs, deterministic=False):
        actions, values, _ = super().forward(obs, deterministic)
        return -actions, values, self.evaluate_actions(obs, -actions)[1]


@pytest.mark.parametrize("policy", [NEGATED, Mirrored])
@pytest.mark.parametrize("log_std_init", [-3.0, 0.0, 2.0, 4.0])
def test_a_wrong_sign_is_seen_with_little_and_with_much_noise(log_std_init, policy):
    assert check_gradient(with_noise(log_std_init, policy, n_actions=2))["sign"].error == 1


class PartlyUniform(ActorCriticPolicy):
    """Takes a uniform action with a chance of 30 %, and reports log π of the network."""

    def forward(self, obs, deterministic=False):
        actions, values, _ = super().forward(obs, deterministic)
        uniform = th.randint_like(actions, self.action_space.n)
        actions = th.where(th.rand(len(actions)) < 0.3, uniform, actions)
        return actions, values, self.evaluate_actions(obs, actions)[1]


class Mode(ActorCriticPolicy):
    """Takes the most likely action, also where all are nearly as likely."""

    def forward(self, obs, deterministic=False):
        return super().forward(obs, deterministic=True)


class Warm(ActorCriticPolicy):
    """Samples with twice the standard deviation that it reports."""

    def forward(self, obs, deterministic=False):
        mean, values = self.get_distribution(obs).distribution.mean, self.predict_values(obs)
        actions = mean + 2 * self.log_std.exp() * th.randn_like(mean)
        return actions, values, self.evaluate_actions(obs, actions)[1]


def test_actions_that_are_sampled_with_other_probabilities_are_seen():
    for policy, is_right in ((PartlyUniform, False), ("MlpPolicy", True)):
        model = REINFORCE(policy, corridor(spaces.Discrete(3)), baseline="mean", device="cpu", seed=0)
        with th.no_grad():
            model.policy.action_net.bias[0] = 2.0
        assert check_gradient(model, seed=0).failures == ([] if is_right else ["sampling"])
    for policy, action_space in ((Warm, spaces.Box(-1, 1, (2,))), (Mode, spaces.Discrete(3))):
        model = REINFORCE(policy, corridor(action_space), baseline="mean", device="cpu", seed=0)
        assert "sampling" in check_gradient(model, seed=0).failures


# Without a least deviation the second measurement fails at the latest, and with one sample the first case's 34th
@pytest.mark.parametrize(
    ("action_space", "logit", "n_times"),
    [
        pytest.param(spaces.Discrete(2), 5.11, 50, marks=pytest.mark.slow),
        (spaces.Discrete(2), 8.1, 5),
        pytest.param(spaces.Discrete(2), 11.5, 5, marks=pytest.mark.slow),
        pytest.param(spaces.MultiDiscrete([2, 2, 2]), 8.1, 5, marks=pytest.mark.slow),
        (spaces.MultiDiscrete([2, 2, 2]), 11.5, 5),
    ],
)
def test_a_rare_action_is_no_false_alarm(action_space, logit, n_times):
    """One with a probability of 0.006, 3e-4 or 1e-5, which comes twice as often as expected, or never."""
    model = REINFORCE("MlpPolicy", corridor(action_space), device="cpu", seed=0)
    with th.no_grad():
        model.policy.action_net.bias[::2] = logit
    th.manual_seed(0)
    assert max(sampling_error(model.policy, th.eye(7), 7) for _ in range(n_times)) < 5
    table = check_gradient(model)
    assert table["scores"].passed and table["sampling"].passed


class DetachedFeatures(FlattenExtractor):
    """Its layer gets no gradient."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.linear = th.nn.Linear(self.features_dim, self.features_dim)

    def forward(self, observations):
        return self.linear(super().forward(observations)).detach()


def test_a_layer_without_a_gradient_is_seen_also_behind_a_mask():
    env = make_vec_env(lambda: ActionMaskObservation(InvalidActionEnvDiscrete(20, n_invalid_actions=10)), 2, seed=0)
    kwargs = {"features_extractor_class": DetachedFeatures}
    model = REINFORCE(MaskedPolicy, env, device="cpu", seed=0, policy_kwargs=kwargs)
    assert check_gradient(model).failures == ["scores"]


@pytest.mark.parametrize("policy", ["MlpPolicy", NEGATED])
def test_a_policy_without_randomness_does_not_pass_unchecked(policy):
    model = REINFORCE(policy, corridor(spaces.Discrete(3)), baseline="mean", device="cpu", seed=0)
    with th.no_grad():
        model.policy.action_net.bias.copy_(th.tensor([80.0, 0.0, 0.0]))
    table = check_gradient(model)
    assert np.isnan(table["sign"].error)
    assert "sign" in table.failures


def test_a_policy_that_cannot_be_differentiated_is_named():
    with pytest.raises(ValueError, match="Altered cannot be differentiated"):
        check_gradient(REINFORCE(DETACHED, Tree(), device="cpu", baseline="none"))
