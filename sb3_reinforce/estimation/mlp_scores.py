"""
Gradients of log π by episode for an actor that is a plain MLP: from the factors of each step's score.

A linear layer ``z = W x + b`` has the score ``δ xᵀ`` for W and δ for b, with ``δ = ∂ log π / ∂z`` (Goodfellow, 2015,
"Efficient per-example gradient computations"). So one forward and one backward pass give the factors of all steps, and
``Σ_t w_t ∇θ log π(a_t|s_t)`` is one matrix product for each layer and episode, for any number of weights w.
"""

from typing import TypeAlias

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import select
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.policies.backpropagation import activations, deltas, divided, parameters_of
from sb3_reinforce.policies.evaluation import Parameters
from sb3_reinforce.policies.plain_mlp import actor_layers, overrides

# Steps that share a forward and a backward pass: what they leave behind is to stay in the cache
STEPS = 4096

# δ (n, n_out), and x (n, n_in) or None for a parameter that is added to what δ belongs to
Factors: TypeAlias = tuple[th.Tensor, th.Tensor | None]


def factored_layers(policy: ActorCriticPolicy) -> list[th.nn.Module] | None:
    """
    The actor's layers, if the scores of its parameters have factors.

    :param policy: The policy
    :return: As ``actor_layers``; None also where ``evaluate_actions`` is overridden
    """
    return None if overrides(policy, "evaluate_actions") else actor_layers(policy)


def mlp_gradients(
    rollout: Rollout,
    layers: list[th.nn.Module],
    parameters: Parameters,
    weights: tuple[th.Tensor, ...],
    chunk: int,
    columns: slice,
) -> th.Tensor:
    """
    ``gradients_by_episode`` for a plain MLP.

    :param rollout: The rollout, with m episodes that have used steps
    :param layers: As ``factored_layers`` gives them
    :param parameters: θ
    :param weights: k times w_t, each of shape ``(n_steps, n_envs)``
    :param chunk: Floats that an intermediate result may take
    :param columns: The components of θ that are kept
    :return: Shape ``(k, m, n)``
    """
    used, policy = rollout.used, rollout.policy
    rank, order = th.unique(rollout.episodes[used], return_inverse=True)[1].sort(stable=True)
    obs = select(rollout.observations, used).flatten(1).float()  # type: ignore[union-attr]
    actions = as_policy_actions(select(rollout.actions, used), policy.action_space)
    kept = range(sum(parameter.numel() for parameter in parameters))[columns]
    w = th.stack([select(weight, used) for weight in weights]).to(parameters[0])
    result = w.new_zeros(len(w), int(rank[-1]) + 1, len(kept))
    widest = max(parameter.shape[0] for parameter in parameters)
    at_once = max(1, min(STEPS, chunk // (len(w) * widest)))
    for steps, ranks in zip(order.split(at_once), rank.split(at_once), strict=True):
        shares = factors(policy, layers, parameters, obs[steps], actions[steps])
        episodes, lengths = ranks.unique_consecutive(return_counts=True)
        end = 0
        for episode, length in zip(episodes.tolist(), lengths.tolist(), strict=True):
            span, end = slice(end, end + length), end + length
            part = w[:, steps[span]]
            products = [weighted_sum(part, delta[span], None if x is None else x[span]) for delta, x in shares]
            result[:, episode] += th.cat(products, dim=1)[:, columns]
    return result


def factors(
    policy: ActorCriticPolicy,
    layers: list[th.nn.Module],
    parameters: Parameters,
    obs: th.Tensor,
    actions: th.Tensor,
) -> list[Factors]:
    """
    The factors of the score of each step, for each parameter.

    :param policy: The policy
    :param layers: Its actor's layers
    :param parameters: θ
    :param obs: Shape ``(n, n_features)``
    :param actions: ``n`` actions
    """
    with th.no_grad():
        xs = activations(layers, obs)
    outputs, log_std = xs[-1].requires_grad_(), []
    if isinstance(policy.action_dist, DiagGaussianDistribution):
        log_std = [policy.log_std.detach().expand_as(outputs).requires_grad_()]
    log_prob = policy.action_dist.proba_distribution(divided(layers, outputs), *log_std).log_prob(actions)
    delta, *delta_std = th.autograd.grad(log_prob.sum(), [outputs, *log_std])
    found: dict[th.Tensor, Factors] = {}
    weights, biases = parameters_of(layers)[::2], parameters_of(layers)[1::2]
    with th.no_grad():
        shares = deltas(layers, weights, xs, delta)
        for weight, bias, (d, x) in zip(reversed(weights), reversed(biases), shares, strict=True):
            found[weight], found[bias] = (d, x), (d, None)
    if delta_std:
        found[policy.log_std] = (delta_std[0], None)
    return [found[parameter] for parameter in parameters]


def weighted_sum(w: th.Tensor, delta: th.Tensor, x: th.Tensor | None) -> th.Tensor:
    """
    ``Σ_t w_t δ_t x_tᵀ``, or ``Σ_t w_t δ_t``, for each of k weights.

    :param w: Shape ``(k, n)``
    :param delta: Shape ``(n, n_out)``
    :param x: Shape ``(n, n_in)`` or None
    :return: Shape ``(k, n_out * n_in)`` or ``(k, n_out)``
    """
    if x is None:
        return w @ delta
    # The narrower factor takes the weights
    if delta.shape[1] <= x.shape[1]:
        return ((w[:, None] * delta.T).flatten(0, 1) @ x).view(len(w), -1)
    products = delta.T @ (w.T[:, :, None] * x[:, None]).flatten(1)
    return products.view(-1, len(w), x.shape[1]).transpose(0, 1).flatten(1)
