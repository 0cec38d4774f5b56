"""The NumPy actor is the policy: the same function of the observation, the same actions for the same seed."""

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import CategoricalDistribution, SquashedDiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce import REINFORCE
from sb3_reinforce.policies.evaluation import route_of
from sb3_reinforce.policies.plain_mlp import plain_actor
from sb3_reinforce.sampling.actors import NumpyActor, PolicyActor, make_actor

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


def actor_of(policy, n_envs):
    return make_actor(policy, route_of(policy), n_envs)


@pytest.mark.parametrize(("space", "kwargs"), [*((space, {}) for space in SPACES), (SPACES[0], {"temperature": 0.3})])
@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ReLU])
@pytest.mark.parametrize("n_envs", [1, 3, 40])
def test_the_same_seed_gives_the_same_actions(space, kwargs, activation_fn, n_envs):
    """As the policy's own methods, which draw their noise in Stable-Baselines3 and PyTorch."""
    policy = make_policy(space, policy_kwargs={"activation_fn": activation_fn}, **kwargs)
    obs = np.random.default_rng(0).normal(size=(20, n_envs, 5)).astype(np.float32)
    actions = []
    fast = actor_of(policy, n_envs)
    general = PolicyActor(policy, route_of(policy))
    assert isinstance(fast, NumpyActor)
    for actor in (fast, general):
        th.manual_seed(1)
        actions.append(np.stack([actor.act(row)[0] for row in obs]))
    np.testing.assert_allclose(*actions, rtol=1e-4, atol=1e-5)
    assert actions[0].dtype == actions[1].dtype and np.ptp(actions[0]) > 0
    stored = actions[0].reshape(20, n_envs, -1)
    # Where log π is near 0, what is left is the rounding of logits of order 1
    np.testing.assert_allclose(fast.log_prob(obs, stored), general.log_prob(obs, stored), rtol=1e-4, atol=1e-5)


class OwnForward(ActorCriticPolicy):
    """Plain, but by a method of its own, so that nothing is replaced."""

    def forward(self, obs, deterministic=False):
        return super().forward(obs, deterministic)


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_a_run_does_not_depend_on_the_path(space):
    ends = []
    for policy in ("MlpPolicy", OwnForward):
        env = make_vec_env(lambda: Corridor((3, 5), lambda t, action: float(np.sum(action)), space), 3, seed=0)
        model = REINFORCE(policy, env, seed=0, device="cpu", n_steps=8, learning_rate=1e-2).learn(200)
        ends.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    th.testing.assert_close(*ends, rtol=1e-3, atol=1e-4)


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


def own_distribution(policy):
    proba_distribution = policy.action_dist.proba_distribution
    policy.action_dist.proba_distribution = lambda action_logits: proba_distribution(action_logits * -20)


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
    "hook on the flatten": lambda policy: scale(policy.features_extractor.flatten),
    "hook on the policy": lambda policy: policy.register_forward_hook(lambda module, inputs, output: output),
    "forward of the mlp extractor": lambda policy: setattr(
        policy.mlp_extractor, "forward_actor", lambda features: policy.mlp_extractor.policy_net(features) * -20
    ),
    "distribution of the instance": own_distribution,
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
    actor, expected = actor_of(policy, N_DRAWS), probability()
    share = actor.act(obs)[0].mean()
    assert share == pytest.approx(expected, abs=4 * 0.5 / N_DRAWS**0.5)
    assert isinstance(actor, NumpyActor) == (change == "as it is") and abs(before - expected) < 1
    assert change in ("as it is", "no bias", "gelu", "hook on the policy") or abs(before - expected) > 0.2


def is_fast(policy):
    return isinstance(actor_of(policy, 2), NumpyActor)


def test_whatever_is_not_plain_goes_the_general_way():
    assert is_fast(make_policy())
    assert not is_fast(make_policy(policy_kwargs={"activation_fn": th.nn.ELU}))
    assert plain_actor(make_policy(SPACES[3], use_sde=True)) is None
    assert plain_actor(make_policy(SPACES[3], policy_kwargs={"squash_output": True}, use_sde=True)) is None
    assert plain_actor(th.compile(make_policy(), backend="eager")) is None


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
    assert type(model.policy.features_extractor) is FlattenExtractor and not is_fast(model.policy)


def test_a_squashed_gaussian_is_squashed():
    policy = make_policy(spaces.Box(-1, 1, (2,)))
    policy.action_dist = SquashedDiagGaussianDistribution(2)
    actions = actor_of(policy, 3).act(10 * np.ones((3, 5), dtype=np.float32))[0]
    assert np.abs(actions).max() < 1


def test_each_rollout_acts_with_the_parameters_of_the_last_update():
    model = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=20, learning_rate=0.0, seed=0)
    model.learn(20)
    with th.no_grad():
        model.policy.action_net.bias.copy_(th.tensor([-100.0, 100.0]))
    model.learn(20)
    assert (model.rollout_buffer.actions == 1).all()


@pytest.mark.parametrize("module", ["", "mlp_extractor", "features_extractor.flatten"])
def test_forward_hooks_are_called_as_in_a2c(module):
    model, calls = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=8, device="cpu"), []
    model.policy.get_submodule(module).register_forward_hook(lambda *args: calls.append(1))
    model.learn(8)
    assert len(calls) >= 8


class Change(BaseCallback):
    """Changes the policy so that it only takes action 1, after the tenth step."""

    def __init__(self, how):
        super().__init__()
        self.how = how

    def _on_step(self):
        if self.n_calls == 10:
            self.how(self.model)
        return True


def prefer(policy):
    with th.no_grad():
        policy.action_net.bias.copy_(th.tensor([-100.0, 100.0]))


def new_policy(model):
    model.policy = type(model.policy)(model.observation_space, model.action_space, model.lr_schedule)
    prefer(model.policy)


def new_layer(model):
    model.policy.action_net = th.nn.Linear(64, 2)
    prefer(model.policy)


def new_memory(model):
    model.policy.action_net.bias.data = th.tensor([-100.0, 100.0])


def new_parameter(model):
    model.policy.action_net.bias = th.nn.Parameter(th.tensor([-100.0, 100.0]))


def new_hook(model):
    model.policy.action_net.register_forward_hook(lambda module, inputs, logits: logits + th.tensor([-100.0, 100.0]))


def new_method(model):
    layer = model.policy.action_net
    layer.forward = lambda x: type(layer).forward(layer, x) + th.tensor([-100.0, 100.0])


HOWS = [lambda model: prefer(model.policy), new_policy, new_layer, new_memory, new_parameter, new_hook, new_method]


@pytest.mark.parametrize("how", HOWS, ids=lambda how: how.__name__)
def test_a_policy_that_a_callback_changes_acts_differently_at_once(how):
    """As with A2C, not only from the next rollout on."""
    model = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=40, learning_rate=0.0, seed=0, device="cpu")
    model.learn(40, callback=Change(how))
    actions = model.rollout_buffer.actions.ravel()
    assert 0 in actions[:10] and (actions[10:] == 1).all()
    log_probs = model.rollout_buffer.log_probs.ravel()
    assert (log_probs[:10] < -0.1).all() and np.allclose(log_probs[10:], 0, atol=1e-6)
