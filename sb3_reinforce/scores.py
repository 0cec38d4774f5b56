"""Gradients of log π along the episodes of a rollout, from one backward pass an episode."""

from collections.abc import Iterator

import torch as th

from sb3_reinforce.policies import as_policy_actions, log_prob_and_entropy
from sb3_reinforce.rollouts import Rollout, select


def episode_gradients(rollout: Rollout, *weights: th.Tensor) -> Iterator[tuple[th.Tensor, ...]]:
    """
    ``Σ_t w_t ∇θ log π(a_t|s_t)`` over the used steps of each episode, for each of some weights.

    θ is all that log π depends on, in the order of ``policy.parameters()``.

    :param rollout: The rollout
    :param weights: w_t, each of shape ``(n_steps, n_envs)``
    :return: For each episode with used steps, a vector ``(n,)`` for each of the weights
    """
    policy, episodes = rollout.policy, rollout.episodes
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    for episode in th.unique(episodes[rollout.used]):
        steps = rollout.used & (episodes == episode)
        actions = as_policy_actions(select(rollout.actions, steps), policy.action_space)
        log_prob, _ = log_prob_and_entropy(policy, select(rollout.observations, steps), actions)
        yield tuple(
            flat(th.autograd.grad(log_prob, parameters, w[steps].to(log_prob), retain_graph=True, allow_unused=True))
            for w in weights
        )


def flat(gradients: tuple[th.Tensor | None, ...]) -> th.Tensor:
    """
    The gradients of some parameters as one vector.

    :param gradients: Gradients; None where nothing depends on the parameter
    """
    return th.cat([gradient.flatten() for gradient in gradients if gradient is not None])
