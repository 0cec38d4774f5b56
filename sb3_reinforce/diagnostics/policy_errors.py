"""Errors of a policy that ``check_gradient`` measures: how far the two sides of each identity of log π are apart."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import take, to_vector
from sb3_reinforce.diagnostics.sampling import seeded
from sb3_reinforce.estimation.scores import score_parameters
from sb3_reinforce.policies.evaluation import Parameters, evaluate, log_prob_of, trainable
from sb3_reinforce.policies.parameters import restored, write
from sb3_reinforce.policies.sequences import RecurrentPolicy, without_memory

# Elements of the observations in a forward pass
N_ELEMENTS = 2**21
# Random directions of the finite differences, and observations at which signs and samples are checked
N_DIRECTIONS = 16
N_OBSERVATIONS = 8


def relative_difference(x: th.Tensor, y: th.Tensor) -> float:
    """``‖x − y‖ / max(‖x‖, ‖y‖)``, and 0 where both are zero."""
    # NaN where one is NaN
    scale = float(th.maximum(x.norm(), y.norm()))
    return float((x - y).norm()) / scale if scale != 0 else 0.0


@th.no_grad()
def log_prob_error(policy: ActorCriticPolicy, obs: PyTorchObs) -> float:
    """The largest difference between log π of sampled actions in ``forward`` and in training."""
    drawn, _, log_prob = policy(obs)
    evaluated = log_prob_of(policy, obs, as_evaluated(policy, drawn))
    return largest_difference(evaluated, log_prob)


def largest_difference(log_prob: th.Tensor, other: th.Tensor) -> float:
    """``max |log π − log π'|``, relative where log π is large."""
    return float(((log_prob - other).abs() / other.abs().clamp(min=1)).max())


def n_at_once(policy: ActorCriticPolicy) -> int:
    """The number of observations in a forward pass."""
    return max(1, N_ELEMENTS // get_flattened_obs_dim(policy.observation_space))


def spread(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> tuple[PyTorchObs, th.Tensor]:
    """Steps spread evenly over observations and actions, as many as a forward pass takes."""
    steps = th.arange(0, len(actions), math.ceil(len(actions) / n_at_once(policy)))
    return take(obs, steps), actions[steps]


def as_evaluated(policy: ActorCriticPolicy, drawn: th.Tensor) -> th.Tensor:
    """Actions as ``forward`` returns them, in the form that ``evaluate_actions`` takes."""
    return as_policy_actions(drawn.reshape(len(drawn), -1), policy.action_space)


def score_error(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> float:
    """
    The larger of ``difference_error`` and a fifth of the error with the last layer scaled up to outputs of about 1.

    The last layer of a new policy has small weights, with which the scores of the others hardly count; larger ones
    curve log π more. Large logits and biases are scaled down to 1: log π near 0 is mostly rounding.
    """
    # It may stand in another module, as with a mask
    parts = policy.named_modules()
    layers = [part for name, part in parts if name.split(".")[0] == "action_net" and isinstance(part, th.nn.Linear)]
    size = size_of_outputs(layers[-1], lambda: log_prob_of(policy, obs, actions)) if layers else 0.0
    if size == 0:
        # Not the layer that the distribution comes from
        return difference_error(policy, obs, actions)
    scale = 1 / size
    are_logits = not isinstance(policy.action_space, spaces.Box)
    with scaled(layers[-1], min(1.0, scale) if are_logits else 1.0, are_logits):
        error = difference_error(policy, obs, actions)
    if scale > 1:
        with scaled(layers[-1], scale, are_logits):
            error = float(np.maximum(error, difference_error(policy, obs, actions) / 5))
    return error


def size_of_outputs(layer: th.nn.Linear, evaluate: Callable[[], object]) -> float:
    """The root mean square of ``W x`` of a layer in an evaluation; 0 if the layer is not called."""
    sizes = [0.0]

    def measure(_: th.nn.Module, inputs: tuple[th.Tensor, ...]) -> None:
        sizes.append(th.nn.functional.linear(inputs[0], layer.weight).square().mean().sqrt().item())

    with layer.register_forward_pre_hook(measure):
        evaluate()
    return sizes[-1]


@contextmanager
def scaled(layer: th.nn.Linear, scale: float, are_logits: bool) -> Iterator[None]:
    """Multiply the weights of a layer in the block, and scale biases of logits down to at most 1."""
    with restored([*layer.parameters()]):
        write([layer.weight], layer.weight.detach().flatten() * scale)
        if are_logits and layer.bias is not None:
            write([layer.bias], layer.bias.detach() / max(1.0, float(layer.bias.detach().abs().max())))
        yield


def difference_error(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> float:
    """
    Relative error of ``⟨∇L, u⟩`` against ``(L(θ + h u) − L(θ − h u)) / 2h`` over random directions u, for the best h.

    ``L = Σ ± log π(a_t|s_t)`` with random signs. Where log π is strongly curved, only a short h is accurate; a wrong
    gradient is wrong for every h.
    """
    parameters = trainable(policy)
    signs = 2.0 * th.randint(2, (len(actions),)).to(actions.device) - 1

    def objective() -> th.Tensor:
        return (log_prob_of(policy, obs, actions).double() * signs).sum()

    gradient = to_vector(th.autograd.grad(objective(), parameters, allow_unused=True, materialize_grads=True)).double()
    theta = to_vector(parameters)
    # One length for all tensors would be too long for small ones, and steps below 0.03 h drown in rounding
    scales = to_vector([each.square().mean().sqrt().clamp(min=0.03).expand_as(each) for each in parameters])
    directions = scales * th.randn(N_DIRECTIONS, len(theta), device=theta.device)
    errors = []
    # In float32 the rounding of log π and the third derivative usually balance near eps^(1/3), the first h
    for h in (5e-3, 5e-4, 5e-5):
        plus = values_at(theta + h * directions, parameters, objective)
        minus = values_at(theta - h * directions, parameters, objective)
        errors.append(relative_difference(directions.double() @ gradient, (plus - minus) / (2 * h)))
    return min(errors)


@th.no_grad()
def values_at(thetas: th.Tensor, parameters: Parameters, function: Callable[[], th.Tensor]) -> th.Tensor:
    """``f(θ)`` (k,) at θs (k, n), where f depends on the parameters, which are as before afterwards."""
    values = []
    with restored(parameters):
        for theta in thetas:
            write(parameters, theta)
            values.append(function())
    return th.stack(values)


def sign_error(policy: ActorCriticPolicy, obs: PyTorchObs, n_obs: int) -> float:
    """
    The fraction of sampled actions that are less likely after a step along their own score, ``θ + h ∇ log π(a|s)``.

    The actions are sampled at a few of the ``n_obs`` observations. It is measured from what the policy samples, not
    from log π (see ``closeness``). NaN if all samples are equal.
    """
    n_draws = max(256, min(1024, n_at_once(policy)))
    wrong = []
    for index in th.randperm(n_obs)[:N_OBSERVATIONS]:
        one = take(obs, index[None])
        draws = draw(policy, one, n_draws)
        # The effect of a step is clearest for the action that is farthest from the rest
        action = draws[int(th.stack([closeness(policy, draws, draws[i]) for i in range(8)]).argmin())]
        before, after = closeness_after_step(policy, one, action, n_draws)
        # The count of a rare action may happen to stay the same
        if after != before and before < closeness(policy, action[None].expand_as(draws), action):
            wrong.append(bool(after < before))
    return sum(wrong) / len(wrong) if wrong else float("nan")


@th.no_grad()
def sampling_error(policy: ActorCriticPolicy, obs: PyTorchObs, n_obs: int) -> float:
    """
    The largest difference between the mean of −log π over sampled actions and the entropy, in standard errors.

    It is measured at a few of the ``n_obs`` observations. The smaller error of two samples counts, since one may have a
    rare action too often. An entropy without closed form is estimated from the sample itself: the error is then 0.
    """
    n_draws = max(256, min(1024, n_at_once(policy)))
    errors = []
    for index in th.randperm(n_obs)[:N_OBSERVATIONS]:
        one = take(obs, index[None])
        many = repeated(policy, one, n_draws)
        pair = []
        for _ in range(2):
            actions = draw(policy, one, n_draws)
            log_prob, entropy, _ = evaluate(policy, many, actions)
            # Below 0.1 nats a sample may lack the rare actions, with which the variance of log π is at least H
            h = 0.0 if isinstance(policy.action_space, spaces.Box) else float(entropy.mean())
            least = math.sqrt(h) if 0 < h < 0.1 else 0.0
            pair.append(standard_errors((-log_prob - entropy).double(), least))
        errors.append(min(pair))
    return max(errors)


def standard_errors(samples: th.Tensor, least_std: float) -> float:
    """``|mean| / (std / √n)`` of n samples, with a std of at least ``least_std``; ∞ where one is not finite."""
    # Samples that are all equal differ by rounding
    error = float(samples.mean().abs() / samples.std().clamp(min=max(1e-4, least_std))) * math.sqrt(len(samples))
    return math.inf if math.isnan(error) else error


@th.no_grad()
def draw(policy: ActorCriticPolicy, one: PyTorchObs, n: int) -> th.Tensor:
    """Independent actions ``(n, ...)`` for one observation; with gSDE each has its own noise matrix."""
    if policy.use_sde:
        policy.reset_noise(n)
    obs = repeated(policy, one, n)
    drawn = policy.sequence_distribution(obs).get_actions() if isinstance(policy, RecurrentPolicy) else policy(obs)[0]
    return as_evaluated(policy, drawn)


def repeated(policy: ActorCriticPolicy, one: PyTorchObs, n: int) -> Any:
    """``n`` copies of one observation, each the first of its episode for a policy with a memory."""
    obs = take(one, th.zeros(n, dtype=th.long))
    return without_memory(obs) if isinstance(policy, RecurrentPolicy) else obs


def closeness(policy: ActorCriticPolicy, draws: th.Tensor, action: th.Tensor) -> th.Tensor:
    """The mean share of components that equal an action's; for a Box, minus the distance from the mean to it."""
    if isinstance(policy.action_space, spaces.Box):
        distance: th.Tensor = (draws.mean(0) - action).norm()
        return -distance
    return (draws == action).double().mean()


def closeness_after_step(policy: ActorCriticPolicy, one: PyTorchObs, action: th.Tensor, n: int) -> th.Tensor:
    """
    ``closeness`` before and after a step along the score of an action, (2,), with the same n random draws.

    The score of ``log_std`` is left out: it changes the spread of the draws, and their mean only by chance.
    """
    found = score_parameters(policy, one, action[None])
    parameters = [parameter for parameter in found if parameter is not getattr(policy, "log_std", None)]
    if not parameters:
        return th.zeros(2)
    log_prob = log_prob_of(policy, one, action[None])
    gradient = to_vector(th.autograd.grad(log_prob.sum(), parameters))
    theta = to_vector(parameters)
    # To first order, log π(a|s) rises by 0.3
    step = 0.3 * gradient / gradient.square().sum().clamp(min=1e-12)
    seed = int(th.randint(2**31, ()))

    def measured() -> th.Tensor:
        with seeded(policy, seed):
            return closeness(policy, draw(policy, one, n), action)

    return values_at(th.stack([theta, theta + step]), parameters, measured)
