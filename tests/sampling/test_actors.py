"""The NumPy actor is the policy: the same function of the observation, the same actions for the same seed."""

from itertools import product

import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Corridor
from gymnasium import spaces
from models import plain
from policy_changes import BODY, CHANGES, EXTRACTOR
from stable_baselines3.common.distributions import CategoricalDistribution, SquashedDiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce import REINFORCE
from sb3_reinforce.policies.evaluation import calls
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
    return make_actor(policy, calls(policy, "forward"), n_envs, with_log_prob=True)


@pytest.mark.parametrize(("space", "kwargs"), [*((space, {}) for space in SPACES), (SPACES[0], {"temperature": 0.3})])
@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ReLU])
@pytest.mark.parametrize("n_envs", [1, 3, 40])
def test_the_same_seed_gives_the_same_actions(space, kwargs, activation_fn, n_envs):
    """As the policy's own methods, which draw their noise in Stable-Baselines3 and PyTorch."""
    policy = make_policy(space, policy_kwargs={"activation_fn": activation_fn}, **kwargs)
    obs = np.random.default_rng(0).normal(size=(20, n_envs, 5)).astype(np.float32)
    actions = []
    fast = actor_of(policy, n_envs)
    general = PolicyActor(policy, calls(policy, "forward"), with_log_prob=True)
    assert isinstance(fast, NumpyActor)
    for actor in (fast, general):
        th.manual_seed(1)
        drawn, _, log_probs = zip(*map(actor.act, obs), strict=True)
        actions.append(np.stack(drawn))
    np.testing.assert_allclose(*actions, rtol=1e-4, atol=1e-5)
    assert actions[0].dtype == actions[1].dtype and np.ptp(actions[0]) > 0
    stored = actions[0].reshape(20, n_envs, -1)
    # Where log π is near 0, what is left is the rounding of logits of order 1
    np.testing.assert_allclose(fast.log_prob(stored), np.concatenate(log_probs), rtol=1e-4, atol=1e-5)


class OwnForward(ActorCriticPolicy):
    """Plain, but with a method of the user, so that nothing is replaced."""

    def forward(self, obs, deterministic=False):
        return super().forward(obs, deterministic)


@pytest.mark.parametrize("dtype", [th.float64, th.bfloat16])
@pytest.mark.parametrize("space", (SPACES[0], SPACES[3]), ids=str)
def test_a_run_does_not_depend_on_the_default_dtype(space, dtype):
    ends = []
    for each in (th.float32, dtype):
        model = REINFORCE("MlpPolicy", Corridor((3, 5), action_space=space), seed=0, device="cpu")
        th.set_default_dtype(each)
        try:
            model.learn(64)
        finally:
            th.set_default_dtype(th.float32)
        ends.append(plain(model.policy.state_dict()))
    assert ends[0] == ends[1]


@pytest.mark.parametrize("part", ("", "action_net"))
def test_a_policy_that_a_callback_puts_in_training_mode_acts_in_evaluation_mode(part):
    modes = []
    model = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=8, device="cpu")
    model.policy.action_net.register_forward_hook(
        lambda module, *_: modes.append((model.is_collecting, module.training))
    )
    model.learn(16, Record(lambda model: model.policy.get_submodule(part).train(), "rollout_start"))
    assert {training for is_collecting, training in modes if is_collecting} == {False}


@pytest.mark.parametrize("space", (SPACES[0], SPACES[3]), ids=str)
def test_a_run_does_not_depend_on_the_path(space):
    ends = []
    for policy in ("MlpPolicy", OwnForward):
        env = make_vec_env(lambda: Corridor((3, 5), lambda t, action: float(np.sum(action)), space), 3, seed=0)
        model = REINFORCE(policy, env, seed=0, device="cpu", n_steps=8, learning_rate=1e-2).learn(200)
        ends.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    th.testing.assert_close(*ends, rtol=1e-3, atol=1e-4)


# These do not turn the preferences around
SLIGHT = {
    "none": lambda policy: None,
    "hook on the policy": lambda policy: policy.register_forward_hook(lambda module, inputs, output: output),
    "no bias": lambda policy: setattr(policy.action_net, "bias", None),
    "gelu": lambda policy: policy.mlp_extractor.policy_net.append(th.nn.GELU()),
}


@pytest.mark.parametrize("change", [*CHANGES, *SLIGHT])
def test_a_policy_that_the_user_has_changed_acts_as_it_evaluates(change):
    """Otherwise the gradient would belong to another policy than the one that acts."""
    policy = make_policy(spaces.Discrete(2))
    obs = np.repeat(np.eye(5, dtype=np.float32)[:1], N_DRAWS, axis=0)

    def probability():
        with th.no_grad():
            return policy.evaluate_actions(obs_as_tensor(obs[:1], "cpu"), th.ones(1))[1].exp().item()

    before = probability()
    (CHANGES | SLIGHT)[change](policy)
    actor, expected = actor_of(policy, N_DRAWS), probability()
    share = actor.act(obs)[0].mean()
    assert share == pytest.approx(expected, abs=4 * 0.5 / N_DRAWS**0.5)
    assert isinstance(actor, NumpyActor) == (change == "none")
    assert change in SLIGHT or abs(before - expected) > 0.2


def test_a_policy_that_is_not_plain_acts_by_its_own_methods():
    images = FakeImageEnv(screen_height=36, screen_width=36)  # scaled to [0, 1] before they are flattened
    policies = [
        make_policy(policy_kwargs={"activation_fn": th.nn.ELU}),
        make_policy(SPACES[3], use_sde=True),
        make_policy(SPACES[3], policy_kwargs={"squash_output": True}, use_sde=True),
        REINFORCE("MlpPolicy", images, device="cpu").policy,
    ]
    assert type(policies[-1].features_extractor) is FlattenExtractor
    policies.append(make_policy(spaces.Box(-1, 1, (2,))))
    policies[-1].action_dist = SquashedDiagGaussianDistribution(2)
    assert not any(isinstance(actor_of(policy, 2), NumpyActor) for policy in policies)
    assert plain_actor(th.compile(make_policy(), backend="eager")) is None


@pytest.mark.parametrize(
    ("register", "module", "least"),
    [
        *product(("full_backward_hook", "full_backward_pre_hook"), (f"{BODY}.2", "action_net"), (1,)),
        *product(("forward_hook",), ("", "mlp_extractor", f"{EXTRACTOR}.flatten"), (8,)),
    ],
)
def test_hooks_are_called_at_each_step_and_in_each_backward_pass(register, module, least):
    """Users log gradients with them."""
    model, calls = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=8, device="cpu"), []
    getattr(model.policy.get_submodule(module), f"register_{register}")(lambda *args: calls.append(model.is_collecting))
    model.learn(8)
    assert calls.count(register == "forward_hook") >= least


OFFSET = th.tensor([-100.0, 100.0])


def prefer(model):
    with th.no_grad():
        model.policy.action_net.bias.copy_(OFFSET)


def new_policy(model):
    model.policy = type(model.policy)(model.observation_space, model.action_space, model.lr_schedule)
    prefer(model)


def new_layer(model):
    model.policy.action_net = th.nn.Linear(64, 2)
    prefer(model)


def new_method(model):
    forward = model.policy.action_net.forward
    model.policy.action_net.forward = lambda x: forward(x) + OFFSET


class Preferring(CategoricalDistribution):
    def proba_distribution(self, action_logits):
        return super().proba_distribution(action_logits + OFFSET)


def new_distribution(model):
    model.policy.action_dist = Preferring(2)


class Negative(th.nn.Flatten):
    """Negative features, where the observations are positive."""

    def forward(self, x):
        return super().forward(x) * 0 - 1e3


def new_part_of_the_extractor(model):
    with th.no_grad():
        for layer in (model.policy.mlp_extractor.policy_net[0], model.policy.mlp_extractor.policy_net[2]):
            layer.weight.abs_()
        model.policy.action_net.weight.abs_().mul_(th.tensor([[1e3], [-1e3]]))
    model.policy.features_extractor.flatten = Negative()


class Whole(th.nn.Module):
    """A user's network without parts."""

    def forward_actor(self, features):
        return th.ones(len(features), 64)

    def forward_critic(self, features):
        return self.forward_actor(features)

    def forward(self, features):
        return self.forward_actor(features), self.forward_critic(features)


def new_network(model):
    model.policy.mlp_extractor = Whole()
    prefer(model)


def hook_on_the_body(model):
    with th.no_grad():
        model.policy.action_net.weight.copy_(OFFSET[:, None].expand(2, 64))
    model.policy.mlp_extractor.policy_net.register_forward_hook(lambda module, x, latent: th.ones_like(latent))


def new_body_of_the_same_layers(model):
    extractor = model.policy.mlp_extractor
    extractor.policy_net = th.nn.Sequential(*extractor.policy_net)
    hook_on_the_body(model)


HOWS = {
    "new body": new_body_of_the_same_layers,
    "network": new_network,
    "hook on the body": hook_on_the_body,
    "extractor": new_part_of_the_extractor,
    "distribution": new_distribution,
    "values": prefer,
    "policy": new_policy,
    "layer": new_layer,
    "method": new_method,
    "memory": lambda model: setattr(model.policy.action_net.bias, "data", OFFSET.clone()),
    "parameter": lambda model: setattr(model.policy.action_net, "bias", th.nn.Parameter(OFFSET.clone())),
    "hook": lambda model: model.policy.action_net.register_forward_hook(lambda module, x, logits: logits + OFFSET),
}


@pytest.mark.parametrize("how", HOWS)
def test_a_policy_that_a_callback_changes_acts_differently_at_once(how):
    """As with A2C, not only from the next rollout on."""
    model = REINFORCE("MlpPolicy", Corridor((5,)), n_steps=40, learning_rate=0.0, seed=0, device="cpu")
    model.learn(40, callback=At(10, HOWS[how]))
    actions = model.rollout_buffer.actions.ravel()
    assert 0 in actions[:10] and (actions[10:] == 1).all()
    log_probs = model.rollout_buffer.log_probs.ravel()
    assert (log_probs[:10] < -0.1).all() and np.allclose(log_probs[10:], 0, atol=1e-6)


def test_a_deviation_that_a_callback_replaces_counts_at_once():
    env = Corridor((5,), action_space=spaces.Box(-1, 1, (2,)))
    model = REINFORCE("MlpPolicy", env, n_steps=40, learning_rate=0.0, seed=0, device="cpu")
    model.learn(40, callback=At(10, lambda m: setattr(m.policy, "log_std", th.nn.Parameter(th.full((2,), -20.0)))))
    actions = model.rollout_buffer.actions
    assert np.abs(actions[:10]).max() > 0.5 and np.abs(actions[10:]).max() < 0.1
