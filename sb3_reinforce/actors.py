"""
How a policy acts while a rollout is collected.

``GeneralActor`` asks the policy itself, whatever it is. ``LaidOutActor`` is the same actor for the usual case, a
plain MLP on flat observations, as a few NumPy operations: on a handful of observations PyTorch's modules and
distributions take far longer than the arithmetic. Both draw from the same distribution, but not the same actions for
the same seed: the laid-out one draws its noise for many steps at once, in the form that the distribution needs.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeAlias, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.policies import as_policy_actions, log_prob_and_entropy, overrides
from sb3_reinforce.rollouts import flatten

Floats: TypeAlias = NDArray[np.float32]
# Actions (n_envs, *shape), and V(s) and log π(a|s) (n_envs,) where the policy has told them
Acted: TypeAlias = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]

# What a subclass may have changed on the way from an observation to an action
ACTOR_METHODS = ("forward", "extract_features", "get_distribution", "_get_action_dist_from_latent")
# Actions for which noise is drawn at once
NOISE_ROWS = 1024
# Products beyond which NumPy's BLAS starts threads of its own, whatever number the user has set for PyTorch
ONE_THREAD = 2**18


class GeneralActor:
    """
    Acts through the policy: through its ``forward`` if it has one of its own, else through the actor alone.

    :param policy: Any policy
    """

    def __init__(self, policy: ActorCriticPolicy):
        self.policy, self.device, self.shape = policy, policy.device, policy.action_space.shape or ()
        self.has_own_forward = overrides(policy, "forward")

    @th.no_grad()
    def act(self, obs: Any) -> Acted:
        """
        Draw actions.

        :param obs: Observations of ``n_envs`` environments, an array or a dict of arrays
        """
        obs = obs_as_tensor(obs, self.device)
        if not self.has_own_forward:
            return self.policy.get_distribution(obs).get_actions().cpu().numpy().reshape(-1, *self.shape), None, None
        actions, values, log_prob = self.policy(obs)
        return actions.cpu().numpy().reshape(-1, *self.shape), values.cpu().numpy(), log_prob.cpu().numpy()

    @th.no_grad()
    def log_prob(self, obs: Any, actions: np.ndarray) -> np.ndarray:
        """
        log π(a|s) of all that was done, in one batch: the parameters do not change during a rollout.

        :param obs: All observations, shape ``(n_steps, n_envs, ...)`` or a dict of such arrays
        :param actions: All actions, shape ``(n_steps, n_envs, action_dim)``
        :return: Shape ``(n_steps * n_envs,)``
        """
        steps = as_policy_actions(th.as_tensor(actions, device=self.device).flatten(0, 1), self.policy.action_space)
        return log_prob_and_entropy(self.policy, flatten(obs_as_tensor(obs, self.device)), steps)[0].cpu().numpy()


class LaidOutActor:
    """
    Acts by NumPy: the layers one after the other, and noise drawn beforehand.

    :param policy: A policy whose actor is a plain MLP
    :param layers: Its layers, as ``plain_layers`` gives them, with the parameters that they have now
    :param n_envs: Number of observations at a time
    """

    def __init__(self, policy: ActorCriticPolicy, layers: list[th.nn.Module], n_envs: int):
        self.policy, self.shape = policy, (n_envs, *(policy.action_space.shape or ()))
        self.functions = [as_function(layer, n_envs) for layer in layers]
        self.sample, self.noise = make_sampler(policy), make_noise(policy, n_envs)
        self.outputs: list[Floats] = []

    def act(self, obs: Any) -> Acted:
        """
        Draw actions, and keep the logits or means that they are drawn from.

        :param obs: Observations of ``n_envs`` environments
        """
        x = obs.reshape(len(obs), -1).astype(np.float32, copy=False)
        for function in self.functions:
            x = function(x)
        self.outputs.append(x)
        return self.sample(x, next(self.noise)).reshape(self.shape), None, None

    @th.no_grad()
    def log_prob(self, obs: Any, actions: np.ndarray) -> np.ndarray:
        """
        log π(a|s) of all that was done, from the logits or means that were kept.

        :param obs: Not needed
        :param actions: All actions, shape ``(n_steps, n_envs, action_dim)``
        :return: Shape ``(n_steps * n_envs,)``
        """
        distribution, outputs = self.policy.action_dist, th.as_tensor(np.concatenate(self.outputs))
        steps = as_policy_actions(th.as_tensor(actions).flatten(0, 1), self.policy.action_space)
        log_std = [self.policy.log_std.cpu()] if isinstance(distribution, DiagGaussianDistribution) else []
        return distribution.proba_distribution(outputs, *log_std).log_prob(steps).numpy()


def make_actor(policy: ActorCriticPolicy, n_envs: int) -> GeneralActor | LaidOutActor:
    """
    The fastest way to act with a policy, as long as its parameters stay as they are.

    :param policy: The policy
    :param n_envs: Number of observations at a time
    """
    layers = plain_layers(policy)
    return GeneralActor(policy) if layers is None else LaidOutActor(policy, layers, n_envs)


def plain_layers(policy: ActorCriticPolicy) -> list[th.nn.Module] | None:
    """
    The actor's layers, if all that it does is to apply linear layers, tanh and ReLU to flat observations.

    :param policy: The policy
    :return: The layers from the observation to the parameters of the action distribution; None if the policy is another
        kind, is compiled, overrides a method on the way, or carries forward hooks
    """
    if any(overrides(policy, method) for method in ACTOR_METHODS) or type(policy.mlp_extractor) is not MlpExtractor:
        return None
    space, extractor = policy.observation_space, policy.pi_features_extractor
    layers = [*policy.mlp_extractor.policy_net, policy.action_net]
    is_plain = (
        isinstance(space, spaces.Box)
        and not is_image_space(space)
        and type(extractor) is FlattenExtractor
        and not policy.use_sde
        and all(type(layer) in (th.nn.Linear, th.nn.Tanh, th.nn.ReLU) for layer in layers)
        and not any(module._forward_hooks or module._forward_pre_hooks for module in (policy, extractor, *layers))
    )
    return layers if is_plain else None


def as_function(layer: th.nn.Module, n: int) -> Callable[[Floats], Floats]:
    """
    A layer as a function of arrays of shape ``(n, n_in)``.

    :param layer: ``Linear``, ``Tanh`` or ``ReLU``
    :param n: Number of rows
    """
    if isinstance(layer, th.nn.Linear):
        weight, bias = layer.weight.detach().T.contiguous().cpu(), layer.bias.detach().cpu()
        if n * weight.numel() > ONE_THREAD:
            return lambda x: th.addmm(bias, th.as_tensor(x), weight).numpy()
        weights, biases = weight.numpy(), bias.numpy()
        return lambda x: x @ weights + biases
    return np.tanh if isinstance(layer, th.nn.Tanh) else lambda x: np.maximum(x, 0)


def make_noise(policy: ActorCriticPolicy, n_envs: int) -> Iterator[Floats]:
    """
    The noise of each step, from PyTorch's generator.

    Gumbel noise ``−log E`` with E exponential for categorical actions, logistic ``log(u / (1 − u))`` for binary ones,
    normal noise for Gaussian ones.

    :param policy: The policy
    :param n_envs: Number of environments
    :return: Arrays of shape ``(n_envs, width)``, without end; ``width`` is the number of logits or means
    """
    size = (max(1, NOISE_ROWS // n_envs), n_envs, cast(th.nn.Linear, policy.action_net).out_features)
    while True:
        if isinstance(policy.action_dist, DiagGaussianDistribution):
            yield from th.randn(size).numpy()
        elif isinstance(policy.action_dist, BernoulliDistribution):
            yield from th.rand(size).logit_().numpy()
        else:
            yield from th.empty(size).exponential_().log_().neg_().numpy()


def make_sampler(policy: ActorCriticPolicy) -> Callable[[Floats, Floats], np.ndarray]:
    """
    How parameters of the action distribution and noise, both ``(n_envs, width)``, become actions.

    ``argmax(logits + Gumbel)`` is categorical (Gumbel, 1954), ``logits + logistic > 0`` is Bernoulli with the logits'
    probability, and ``mean + σ · normal`` is Gaussian.

    :param policy: The policy
    """
    distribution = policy.action_dist
    if isinstance(distribution, DiagGaussianDistribution):
        std = policy.log_std.detach().exp().cpu().numpy()
        return lambda mean, normal: mean + std * normal
    if isinstance(distribution, BernoulliDistribution):
        return lambda logits, logistic: (logits + logistic > 0).astype(np.float32)
    if isinstance(distribution, CategoricalDistribution):
        return lambda logits, gumbel: (logits + gumbel).argmax(axis=1)
    cuts = np.cumsum(cast(MultiCategoricalDistribution, distribution).action_dims)[:-1]
    return lambda logits, gumbel: np.stack(
        [part.argmax(axis=1) for part in np.split(logits + gumbel, cuts, axis=1)], axis=1
    )
