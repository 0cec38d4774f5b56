"""
Sums of weighted scores, ``Σ_t w_t ∇θ log π(a_t|s_t)``, for each episode of a rollout.

For a plain MLP they follow from the factors of each step's score: a linear layer ``z = W x + b`` has the score ``δ xᵀ``
for W and δ for b, with ``δ = ∂ log π / ∂z`` (Goodfellow, 2015, "Efficient per-example gradient computations"). One
forward and one backward pass give the factors of all steps, and the sum is one matrix product for each layer and
episode. Other policies take one backward pass for each episode and weight.
"""

from collections.abc import Iterator
from typing import TypeAlias

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_reinforce.common.arguments import check_kind
from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import flatten, select, take, to_vector
from sb3_reinforce.estimation.rollout import Rollout, used_inputs
from sb3_reinforce.policies.evaluation import (
    Parameters,
    actor_parameters,
    extract_features,
    leave_no_graph,
    log_prob_of,
    trainable,
)
from sb3_reinforce.policies.plain_mlp import plain_actor, temperature_hook

# Floats that an intermediate result may take, 128 MiB in float32
CHUNK = 2**25
# Steps that share a forward and a backward pass: their activations and gradients should fit into the cache
STEPS = 4096

# δ (n, n_out) and x (n, n_in), which is 1 for a parameter that is added to z
Factors: TypeAlias = tuple[th.Tensor, th.Tensor]


def gradients_by_episode(
    rollout: Rollout, *weights: th.Tensor, chunk: int = CHUNK, columns: slice = slice(None)
) -> th.Tensor:
    """
    ``Σ_t w_t ∇θ log π(a_t|s_t)`` over the used steps of each episode, for each of k weights.

    θ are the trainable parameters that log π of the rollout's first step depends on, in the order of
    ``policy.parameters()``. For Box actions ``log_std`` comes first, which the θ of a search and of ``landscape``
    lacks.

    :param rollout: The rollout, with m episodes that have used steps
    :param weights: k times w_t, each of shape ``(n_steps, n_envs)``
    :param chunk: Floats that an intermediate result may take; the result does not depend on it
    :param columns: The components of θ to return, n in number
    :return: Shape ``(k, m, n)``, in the dtype and on the device of the parameters; the episodes are in ascending order
    :raises TypeError: If ``rollout`` is not a ``Rollout``
    :raises ValueError: If there are no weights or they have another shape, or log π does not depend on any parameter
        in a way that can be differentiated
    """
    check_kind("rollout", rollout, (Rollout,), "a Rollout, such as sample(model, n_episodes)")
    shape = rollout.used.shape
    wrong = [weight for weight in weights if not isinstance(weight, th.Tensor) or weight.shape != shape]
    if wrong or not weights:
        got = [tuple(each.shape) if isinstance(each, th.Tensor) else each for each in weights] or "none"
        raise ValueError(f"weights must be tensors of the shape of rollout.used, {tuple(shape)}, got {got}")

    parameters = parameters_of(rollout)
    w = th.stack([select(weight, rollout.used) for weight in weights]).to(parameters[0])
    _, episode = th.unique(rollout.episodes[rollout.used], return_inverse=True)
    n = len(range(sum(parameter.numel() for parameter in parameters))[columns])
    result = w.new_zeros(len(w), int(episode.max()) + 1, n)
    layers = factored_layers(rollout.policy)
    if layers is None:
        sums = sums_by_backward_passes(rollout, parameters, w, episode)
    else:
        sums = sums_by_factors(rollout, parameters, layers, w, episode, chunk)
    # A compiled network cannot be differentiated for several weights
    with th.compiler.set_stance("force_eager"):
        for number, gradients in sums:
            result[:, number] += gradients[:, columns]
    leave_no_graph(rollout.policy, *first_step(rollout))
    return result


def gradient_blocks(rollout: Rollout, *weights: th.Tensor, floats: int = 2 * CHUNK) -> Iterator[th.Tensor]:
    """``gradients_by_episode`` in blocks ``(k, m, c)`` of c components of θ, at most ``floats`` numbers each."""
    n_parameters = sum(parameter.numel() for parameter in parameters_of(rollout))
    n_columns = max(1, floats // (len(weights) * len(rollout.used_episodes)))
    for start in range(0, n_parameters, n_columns):
        yield gradients_by_episode(rollout, *weights, columns=slice(start, start + n_columns))


def sums_by_factors(
    rollout: Rollout, parameters: Parameters, layers: list[nn.Module], w: th.Tensor, episode: th.Tensor, chunk: int
) -> Iterator[tuple[int, th.Tensor]]:
    """
    ``Σ_t w_t ∇ log π`` over some steps of an episode, shape ``(k, n)``, from the factors of the scores.

    ``w`` has k rows and a column for each used step; ``episode`` holds the number of each used step's episode.
    """
    policy = rollout.policy
    obs, actions = used_inputs(rollout)
    features = extract_features(policy, obs, policy.pi_features_extractor).detach()
    widest = max(layer.out_features for layer in layers if isinstance(layer, nn.Linear))
    n_at_once = max(1, min(STEPS, chunk // (len(w) * widest)))
    episode, order = episode.sort(stable=True)
    for steps, episodes in zip(th.split(order, n_at_once), th.split(episode, n_at_once), strict=True):
        factors = score_factors(policy, layers, features[steps], actions[steps])
        for number, part in zip(th.unique(episodes).tolist(), steps_of(episodes), strict=True):
            weights = w[:, steps[part]]
            # Σ_t w_t δ_t x_tᵀ
            sums = [
                ((weights[:, None] * delta[part].T) @ x[part]).flatten(1)
                for delta, x in (factors[parameter] for parameter in parameters)
            ]
            yield number, th.cat(sums, dim=1)


def sums_by_backward_passes(
    rollout: Rollout, parameters: Parameters, w: th.Tensor, episode: th.Tensor
) -> Iterator[tuple[int, th.Tensor]]:
    """``Σ_t w_t ∇ log π`` over all steps of an episode, shape ``(k, n)``, by a backward pass for each of k weights."""
    obs, actions = used_inputs(rollout)
    for number, steps in enumerate(steps_of(episode)):
        log_prob = log_prob_of(rollout.policy, take(obs, steps), actions[steps])
        gradients = (
            th.autograd.grad(log_prob, parameters, part.to(log_prob), retain_graph=True, materialize_grads=True)
            for part in w[:, steps]
        )
        yield number, th.stack([*map(to_vector, gradients)])


def steps_of(episode: th.Tensor) -> tuple[th.Tensor, ...]:
    """The steps of each episode, in the order of the episodes' numbers."""
    lengths = th.unique(episode, return_counts=True)[1]
    return th.split(episode.argsort(stable=True), lengths.tolist())


def score_parameters(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> Parameters:
    """The trainable parameters that log π depends on, in the order of ``policy.parameters()``."""
    parameters = actor_parameters(policy, obs, actions)
    if not parameters:
        raise ValueError(
            f"log π of {type(policy).__name__} cannot be differentiated: it depends on none of the "
            f"{len(trainable(policy))} parameters that require a gradient and are held by policy.optimizer. Check for "
            "no_grad or detach in the policy, frozen layers, and layers that the optimizer does not hold"
        )
    return parameters


def parameters_of(rollout: Rollout) -> Parameters:
    """``score_parameters`` of the policy that made a rollout, from its first step."""
    return score_parameters(rollout.policy, *first_step(rollout))


def first_step(rollout: Rollout) -> tuple[PyTorchObs, th.Tensor]:
    """The first observation of a rollout, and the action of the policy."""
    first = th.arange(1)
    actions = as_policy_actions(take(flatten(rollout.actions), first), rollout.policy.action_space)
    return take(flatten(rollout.inputs), first), actions


def factored_layers(policy: ActorCriticPolicy) -> list[nn.Module] | None:
    """The layers of a plain actor, or None if the scores of its parameters have no factors."""
    layers = plain_actor(policy)
    if layers is None:
        return None
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    # A parameter of two layers has two pairs of factors
    return layers if len(set(parameters)) == len(parameters) else None


def score_factors(
    policy: ActorCriticPolicy, layers: list[nn.Module], x: th.Tensor, actions: th.Tensor
) -> dict[th.Tensor, Factors]:
    """The factors of the score of ``n`` steps with features x, for each parameter of a plain actor."""
    ones = x.new_ones(len(x), 1)
    with th.enable_grad():
        inputs, outputs, logits = trace(layers, x)
        log_std = []
        if isinstance(policy.action_dist, DiagGaussianDistribution):
            log_std = [policy.log_std.detach().expand_as(logits).clone().requires_grad_()]
        log_prob = policy.action_dist.proba_distribution(logits, *log_std).log_prob(actions)
        # The gradient of the sum has δ = ∂ log π / ∂z of each step, since log π of a step depends on its z alone
        deltas = th.autograd.grad(log_prob.sum(), [*outputs, *log_std])
    factors: dict[th.Tensor, Factors] = {}
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    for layer, delta, each in zip(linear, deltas[: len(linear)], inputs, strict=True):
        factors[layer.weight] = (delta, each)
        factors[layer.bias] = (delta, ones)
    if log_std:
        # One log_std may serve several actions
        factors[policy.log_std] = (deltas[-1].sum_to_size(len(actions), policy.log_std.numel()), ones)
    return factors


def trace(layers: list[nn.Module], x: th.Tensor) -> tuple[list[th.Tensor], list[th.Tensor], th.Tensor]:
    """The inputs x and the outputs z of the linear layers of a plain actor, and its logits or means."""
    inputs = []
    outputs = []
    # Gradients flow to the outputs of all layers, of frozen ones too
    x.requires_grad_()
    for layer in layers:
        if isinstance(layer, nn.Linear):
            inputs.append(x.detach())
            x = F.linear(x, layer.weight, layer.bias)
            outputs.append(x)
        else:
            x = layer(x)
    hook = temperature_hook(layers[-1])
    return inputs, outputs, x if hook is None else hook(layers[-1], (), x)
