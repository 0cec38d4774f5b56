"""The critic: its values along a rollout, and its regression on the returns with its own optimizer."""

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor
from torch.nn import functional as F

from sb3_reinforce.common import optimization
from sb3_reinforce.common.tensors import flatten, stack, take
from sb3_reinforce.policies.evaluation import Parameters, extract_features, must_call
from sb3_reinforce.policies.plain_mlp import is_plain_extractor, overrides
from sb3_reinforce.policies.sequences import RecurrentPolicy, sequence_minibatches

Value: TypeAlias = Callable[[Any], th.Tensor]


@th.no_grad()
def rollout_values(
    policy: ActorCriticPolicy,
    has_values: bool,
    buffer: RolloutBuffer,
    dones: NDArray[np.bool_],
    last_obs: Any,
    terminal_obs: dict[tuple[int, int], Any],
) -> tuple[np.ndarray, np.ndarray]:
    """V(s_t), in one batch unless the buffer has it already, and V(s_{t+1}): float32 ``(n_steps, n_envs)``."""

    def predict(obs: Any) -> np.ndarray:
        return policy.predict_values(obs_as_tensor(obs, policy.device)).flatten().cpu().numpy()

    values = buffer.values
    if not has_values:
        obs = flatten(obs_as_tensor(buffer.observations, policy.device))
        values = policy.predict_values(obs).reshape(dones.shape).cpu().numpy()
    last_values = predict(last_obs)
    terminal_values = predict(stack(list(terminal_obs.values()))) if terminal_obs else ()
    return values, next_values_of(values, dones, last_values, terminal_obs, terminal_values)


def next_values_of(
    values: np.ndarray,
    dones: NDArray[np.bool_],
    last_values: np.ndarray,
    limits: Iterable[tuple[int, int]],
    terminal_values: Iterable[float],
) -> np.ndarray:
    """V(s_{t+1}) from V(s_t), V after the last step ``(n_envs,)`` and V at time limits, each at (step, environment)."""
    next_values = np.where(dones, 0.0, np.vstack([values[1:], last_values]))
    for where, value in zip(limits, terminal_values, strict=True):
        next_values[where] = value
    return next_values


def fit_critic(
    policy: ActorCriticPolicy,
    optimizer: th.optim.Optimizer,
    parameters: Parameters,
    obs: PyTorchObs,
    actions: th.Tensor,
    returns: th.Tensor,
    n_updates: int,
    batch_size: int,
    max_grad_norm: float | None,
) -> float:
    """
    Minimize ``mean_t (G_t − V(s_t))²`` by ``n_updates`` passes over the rollout; return the mean of the losses.

    A gradient that is not finite raises a ValueError, and the critic keeps the parameters of the step before. A
    parameter that is not finite afterwards raises one too, and the critic keeps the parameters before all passes.
    """
    losses = []
    value = value_of_batch(policy, parameters, obs, actions)
    with optimization.kept_finite(optimizer, parameters, "critic"):
        for _ in range(n_updates):
            for batch in minibatches(policy, obs, len(returns), batch_size):
                # L = mean_t (G_t − V(s_t))²
                values = value(batch).flatten()
                # A GPU does not differentiate the error between float64 and float32
                loss = F.mse_loss(values, returns[batch].to(values))
                # A network may use a part of itself in each batch
                if loss.requires_grad:
                    gradients = th.autograd.grad(loss, parameters, allow_unused=True)
                    optimization.step(optimizer, parameters, gradients, max_grad_norm, "critic")
                losses.append(loss.detach())
    return float(th.stack(losses).mean())


def minibatches(policy: ActorCriticPolicy, obs: Any, n: int, size: int) -> Iterable[th.Tensor | slice]:
    """The steps of each minibatch, drawn without replacement; a single batch keeps its order."""
    if size >= n:
        return [slice(None)]
    if isinstance(policy, RecurrentPolicy):
        return sequence_minibatches(obs["sequence"], size)
    batches = list(th.randperm(n).to(policy.device).split(size))  # type: ignore[no-untyped-call]
    # BatchNorm takes no batch of one step
    if size > 1 and len(batches[-1]) == 1:
        return [*batches[:-2], th.cat(batches[-2:])]
    return batches


def value_of_batch(policy: ActorCriticPolicy, parameters: Parameters, obs: PyTorchObs, actions: th.Tensor) -> Value:
    """
    V of the steps with given indices, as the critic's passes evaluate it.

    The features are computed once if the passes do not change the features extractor: they are the same in every pass.
    """
    extractor = policy.vf_features_extractor
    is_trained = not set(parameters).isdisjoint(extractor.parameters())
    # In training mode Dropout draws new masks for each pass, and BatchNorm looks at each minibatch
    is_fixed = is_plain_extractor(extractor) or not (is_trained or extractor.training)
    if isinstance(policy, RecurrentPolicy):
        rows: Any = obs
        if is_fixed:
            with th.no_grad():
                rows = {**rows, "features": policy.row_features(rows, extractor)}
        return lambda batch: policy.sequence_values(take(rows, batch))
    if must_call(policy, "evaluate_actions"):
        # V of such a policy may only be found along with log π
        return lambda batch: policy.evaluate_actions(take(obs, batch), actions[batch])[0]
    if overrides(policy, "predict_values") or not is_fixed:
        return lambda batch: policy.predict_values(take(obs, batch))
    with th.no_grad():
        features = extract_features(policy, obs, extractor)
    return lambda batch: policy.value_net(policy.mlp_extractor.forward_critic(features[batch]))
