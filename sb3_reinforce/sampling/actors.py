"""
How a policy acts while a rollout is collected.

``GeneralActor`` asks the policy itself, whatever it is. ``LaidOutActor`` is the same actor for the usual case, a
plain MLP on flat observations, as a few NumPy operations. Both draw from the same distribution, but not the same
actions for the same seed: the laid-out one draws its noise for many steps at once, in the form that the distribution
needs.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeAlias, cast

import numpy as np
import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import flatten
from sb3_reinforce.policies.evaluation import distribution_of, log_prob_and_entropy, tells_values
from sb3_reinforce.policies.passes import Floats, lay_out
from sb3_reinforce.policies.plain_mlp import actor_layers

# Actions (n_envs, *shape), and V(s) and log π(a|s) (n_envs,) where the policy has told them
Acted: TypeAlias = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]

# Actions for which noise is drawn at once
NOISE_ROWS = 1024


class GeneralActor:
    """
    Acts through the policy: through its ``forward`` where that is to tell V too, else through the actor alone.

    :param policy: Any policy
    :param with_values: Whether to tell V(s) and log π(a|s) along with the actions
    """

    def __init__(self, policy: ActorCriticPolicy, with_values: bool):
        self.policy, self.with_values = policy, with_values
        self.device, self.shape = policy.device, policy.action_space.shape or ()

    @th.no_grad()
    def act(self, obs: Any) -> Acted:
        """
        Draw actions.

        :param obs: Observations of ``n_envs`` environments, an array or a dict of arrays
        """
        obs = obs_as_tensor(obs, self.device)
        if not self.with_values:
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
    :param layers: Its layers, as ``actor_layers`` gives them, with the parameters that they have now
    :param n_envs: Number of observations at a time
    """

    def __init__(self, policy: ActorCriticPolicy, layers: list[th.nn.Module], n_envs: int):
        self.policy, self.shape = policy, (n_envs, *(policy.action_space.shape or ()))
        self.forward = lay_out(layers, n_envs)
        self.sample, self.noise = make_sampler(policy), make_noise(policy, n_envs)
        self.outputs: list[Floats] = []

    def act(self, obs: Any) -> Acted:
        """
        Draw actions, and keep the logits or means that they are drawn from.

        :param obs: Observations of ``n_envs`` environments
        """
        outputs = self.forward(obs)
        self.outputs.append(outputs)
        return self.sample(outputs, next(self.noise)).reshape(self.shape), None, None

    @th.no_grad()
    def log_prob(self, obs: Any, actions: np.ndarray) -> np.ndarray:
        """
        log π(a|s) of all that was done, from the logits or means that were kept.

        :param obs: Not needed
        :param actions: All actions, shape ``(n_steps, n_envs, action_dim)``
        :return: Shape ``(n_steps * n_envs,)``
        """
        outputs = th.as_tensor(np.concatenate(self.outputs), device=self.policy.device)
        steps = as_policy_actions(th.as_tensor(actions).flatten(0, 1).to(outputs.device), self.policy.action_space)
        return distribution_of(self.policy, outputs).log_prob(steps).cpu().numpy()


def make_actor(policy: ActorCriticPolicy, n_envs: int, with_critic: bool) -> GeneralActor | LaidOutActor:
    """
    The fastest way to act with a policy, as long as its parameters stay as they are.

    :param policy: The policy
    :param n_envs: Number of observations at a time
    :param with_critic: Whether V(s) will be needed
    """
    layers = actor_layers(policy)
    if layers is None:
        return GeneralActor(policy, tells_values(policy, with_critic))
    return LaidOutActor(policy, layers, n_envs)


def make_noise(policy: ActorCriticPolicy, n_envs: int) -> Iterator[Floats]:
    """
    The noise of each step, from PyTorch's generator.

    Gumbel noise ``−log E`` with E exponential for categorical actions, logistic ``log(u / (1 − u))`` for binary ones,
    ``σ · normal`` for Gaussian ones.

    :param policy: The policy
    :param n_envs: Number of environments
    :return: Arrays of shape ``(n_envs, width)``, without end; ``width`` is the number of logits or means
    """
    size = (max(1, NOISE_ROWS // n_envs), n_envs, cast(th.nn.Linear, policy.action_net).out_features)
    while True:
        if isinstance(policy.action_dist, DiagGaussianDistribution):
            yield from (th.randn(size) * policy.log_std.detach().exp().cpu()).numpy()
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
        return np.add
    if isinstance(distribution, BernoulliDistribution):
        return lambda logits, logistic: (logits + logistic > 0).astype(np.float32)
    if isinstance(distribution, CategoricalDistribution):
        return lambda logits, gumbel: (logits + gumbel).argmax(axis=1)
    cuts = np.cumsum(cast(MultiCategoricalDistribution, distribution).action_dims)[:-1]
    return lambda logits, gumbel: np.stack(
        [part.argmax(axis=1) for part in np.split(logits + gumbel, cuts, axis=1)], axis=1
    )
