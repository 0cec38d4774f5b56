"""Gradients of log π along the episodes of a rollout: all at once, or from one backward pass for each episode."""

from collections.abc import Iterator
from functools import partial

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import flatten, select, take
from sb3_reinforce.estimation.mlp_scores import factored_layers, mlp_gradients
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.policies.evaluation import Parameters, log_prob_and_entropy, reached

# The most steps that share a gradient while they are summed: fewer would write more gradients
PIECE = 128
# Floats that the gradients of one chunk may take, 128 MiB in float32
CHUNK = 2**25


class LogProb(th.nn.Module):
    """
    log π(a|s) as the ``forward`` of a module, which is what ``torch.func`` differentiates.

    :param policy: The policy
    """

    def __init__(self, policy: ActorCriticPolicy):
        super().__init__()
        self.policy = policy
        self.names: dict[th.nn.Parameter, list[str]] = {}
        for prefix, module in self.named_modules():
            for name, parameter in module.named_parameters(recurse=False):
                self.names.setdefault(parameter, []).append(f"{prefix}.{name}")

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        log π(a|s), shape ``(n,)``.

        :param obs: ``n`` observations
        :param actions: As ``as_policy_actions`` gives them
        """
        return log_prob_and_entropy(self.policy, obs, actions)[0]

    def at(self, values: dict[th.nn.Parameter, th.Tensor], obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        log π(a|s) with other values of some parameters.

        :param values: Their values
        :param obs: ``n`` observations
        :param actions: ``n`` actions
        """
        by_name = {name: value for parameter, value in values.items() for name in self.names[parameter]}
        # Left to tie weights itself, torch does not put back those of a module with several names (a shared extractor)
        return th.func.functional_call(self, by_name, (obs, actions), tie_weights=False)  # type: ignore[no-any-return]


def gradients_by_episode(
    rollout: Rollout, *weights: th.Tensor, chunk: int = CHUNK, columns: slice = slice(None)
) -> th.Tensor:
    """
    ``Σ_t w_t ∇θ log π(a_t|s_t)`` over the used steps of each episode, for each of k weights: ``episode_gradients``
    without a backward pass an episode.

    For a plain MLP see ``mlp_scores``. Otherwise episodes are cut into pieces of equal length, whose vector-Jacobian
    products ``torch.func.vmap`` takes side by side. A policy that it cannot trace (one that branches on its data, say)
    is differentiated episode by episode instead.

    :param rollout: The rollout, with m episodes that have used steps
    :param weights: k times w_t, each of shape ``(n_steps, n_envs)``
    :param chunk: Floats that an intermediate may take besides the result; memory, not the result, depends on it
    :param columns: The components of θ that are kept, n in number; the others cost time, and no memory
    :return: Shape ``(k, m, n)``; θ as in ``episode_gradients``
    :raises ValueError: If log π does not depend on any parameter in a way that can be differentiated
    """
    policy, used = rollout.policy, rollout.used
    parameters, layers = scored_parameters(rollout), factored_layers(policy)
    if layers is not None:
        return mlp_gradients(rollout, layers, parameters, weights, chunk, columns)
    obs = select(rollout.observations, used)
    actions = as_policy_actions(select(rollout.actions, used), policy.action_space)
    episode, slots, filled = pieces_of(rollout.episodes[used])
    w = th.stack([select(weight, used) for weight in weights]).to(parameters[0])
    w = (w[:, slots] * filled.to(w)).transpose(0, 1)
    n_parameters = sum(parameter.numel() for parameter in parameters)
    products_of = th.func.vmap(partial(vector_jacobian_products, LogProb(policy), parameters))
    try:
        # One step: an error of the policy's own comes again below, and memory cannot run out
        products_of(take(obs, slots[:1, :1]), actions[slots[:1, :1]], w[:1, :, :1])
    except RuntimeError:
        one_by_one = episode_gradients(rollout, *weights)
        return th.stack([th.stack(gradients)[:, columns].clone() for gradients in one_by_one], dim=1)
    result = w.new_zeros(len(weights), int(episode[-1]) + 1, len(range(n_parameters)[columns]))
    rows = max(1, chunk // (len(weights) * n_parameters))
    for begin in range(0, len(slots), rows):
        part = slice(begin, begin + rows)
        products = products_of(take(obs, slots[part]), actions[slots[part]], w[part])
        result.index_add_(1, episode[part].to(result.device), products[..., columns].transpose(0, 1))
    return result


def pieces_of(episodes: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """
    Cut episodes into pieces of one length, at most ``PIECE``, the last of an episode padded.

    :param episodes: The episode that each used step belongs to, shape ``(n_used,)``
    :return: The rank of the episode of each piece, shape ``(p,)``; the steps of each piece, shape ``(p, length)``; and
        which of these are not padding
    """
    _, rank, lengths = th.unique(episodes, return_inverse=True, return_counts=True)
    order = rank.argsort(stable=True)
    place = th.arange(len(order)) - (lengths.cumsum(0) - lengths)[rank[order]]
    # Longer than the mean episode, most of a piece would be padding
    length = int(lengths.double().mean().ceil().clamp(max=PIECE))
    n_pieces = (lengths + length - 1) // length
    piece = (n_pieces.cumsum(0) - n_pieces)[rank[order]] + place // length
    slots = th.zeros(int(n_pieces.sum()), length, dtype=th.long)
    filled = th.zeros_like(slots, dtype=th.bool)
    slots[piece, place % length] = order
    filled[piece, place % length] = True
    return th.repeat_interleave(n_pieces), slots, filled


def vector_jacobian_products(
    log_prob: LogProb, parameters: Parameters, obs: PyTorchObs, actions: th.Tensor, weights: th.Tensor
) -> th.Tensor:
    """
    ``wᵀ ∂ log π / ∂θ`` for each of k weights, from one forward pass.

    :param log_prob: log π
    :param parameters: θ
    :param obs: ``n`` observations
    :param actions: ``n`` actions
    :param weights: Shape ``(k, n)``
    :return: Shape ``(k, n_parameters)``
    """
    values = [parameter.detach() for parameter in parameters]
    vjp = th.func.vjp(lambda theta: log_prob.at(dict(zip(parameters, theta, strict=True)), obs, actions), values)[1]
    (products,) = th.func.vmap(vjp)(weights)
    return th.cat([product.flatten(1) for product in products], dim=1)


def score_parameters(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> Parameters:
    """
    The trainable parameters that log π depends on, in the order of ``policy.parameters()``.

    :param policy: The policy
    :param obs: ``n`` observations
    :param actions: As ``as_policy_actions`` gives them
    :raises ValueError: If there are none
    """
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    depends = reached(log_prob_and_entropy(policy, obs, actions)[0], parameters)
    if not any(depends):
        raise ValueError(
            f"log π of {type(policy).__name__} cannot be differentiated: it depends on none of the policy's "
            f"{len(parameters)} trainable parameters (is it computed under no_grad, or detached?)"
        )
    return [parameter for parameter, used in zip(parameters, depends, strict=True) if used]


def scored_parameters(rollout: Rollout) -> Parameters:
    """
    ``score_parameters`` of the policy that made a rollout, from its first step.

    :param rollout: The rollout
    :raises ValueError: If there are none
    """
    first = th.arange(1)
    actions = as_policy_actions(take(flatten(rollout.actions), first), rollout.policy.action_space)
    return score_parameters(rollout.policy, take(flatten(rollout.observations), first), actions)


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
