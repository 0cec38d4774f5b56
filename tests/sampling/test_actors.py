"""The laid-out actor is the policy: the same function of the observation, and the same distribution of actions."""

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.distributions import CategoricalDistribution, SquashedDiagGaussianDistribution
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce import REINFORCE
from sb3_reinforce.policies.plain_mlp import actor_layers
from sb3_reinforce.sampling.actors import GeneralActor, LaidOutActor, make_actor, make_noise, make_sampler

SPACES = [spaces.Discrete(4), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3), spaces.Box(-1, 1, (2, 1))]
N_DRAWS = 4000


def make_policy(space=SPACES[0], policy="MlpPolicy", **kwargs):
    """A policy with weights so large that actions depend on observations."""
    th.manual_seed(0)
    model = REINFORCE(policy, Corridor((5,), action_space=space), device="cpu", **kwargs)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_(std=0.2)
    return model.policy


@pytest.mark.parametrize("space", SPACES, ids=str)
@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ReLU])
def test_without_noise_it_is_the_mode(space, activation_fn, monkeypatch):
    policy = make_policy(space, policy_kwargs={"activation_fn": activation_fn})
    obs = np.random.default_rng(0).normal(size=(50, 5)).astype(np.float32)
    zeros = iter([np.zeros((50, policy.action_net.out_features), dtype=np.float32)])
    monkeypatch.setattr("sb3_reinforce.sampling.actors.make_noise", lambda *args: zeros)
    actions, _, _ = LaidOutActor(policy, actor_layers(policy), 50).act(obs)
    with th.no_grad():
        mode = policy.get_distribution(obs_as_tensor(obs, "cpu")).mode().numpy()
    np.testing.assert_allclose(actions, mode.reshape(50, *space.shape), rtol=1e-5, atol=1e-6)
    assert actions.dtype == mode.dtype


@pytest.mark.parametrize("actor", ["laid out", "general"])
@pytest.mark.parametrize("space", SPACES, ids=str)
def test_actions_are_drawn_from_the_policys_distribution(space, actor):
    """The mean score of the draws is 0 to within its standard error: for no other distribution is E[∇ log π] = 0."""
    policy = make_policy(space)
    obs = np.repeat(np.eye(5, dtype=np.float32)[:1], N_DRAWS, axis=0)
    act = (
        LaidOutActor(policy, actor_layers(policy), N_DRAWS) if actor == "laid out" else GeneralActor(policy, False)
    ).act
    actions = th.as_tensor(act(obs)[0]).reshape(N_DRAWS, -1).float()
    actions = actions.flatten() if isinstance(space, spaces.Discrete) else actions
    distribution = policy.get_distribution(obs_as_tensor(obs[:1], "cpu"))
    parameters = [policy.action_net.bias, *([policy.log_std] if hasattr(policy, "log_std") else [])]
    scores = th.stack([
        th.cat(th.autograd.grad(distribution.log_prob(action[None]).sum(), parameters, retain_graph=True))
        for action in actions
    ])  # fmt: skip
    assert (scores.mean(0).abs() < 4 * scores.std(0) / N_DRAWS**0.5).all()
    assert (scores.std(0) > 0).all()


@pytest.mark.parametrize(("space", "kwargs"), [*((space, {}) for space in SPACES), (SPACES[0], {"temperature": 0.3})])
def test_both_give_the_same_log_probabilities(space, kwargs):
    policy = make_policy(space, **kwargs)
    obs = np.random.default_rng(0).normal(size=(6, 3, 5)).astype(np.float32)
    laid_out, general = LaidOutActor(policy, actor_layers(policy), 3), GeneralActor(policy, False)
    actions = np.stack([laid_out.act(row)[0].reshape(3, -1) for row in obs])
    # Where log π is near 0, what is left is the rounding of logits of order 1
    np.testing.assert_allclose(laid_out.log_prob(obs, actions), general.log_prob(obs, actions), rtol=1e-5, atol=1e-6)


def test_noise_is_that_of_its_distribution():
    """Draws of the sampler from given logits, against the probabilities of the softmax."""
    policy = make_policy(spaces.Discrete(3))
    noise, sample = make_noise(policy, 10_000), make_sampler(policy)
    logits = th.tensor([1.0, -0.5, 0.2])
    actions = sample(np.tile(logits.numpy(), (10_000, 1)), next(noise))
    shares = np.bincount(actions, minlength=3) / 10_000
    np.testing.assert_allclose(shares, logits.softmax(0), atol=4 * 0.5 / 100)
    assert not np.array_equal(next(noise), next(noise))


def scale(module, factor=-20):
    """A hook that turns a module's preferences around."""
    module.register_forward_hook(lambda module, inputs, output: output * factor)


class Scaled(th.nn.Sequential):
    def forward(self, x):
        return super().forward(x) * -20


class Certain(CategoricalDistribution):
    def proba_distribution(self, action_logits):
        return super().proba_distribution(action_logits * -20)


class OwnLatent(ActorCriticPolicy):
    def _get_action_dist_from_latent(self, latent_pi):
        return super()._get_action_dist_from_latent(latent_pi * -20)


class OwnDistribution(ActorCriticPolicy):
    def get_distribution(self, obs):
        return self.action_dist.proba_distribution(super().get_distribution(obs).distribution.logits * -20)

    def evaluate_actions(self, obs, actions):
        distribution = self.get_distribution(obs)
        return self.predict_values(obs), distribution.log_prob(actions), distribution.entropy()


class OwnExtractor(FlattenExtractor):
    def forward(self, observations):
        return super().forward(observations) * -20


class OwnMlp(MlpExtractor):
    def forward_actor(self, features):
        return super().forward_actor(features) * -20


class OwnFeatures(ActorCriticPolicy):
    def extract_features(self, obs, features_extractor=None):
        return super().extract_features(obs, features_extractor) * -20


class OwnLinear(th.nn.Linear):
    def forward(self, x):
        return super().forward(x) * -20


def own_body(policy):
    policy.mlp_extractor.policy_net = Scaled(*policy.mlp_extractor.policy_net)


def own_layer(policy):
    policy.action_net.__class__ = OwnLinear


def own_forward(policy):
    action_net = policy.action_net.forward
    policy.action_net.forward = lambda x: action_net(x) * -20


def own_method(policy):
    method = policy._get_action_dist_from_latent
    policy._get_action_dist_from_latent = lambda latent: method(latent * -20)


CHANGES = {
    "as it is": lambda policy: None,
    "class": lambda policy: setattr(policy, "__class__", OwnLatent),
    "features": lambda policy: setattr(policy, "__class__", OwnFeatures),
    "distribution of the class": lambda policy: setattr(policy, "__class__", OwnDistribution),
    "extractor": lambda policy: setattr(policy.features_extractor, "__class__", OwnExtractor),
    "mlp extractor": lambda policy: setattr(policy.mlp_extractor, "__class__", OwnMlp),
    "method": own_method,
    "distribution": lambda policy: setattr(policy, "action_dist", Certain(2)),
    "hook on the head": lambda policy: scale(policy.action_net),
    "hook on the body": lambda policy: scale(policy.mlp_extractor.policy_net),
    "hook on a layer": lambda policy: scale(policy.mlp_extractor.policy_net[0]),
    "hook on the extractor": lambda policy: scale(policy.features_extractor),
    "pre-hook": lambda policy: policy.action_net.register_forward_pre_hook(lambda module, x: (x[0] * -20,)),
    "body": own_body,
    "layer": own_layer,
    "forward": own_forward,
    "no bias": lambda policy: setattr(policy.action_net, "bias", None),
    "gelu": lambda policy: policy.mlp_extractor.policy_net.append(th.nn.GELU()),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_policy_that_the_user_has_changed_acts_as_it_evaluates(change):
    """Otherwise the gradient would be that of another policy than the one that acts."""
    policy = make_policy(spaces.Discrete(2))
    obs = np.repeat(np.eye(5, dtype=np.float32)[:1], N_DRAWS, axis=0)

    def probability():
        with th.no_grad():
            return policy.evaluate_actions(obs_as_tensor(obs[:1], "cpu"), th.ones(1))[1].exp().item()

    before = probability()
    CHANGES[change](policy)
    actor, expected = make_actor(policy, N_DRAWS, False), probability()
    share = actor.act(obs)[0].mean()
    assert share == pytest.approx(expected, abs=4 * 0.5 / N_DRAWS**0.5)
    assert isinstance(actor, LaidOutActor) == (change == "as it is") and abs(before - expected) < 1
    assert change in ("as it is", "no bias", "gelu") or abs(before - expected) > 0.2


def test_whatever_is_not_plain_goes_the_general_way():
    assert actor_layers(make_policy(policy_kwargs={"activation_fn": th.nn.ELU})) is None
    assert actor_layers(make_policy(SPACES[3], use_sde=True)) is None
    assert actor_layers(make_policy(SPACES[3], policy_kwargs={"squash_output": True}, use_sde=True)) is None
    assert actor_layers(th.compile(make_policy(), backend="eager")) is None


@pytest.mark.parametrize("name", ["mlp_extractor.policy_net.2", "action_net"])
@pytest.mark.parametrize("hook", ["register_full_backward_hook", "register_full_backward_pre_hook"])
def test_backward_hooks_are_called(name, hook):
    """Users log gradients with them."""
    model, calls = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=8, device="cpu"), []
    getattr(model.policy.get_submodule(name), hook)(lambda *args: calls.append(1))
    model.learn(8)
    assert calls


def test_images_go_the_general_way():
    """They are scaled to [0, 1] before they are flattened."""
    model = REINFORCE("MlpPolicy", FakeImageEnv(screen_height=36, screen_width=36), device="cpu")
    assert type(model.policy.features_extractor) is FlattenExtractor and actor_layers(model.policy) is None


def test_a_squashed_gaussian_is_squashed():
    policy = make_policy(spaces.Box(-1, 1, (2,)))
    policy.action_dist = SquashedDiagGaussianDistribution(2)
    actions = make_actor(policy, 3, False).act(10 * np.ones((3, 5), dtype=np.float32))[0]
    assert np.abs(actions).max() < 1


def test_each_rollout_acts_with_the_parameters_of_the_last_update():
    """A laid-out actor that were not refreshed would go on as it began."""
    model = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=20, learning_rate=0.0, seed=0)
    model.learn(20)
    with th.no_grad():
        model.policy.action_net.bias.copy_(th.tensor([-100.0, 100.0]))
    model.learn(20)
    assert (model.rollout_buffer.actions == 1).all()
