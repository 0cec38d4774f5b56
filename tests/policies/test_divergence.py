"""The KL divergence of a step, as it is logged."""

import math
from copy import deepcopy

import pytest
import torch as th
from callbacks import Record
from enumeration import make_model
from environments import Corridor
from models import Normalized
from recurrent_models import make_recurrent
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import GradientQualityCallback, PitfallCallback
from sb3_reinforce.estimation.weights import training_batch
from sb3_reinforce.policies.evaluation import log_prob_of, sampled_divergence, some_steps
from sb3_reinforce.recurrent import RecurrentREINFORCE


def test_the_sampled_divergence_has_the_expectation_of_the_divergence():
    policy, obs = make_model().policy, th.eye(3)[[0, 0, 0, 1, 2, 2]]
    with th.no_grad():
        old = policy.get_distribution(obs).distribution.logits.clone()
        policy.action_net.weight.copy_(th.tensor([[1.0, -0.3, 0.2], [0.5, 0.1, -0.4]]))
        new = policy.get_distribution(obs).distribution.logits.clone()
    expected = (old.exp() * (old - new)).sum(1).mean()
    # Each action as often as the old policy takes it
    found = 0.0
    for i in range(len(obs)):
        for action in range(2):
            k3 = sampled_divergence(policy, obs[i : i + 1], th.tensor([action]), old[i, action])
            found += float(old[i, action].exp()) * k3 / len(obs)
    assert found == pytest.approx(float(expected), rel=1e-10)


class Unsteady(Normalized):
    """Its features differ in training mode, in which each pass changes them."""

    def forward(self, observations):
        return th.nn.functional.dropout(super().forward(observations), 0.5, self.training)


LOGGED = {
    "MLP": ("MlpPolicy", "CartPole-v1", {}),
    "gSDE": ("MlpPolicy", "Pendulum-v1", {"use_sde": True}),
    "images": ("CnnPolicy", FakeImageEnv(screen_height=40, screen_width=40, n_channels=1), {}),
    "dropout": ("MlpPolicy", "CartPole-v1", {"policy_kwargs": {"features_extractor_class": Unsteady}}),
    "memory": ("MlpLstmPolicy", "CartPole-v1", {}),
}


@pytest.mark.parametrize("name", LOGGED)
def test_the_logged_divergence_of_the_optimizers_step_is_the_sampled_one(name):
    policy, env, kwargs = LOGGED[name]
    algorithm = RecurrentREINFORCE if name == "memory" else REINFORCE
    old = Record(lambda model: deepcopy(model.policy.state_dict()))
    model = algorithm(policy, env, n_steps=64, learning_rate=0.01, seed=0, device="cpu", **kwargs).learn(64, old)
    model.policy.set_training_mode(False)
    batch = training_batch(model.rollout, model.rollout_buffer, normalize=False)
    log_probs = []
    for state in (model.policy.state_dict(), old.records[0]):
        model.policy.load_state_dict(state)
        log_probs.append(log_prob_of(model.policy, batch.observations, batch.actions).double().detach())
    log_ratio = log_probs[0] - log_probs[1]
    expected = float((log_ratio.exp() - 1 - log_ratio).mean())
    assert 1e-6 < expected == pytest.approx(model.logger.name_to_value["train/kl"], rel=1e-2)


class Differentiating(ActorCriticPolicy):
    """Its log π needs a gradient, which is nothing under no_grad."""

    def evaluate_actions(self, obs, actions):
        obs = obs.requires_grad_()
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        (slope,) = th.autograd.grad(log_prob.sum(), obs, create_graph=True)
        return values, log_prob - 1e-3 * slope.square().sum(1), entropy


@pytest.mark.parametrize("rollout", [{"n_steps": 64}, {"n_episodes": 3, "baseline": "optimal"}])
def test_a_policy_that_differentiates_has_a_divergence_too(rollout):
    """And can be measured."""
    model = REINFORCE(Differentiating, "CartPole-v1", seed=0, device="cpu", **rollout)
    model.learn(1, [PitfallCallback(), GradientQualityCallback(1)])
    assert model.logger.name_to_value["train/kl"] > 0


def test_a_log_changes_no_statistics():
    """The passes in training mode are the policy's; the critic's evaluate a shared extractor as it is."""
    kwargs = {"features_extractor_class": Unsteady}
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=64, policy_kwargs=kwargs, seed=0).learn(128)
    assert model.policy.features_extractor.norm.num_batches_tracked == 2


@pytest.mark.parametrize(("n", "expected"), [(50, 50), (100, 64), (4096, 512)])
def test_an_estimate_takes_different_steps(n, expected):
    policy = make_model().policy
    obs, actions = some_steps(policy, {"numbers": th.arange(n)}, th.arange(n))
    assert len(actions.unique()) == len(actions) == expected
    assert th.equal(obs["numbers"], actions)


def test_the_divergence_of_a_recurrent_policy_is_evaluated_without_gradients():
    model = make_recurrent(double=False, n_episodes=2).learn(1)
    original, modes = model.policy.sequence_distribution, []
    model.policy.sequence_distribution = lambda rows: modes.append(th.is_grad_enabled()) or original(rows)
    batch = training_batch(model.rollout, model.rollout_buffer, False)
    sampled_divergence(model.policy, batch.observations, batch.actions, th.zeros(()))
    assert modes == [False]


def test_the_divergence_of_outputs_that_are_not_finite_is_nan():
    """The step is done, and the next rollout reports them."""
    policy = REINFORCE("MlpPolicy", Corridor(), device="cpu").policy
    with th.no_grad():
        policy.action_net.bias.fill_(math.nan)
    assert math.isnan(sampled_divergence(policy, th.ones(2, 3), th.zeros(2), th.zeros(2)))
