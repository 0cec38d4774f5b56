"""
How a policy acts while a rollout is collected: as a few NumPy operations if it is a plain MLP, else by its own methods.

Both take the same actions for the same seed, up to rounding: the first draws its noise as PyTorch's distributions do.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.policies.evaluation import must_call
from sb3_reinforce.policies.plain_mlp import HOOKS, Float32s, numpy_forward, numpy_layers

# Actions (n_envs, *shape); and V(s) and log π(a|s) (n_envs,) if they come along with the actions
Acted: TypeAlias = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]


class PolicyActor:
    """Acts by the policy's own methods."""

    def __init__(self, policy: ActorCriticPolicy, calls_forward: bool, with_log_prob: bool):
        self.policy = policy
        self.calls_forward = calls_forward
        self.with_log_prob = with_log_prob
        self.shape = policy.action_space.shape or ()

    @th.no_grad()
    def act(self, obs: Any) -> Acted:
        """Draw actions for observations of ``n_envs`` environments."""
        obs = obs_as_tensor(obs, self.policy.device)
        if not self.calls_forward:
            distribution = self.distribution(obs)
            actions = distribution.get_actions()
            log_prob = distribution.log_prob(actions).cpu().numpy() if self.with_log_prob else None
            return actions.cpu().numpy().reshape(-1, *self.shape), None, log_prob
        actions, values, log_prob = self.policy(obs)
        return actions.cpu().numpy().reshape(-1, *self.shape), values.cpu().numpy(), log_prob.cpu().numpy()

    def distribution(self, obs: Any) -> Distribution:
        """π(·|s) for observations of ``n_envs`` environments."""
        return self.policy.get_distribution(obs)

    def is_current(self, policy: ActorCriticPolicy) -> bool:
        """Whether the policy would still act as this actor does."""
        return policy is self.policy and (self.calls_forward or not must_call(policy, "forward"))


class NumpyActor:
    """Acts by NumPy, for a plain MLP on flat observations."""

    def __init__(
        self, policy: ActorCriticPolicy, layers: list[nn.Module], n_envs: int, with_log_prob: bool, *before: nn.Module
    ):
        self.policy = policy
        self.with_log_prob = with_log_prob
        self.shape = (n_envs, *(policy.action_space.shape or ()))
        self.forward = numpy_forward(layers, n_envs)
        self.sample = sampler_of(policy, n_envs)
        self.outputs: list[Float32s] = []
        self.log_stds: list[Float32s] = []
        # The rest is what is_current compares
        self.layers = layers
        self.addresses = addresses_of(policy, layers)
        self.action_dist = policy.action_dist
        self.mlp_extractor = policy.mlp_extractor
        self.extractor = [policy.pi_features_extractor, *policy.pi_features_extractor.children()]
        self.body = policy.mlp_extractor.policy_net
        parts = [policy, self.mlp_extractor, self.body, *self.extractor, *before, *layers]
        hooks = [vars(part)[name] for part in parts for name in HOOKS]
        self.dicts = [vars(self.action_dist), *map(vars, parts), *hooks]
        self.n_entries = sum(map(len, self.dicts))

    def act(self, obs: Any) -> Acted:
        outputs = self.forward(obs)
        if self.with_log_prob:
            # Copies, since a callback may change the parameters in place
            self.outputs.append(outputs.copy())
            if isinstance(self.action_dist, DiagGaussianDistribution):
                self.log_stds.append(np.broadcast_to(self.policy.log_std.detach().numpy(), outputs.shape).copy())
        return self.sample(outputs).reshape(self.shape), None, None

    @th.no_grad()
    def log_prob(self, actions: np.ndarray) -> np.ndarray:
        """log π(a|s) of all ``n_steps`` steps, shape ``(n_steps * n_envs,)``."""
        outputs = th.as_tensor(np.concatenate(self.outputs))
        rows = as_policy_actions(th.as_tensor(actions).flatten(0, 1), self.policy.action_space)
        log_std = [th.as_tensor(np.concatenate(self.log_stds))] if self.log_stds else []
        log_prob: th.Tensor = self.action_dist.proba_distribution(outputs, *log_std).log_prob(rows)
        return log_prob.numpy()

    def is_current(self, policy: ActorCriticPolicy) -> bool:
        # A hook or a replaced method adds an entry to a dict; other parts and parameters are other objects
        return (
            policy is self.policy
            and sum(map(len, self.dicts)) == self.n_entries
            and policy.action_dist is self.action_dist
            and [policy.pi_features_extractor, *policy.pi_features_extractor.children()] == self.extractor
            and policy.mlp_extractor is self.mlp_extractor
            and policy.mlp_extractor.policy_net is self.body
            and [*self.body, policy.action_net] == self.layers
            and addresses_of(policy, self.layers) == self.addresses
        )


Actor: TypeAlias = PolicyActor | NumpyActor


def addresses_of(policy: ActorCriticPolicy, layers: list[nn.Module]) -> list[int]:
    """Where the parameters of an actor lie in memory."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    tensors = [tensor for layer in linear for tensor in (layer.weight, layer.bias)]
    if isinstance(policy.action_dist, DiagGaussianDistribution):
        tensors.append(policy.log_std)
    return [tensor.data_ptr() for tensor in tensors]


def make_actor(policy: ActorCriticPolicy, calls_forward: bool, n_envs: int, with_log_prob: bool) -> Actor:
    """The fastest actor that acts as the policy would; it may leave out log π without ``with_log_prob``."""
    # forward returns V too
    layers = None if calls_forward else numpy_layers(policy)
    if layers is not None:
        return NumpyActor(policy, layers, n_envs, with_log_prob)
    return PolicyActor(policy, calls_forward, with_log_prob)


def sampler_of(policy: ActorCriticPolicy, n_envs: int) -> Callable[[Float32s], np.ndarray]:
    """
    Draws actions from logits or means of shape ``(n_envs, width)``.

    It takes the same numbers from PyTorch's generator, in the same form and order, as the distributions do.
    """
    distribution = policy.action_dist
    if isinstance(distribution, DiagGaussianDistribution):
        return gaussian_sampler(policy.log_std, n_envs, distribution.action_dim)
    if isinstance(distribution, BernoulliDistribution):
        return lambda logits: th.bernoulli(th.from_numpy(logits).sigmoid()).numpy()
    if isinstance(distribution, CategoricalDistribution):
        return categorical_sampler(n_envs, distribution.action_dim)
    assert isinstance(distribution, MultiCategoricalDistribution)
    samplers = [categorical_sampler(n_envs, dim) for dim in distribution.action_dims]
    cuts = np.cumsum(distribution.action_dims)[:-1]

    def sample(logits: Float32s) -> np.ndarray:
        parts = np.split(logits, cuts, axis=1)
        return np.stack([draw(part) for draw, part in zip(samplers, parts, strict=True)], axis=1)

    return sample


def gaussian_sampler(log_std: th.Tensor, n_envs: int, width: int) -> Callable[[Float32s], Float32s]:
    """``a = mean + σ ε`` with normal ε."""
    noise = th.empty(n_envs, width, dtype=th.float32)
    epsilon = noise.numpy()
    log_sigma = log_std.detach().numpy()
    sigma = np.empty_like(log_sigma)

    def sample(means: Float32s) -> Any:
        noise.normal_()
        np.exp(log_sigma, sigma)
        np.multiply(epsilon, sigma, epsilon)
        return means + epsilon

    return sample


def categorical_sampler(n_envs: int, n_actions: int) -> Callable[[Float32s], np.ndarray]:
    """``a = argmax_i (logits_i − log E_i)`` with exponential E: the Gumbel-max trick (Gumbel, 1954)."""
    noise = th.empty(n_envs, n_actions, dtype=th.float32)
    scores = noise.numpy()

    def sample(logits: Float32s) -> Any:
        noise.exponential_()
        np.log(scores, scores)
        np.subtract(logits, scores, scores)
        return scores.argmax(1)

    return sample
