"""The gradients of all episodes are those of one backward pass each, whatever the policy and the memory."""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.estimation import gradients_by_episode

BOX = spaces.Box(-1, 1, (2,))


def collect(env, policy="MlpPolicy", n_episodes=5, **kwargs):
    model = REINFORCE(policy, env, baseline="none", n_episodes=n_episodes, learning_rate=0.0, device="cpu", **kwargs)
    return model.learn(1).rollout


def one_by_one(rollout, *weights):
    """One backward pass through the policy's own method for each episode and weight."""
    policy = rollout.policy
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    found = []
    for episode in th.unique(rollout.episodes[rollout.used]):
        steps = rollout.used & (rollout.episodes == episode)
        obs = rollout.observations
        obs = {key: part[steps] for key, part in obs.items()} if isinstance(obs, dict) else obs[steps]
        actions = as_policy_actions(rollout.actions[steps], policy.action_space)
        _, log_prob, _ = policy.evaluate_actions(obs, actions)
        for w in weights:
            gradients = th.autograd.grad((w[steps] * log_prob).sum(), parameters, retain_graph=True, allow_unused=True)
            found.append(th.cat([gradient.flatten() for gradient in gradients if gradient is not None]))
    return th.stack(found).unflatten(0, (-1, len(weights))).transpose(0, 1)


def assert_as_one_by_one(rollout, **kwargs):
    weights = rollout.returns, th.randn(rollout.returns.shape)
    before = list(rollout.policy.named_parameters(remove_duplicate=False))
    together = gradients_by_episode(rollout, *weights, **kwargs)
    alone = one_by_one(rollout, *weights)
    assert alone.abs().max() > 0
    after = rollout.policy.named_parameters(remove_duplicate=False)
    assert all(old is new for (_, old), (_, new) in zip(before, after, strict=True)), "the policy is as it was"
    th.testing.assert_close(together, alone, rtol=1e-4, atol=1e-4 * float(alone.abs().max()))
    part = gradients_by_episode(rollout, *weights, columns=slice(3, 6), **kwargs)
    th.testing.assert_close(part, together[..., 3:6])


@pytest.mark.parametrize(
    ("action_space", "chunk"),
    [
        *product([spaces.Discrete(3), BOX, spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)], [2**25]),
        (BOX, 1),
    ],
    ids=str,
)
def test_every_action_space_and_any_memory(action_space, chunk):
    """Short and long episodes, in environments that go on after their quota."""
    env = make_vec_env(lambda: Corridor((1, 7, 259), action_space=action_space), 2, seed=0)
    assert_as_one_by_one(collect(env), chunk=chunk)


class Branching(ActorCriticPolicy):
    """Its log π depends on all observations of a batch."""

    def evaluate_actions(self, obs, actions):
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        return values, log_prob * (2.0 if float(obs.sum()) > 0 else 1.0), entropy


class OneStd(ActorCriticPolicy):
    """Its actions have one standard deviation, a parameter without dimensions."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.log_std = th.nn.Parameter(th.tensor(-0.3))
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1))


IMAGES = {"screen_height": 36, "screen_width": 36, "n_channels": 1, "discrete": True}
POLICIES = {
    "temperature": lambda: collect(Corridor((2, 9)), temperature=0.3),
    "net_arch": lambda: collect(Corridor((2, 9)), policy_kwargs={"net_arch": [8, 8], "ortho_init": False}),
    "in place": lambda: collect(
        Corridor((2, 9)), policy_kwargs={"activation_fn": partial(th.nn.ReLU, inplace=True), "ortho_init": False}
    ),
    "gSDE": lambda: collect(Corridor((2, 9), action_space=BOX), use_sde=True),
    "images": lambda: collect(FakeImageEnv(**IMAGES), "CnnPolicy", n_episodes=2),
    "dicts": lambda: collect(SimpleMultiObsEnv(random_start=False), "MultiInputPolicy", n_episodes=2),
    "one standard deviation": lambda: collect(Corridor((2, 9), action_space=BOX), OneStd),
    "a method that branches": lambda: collect(Corridor((2, 9)), Branching),
}


@pytest.mark.parametrize("name", POLICIES)
def test_every_policy(name):
    assert_as_one_by_one(POLICIES[name]())


class Detached(ActorCriticPolicy):
    """Computes log π without a graph."""

    @th.no_grad()
    def evaluate_actions(self, obs, actions):
        return super().evaluate_actions(obs, actions)


def test_a_policy_without_a_gradient_is_named():
    rollout = collect(Corridor((2, 9)))
    detached = REINFORCE(Detached, Corridor((2, 9)), device="cpu").policy
    with pytest.raises(ValueError, match=r"Detached cannot be differentiated"):
        gradients_by_episode(replace(rollout, policy=detached), rollout.returns)


@pytest.mark.parametrize("wrong", [(), (1.0,), (th.ones(3),), (np.ones((11, 1)),)])
def test_wrong_weights_are_named(wrong):
    with pytest.raises(ValueError, match=r"weights must be tensors of the shape of rollout.used, \(\d+, 1\), got"):
        gradients_by_episode(collect(Corridor((2, 9))), *wrong)


def test_a_model_in_place_of_a_rollout_is_named():
    model = REINFORCE("MlpPolicy", Corridor((2, 9)), device="cpu")
    with pytest.raises(TypeError, match=r"rollout must be a Rollout, such as sample\(model, n_episodes\), got <"):
        gradients_by_episode(model, th.ones(3, 1))


@pytest.mark.parametrize("frozen", ["mlp_extractor.policy_net.0.weight", "action_net.bias", "log_std"])
def test_frozen_parameters_have_no_gradient(frozen):
    rollout = collect(Corridor((2, 9), action_space=BOX))
    whole = gradients_by_episode(rollout, rollout.returns).shape[-1]
    parameter = rollout.policy.get_parameter(frozen).requires_grad_(False)
    assert gradients_by_episode(rollout, rollout.returns).shape[-1] == whole - parameter.numel()
    assert_as_one_by_one(rollout)


def test_layers_that_share_a_parameter():
    rollout = collect(Corridor((2, 9)))
    net = rollout.policy.mlp_extractor.policy_net
    net[0], net[2] = th.nn.Linear(9, 9), th.nn.Linear(9, 9)
    net[2].weight, rollout.policy.action_net = net[0].weight, th.nn.Linear(9, 2)
    rollout.policy.optimizer = th.optim.Adam(rollout.policy.parameters())
    assert_as_one_by_one(rollout)


def test_memory_beside_the_result_is_bounded():
    """The widest intermediate has ``chunk`` floats, or as many as the result."""
    rollout, widest = collect("Pendulum-v1", n_episodes=2), []

    class Watch(th.utils._python_dispatch.TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            result = function(*args, **(kwargs or {}))
            widest.append(result.numel() if isinstance(result, th.Tensor) else 0)
            return result

    def peak(chunk):
        widest.clear()
        with Watch():
            n = gradients_by_episode(rollout, rollout.returns, chunk=chunk).shape[-1]
        return max(widest), n

    bounded, n = peak(1)
    assert bounded <= 2 * n < peak(2**25)[0]
