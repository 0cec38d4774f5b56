"""From rewards to the weights γ^t (G_t − b_t) of the scores, as functions of arrays."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.common.tensors import ROUNDING, select
from sb3_reinforce.envs.checks import check_finite
from sb3_reinforce.estimation.baselines import Baseline
from sb3_reinforce.estimation.returns import Bools, Floats, Integers, lambda_return, total_return
from sb3_reinforce.estimation.rollout import (
    Rollout,
    Running,
    in_finished_episode,
    timesteps_of,
    used_inputs,
    within_quota,
)


def complete_rollout(
    buffer: RolloutBuffer,
    policy: ActorCriticPolicy,
    dones: Bools,
    quota: Integers | None,
    running: Running,
    next_values: Floats | None,
    state: th.Tensor | None = None,
    *,
    baseline: Baseline,
    gamma: float,
    gae_lambda: float,
    reward_to_go: bool,
    discount_scores: bool,
    normalize_by: str,
    episodes_per_start: int = 1,
) -> tuple[Rollout, Floats, Floats]:
    """
    The rollout with m_t, G_t, γ^t and D; the advantages ``m_t (G_t − b_t)``; and the critic's targets, or ``m_t G_t``.

    ``quota`` is None for a fixed number of steps, and ``next_values`` None without a critic.
    """
    rewards = buffer.rewards
    timesteps = timesteps_of(dones, running.timesteps)
    used, denominator = used_steps(dones, quota, normalize_by, has_critic=next_values is not None)
    returns_to_go = lambda_return(rewards, dones, 0.0 if next_values is None else next_values, gamma, gae_lambda)
    returns = returns_to_go if reward_to_go else total_return(returns_to_go, timesteps, gamma, running.rewards)
    # The total return has γ^t already
    discounts = gamma**timesteps if discount_scores and reward_to_go else np.ones_like(returns)
    rollout = Rollout(
        observations=obs_as_tensor(buffer.observations, policy.device),
        actions=th.as_tensor(buffer.actions, device=policy.device),
        rewards=th.as_tensor(rewards).double(),
        dones=th.as_tensor(dones),
        timesteps=th.as_tensor(timesteps).long(),
        # A copy: PyTorch takes no array with negative strides
        used=th.as_tensor(used.copy()),
        returns=th.tensor(returns),
        discounts=th.as_tensor(discounts),
        values=None if next_values is None else th.as_tensor(buffer.values).double(),
        next_values=None if next_values is None else th.as_tensor(next_values).double(),
        policy=policy,
        denominator=denominator,
        episodes_per_start=episodes_per_start,
        state=state,
    )
    targets = np.where(used, returns if next_values is None else returns_to_go, 0.0).astype(np.float32)
    return rollout, compute_advantages(rollout, baseline(rollout)), targets


def used_steps(dones: Bools, quota: Integers | None, normalize_by: str, has_critic: bool) -> tuple[Bools, int]:
    """m_t, which is 1 where G_t is known and the step is in the quota, and the denominator D."""
    used = np.ones_like(dones) if has_critic else in_finished_episode(dones)
    if quota is None:
        if normalize_by == "episodes":
            warnings.warn(
                "normalize_by='episodes' has no effect with n_steps: set n_episodes for whole episodes", stacklevel=2
            )
        check_used(used)
        return used, used.size
    used = used & within_quota(dones, quota)
    return used, int(used.sum() if normalize_by == "steps" else quota.sum())


def compute_advantages(rollout: Rollout, baseline: Any) -> Floats:
    """``m_t (G_t − b_t)``, shape ``(n_steps, n_envs)``, float32."""
    return returns_minus_baseline(rollout, baseline).masked_fill(~rollout.used, 0.0).float().numpy()


def returns_minus_baseline(rollout: Rollout, baseline: Any) -> th.Tensor:
    """``G_t − b_t``, shape ``(n_steps, n_envs)``, float64."""
    return without_rounding(rollout.returns - check_baseline(baseline, rollout), rollout.returns)


def without_rounding(differences: th.Tensor, numbers: th.Tensor) -> th.Tensor:
    """Differences of numbers, 0 where they are rounding errors, which a natural step would take for a gradient."""
    return differences.masked_fill(differences.abs() <= ROUNDING * numbers.abs(), 0.0)


def compute_weights(rollout: Rollout, advantages: Floats, normalize: bool) -> th.Tensor:
    """``γ^t (G_t − b_t)`` of the n used steps, shape ``(n,)``, float32; γ^t only if the rollout has it."""
    device = rollout.actions.device
    weights: th.Tensor = select(th.as_tensor(advantages, device=device), rollout.used)
    if normalize:
        weights = standardize(weights)
    discounts: th.Tensor = select(rollout.discounts.to(weights), rollout.used)
    return weights * discounts


def standardize(weights: th.Tensor) -> th.Tensor:
    """``(w − mean) / (std + 1e-8)`` as in PPO, or w if there are fewer than two samples or all are equal."""
    if len(weights) < 2 or weights.max() == weights.min():
        return weights
    return (weights - weights.mean()) / (weights.std() + 1e-8)


@dataclass(frozen=True)
class Batch:
    """
    The ``n`` used steps of a rollout, flattened to ``(n, ...)``, as ``train`` takes them.

    ``observations`` are the rows of sequences for a recurrent policy.
    ``weights`` are γ^t (G_t − b_t) and ``returns`` what the critic is fitted to, float32; ``values`` are V(s_t) before
    the critic is fitted, float64 on the CPU, or None without a critic.
    """

    observations: Any
    actions: th.Tensor
    weights: th.Tensor
    returns: th.Tensor
    values: th.Tensor | None


def by_step(buffer: RolloutBuffer) -> tuple[Floats, Floats]:
    """``advantages`` and ``returns`` as ``(n_steps, n_envs)``, also after ``get`` has flattened them env by env."""
    if not buffer.generator_ready:
        return buffer.advantages, buffer.returns
    return buffer.advantages.reshape(buffer.n_envs, -1).T.copy(), buffer.returns.reshape(buffer.n_envs, -1).T.copy()


def training_batch(rollout: Rollout, buffer: RolloutBuffer, normalize: bool) -> Batch:
    """The used steps of a rollout, with the advantages and returns of the buffer, which a callback may have changed."""
    advantages, returns = by_step(buffer)
    return Batch(
        *used_inputs(rollout),
        weights=compute_weights(rollout, advantages, normalize),
        returns=select(th.as_tensor(returns, device=rollout.actions.device), rollout.used),
        values=None if rollout.values is None else select(rollout.values, rollout.used),
    )


def check_used(used: Bools) -> None:
    """Refuse a fixed rollout without a known return, and warn if episodes that it cuts are left out."""
    if not used.any():
        raise ValueError(
            f"No episode ended within n_steps={len(used)}, and without a critic the return of an unfinished episode is "
            "not known: raise n_steps, set n_episodes instead, or use baseline='value'"
        )
    if not used.all():
        warnings.warn(
            "Episodes that n_steps cuts are left out, since without a critic their return is not known. Long episodes "
            "are cut more often than short ones, so the gradient is biased towards short episodes: n_episodes instead "
            "of n_steps removes this bias (see rollout/complete_fraction)",
            stacklevel=2,
        )


def check_baseline(baseline: Any, rollout: Rollout) -> th.Tensor:
    """Check that b_t is a tensor ``(n_steps, n_envs)``, finite at used steps; return it as float64, 0 elsewhere."""
    if not isinstance(baseline, th.Tensor):
        raise TypeError(f"baseline must return a tensor, got {type(baseline).__name__}")
    if baseline.shape != rollout.returns.shape:
        raise ValueError(
            f"baseline must return a tensor of shape (n_steps, n_envs) = {tuple(rollout.returns.shape)}, got "
            f"{tuple(baseline.shape)}"
        )
    values = th.where(rollout.used, baseline.detach().cpu().double(), 0.0)
    check_finite("The baseline", values)
    return values
