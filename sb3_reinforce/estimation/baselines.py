"""
Baselines: what is subtracted from the return before it weighs a score. One pure function each.

A baseline takes a ``Rollout`` and returns b_t of shape ``(n_steps, n_envs)``. It keeps the gradient unbiased as long as
b_t does not depend on the action at t or on what the action has led to (Williams, 1992, theorem 1). A user's own
function is a baseline too. This module looks up to ``rollouts``, whose ``Rollout`` is what a baseline is given.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import torch as th

from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import CHUNK, gradients_by_episode

Baseline: TypeAlias = Callable[[Rollout], th.Tensor]


def none(rollout: Rollout) -> th.Tensor:
    """``b_t = 0``. Unbiased."""
    return th.zeros_like(rollout.returns)


def mean(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = mean of G over all used steps of the rollout``.

    Biased: the mean contains the returns that it is subtracted from. For N episodes of one length and without γ^t the
    expected gradient lacks ``∇E[mean_t G_t] / N``.
    """
    return th.full_like(rollout.returns, float(rollout.returns[rollout.used].mean()))


def time_mean(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = mean of G_t over the episodes that reach step t``.

    With N episodes of one length the expected gradient is exactly (N − 1)/N of the true one: each return is in its own
    mean with weight 1/N. A step that a single episode reaches has weight G_t − b_t = 0.
    """
    totals, counts = _by_timestep(rollout)
    return totals / counts.clamp(min=1)


def leave_one_out(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = mean of G_t over the other episodes that reach step t``, and 0 where there is none.

    Unbiased: the other episodes know nothing of this one's action (Kool et al., 2019, "Buy 4 REINFORCE samples").
    """
    totals, counts = _by_timestep(rollout)
    return (totals - rollout.returns) * rollout.used / (counts - 1).clamp(min=1)


def value(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = V(s_t)``, by the critic as it was before this rollout trained it. Unbiased with ``gae_lambda=1`` where no
    episode is cut.
    """
    assert rollout.values is not None
    return rollout.values


def optimal(rollout: Rollout) -> th.Tensor:
    """
    ``b_i = Σ_{j≠i} ⟨A_j, S_j⟩ / Σ_{j≠i} ‖S_j‖²`` for all steps of episode i, and 0 where the other scores vanish.

    ``S_j = Σ_t γ^t ∇log π(a_t|s_t)`` is the score of episode j and ``A_j = Σ_t γ^t ∇log π(a_t|s_t) G_t``, without γ^t
    unless ``discount_scores``. A constant b leaves the trace of the covariance of A − b S as
    E‖A‖² − 2b E⟨A, S⟩ + b² E‖S‖² + const, since E[S] = 0; this b minimises it. For the total return it is the mean of
    G_0 weighted by ‖S_j‖² (Peters and Schaal, 2008, section 3.2, summed over components). Unbiased, because the sums
    leave out the episode that b is applied to.
    """
    return ratio_of_others(*score_products(rollout))[rollout.episodes]


def ratio_of_others(products: th.Tensor, squares: th.Tensor) -> th.Tensor:
    """
    ``b_i = Σ_{j≠i} products_j / Σ_{j≠i} squares_j``, and 0 where the latter is 0.

    :param products: ⟨A_j, S_j⟩, shape ``(n_episodes,)``
    :param squares: ‖S_j‖², shape ``(n_episodes,)``
    :return: Shape ``(n_episodes,)``
    """
    above, below = sum_of_others(products), sum_of_others(squares)
    return th.where(below > 0, above / below.clamp(min=th.finfo(below.dtype).tiny), 0.0)


def score_products(rollout: Rollout) -> tuple[th.Tensor, th.Tensor]:
    """
    ⟨A_j, S_j⟩ and ‖S_j‖² of ``optimal``.

    :param rollout: The rollout
    :return: Two tensors of shape ``(n_episodes,)``, float64; 0 for an episode without used steps
    """
    products = th.zeros(int(rollout.episodes.max()) + 1, 2, dtype=th.float64)
    numbers = th.unique(rollout.episodes[rollout.used])
    for group in numbers.split(
        max(1, CHUNK // (2 * sum(parameter.numel() for parameter in rollout.policy.parameters())))
    ):
        part = replace(rollout, used=rollout.used & th.isin(rollout.episodes, group))
        weighted, scores = gradients_by_episode(part, rollout.discounts * rollout.returns, rollout.discounts)
        products[group] = th.stack([(weighted * scores).sum(1), scores.square().sum(1)], dim=1).cpu().double()
    return products[:, 0], products[:, 1]


def sum_of_others(x: th.Tensor) -> th.Tensor:
    """
    ``y_i = Σ_{j≠i} x_j``, as the sum before i plus the sum after i: a difference of sums would lose digits.

    :param x: Shape ``(n,)``
    :return: Shape ``(n,)``
    """
    zero = x.new_zeros(1)
    before, after = th.cat([zero, x[:-1]]).cumsum(0), th.cat([x[1:], zero]).flip(0).cumsum(0).flip(0)
    return before + after


def _by_timestep(rollout: Rollout) -> tuple[th.Tensor, th.Tensor]:
    """The sum of G_t over the used steps of the same t, and their number; each ``(n_steps, n_envs)``."""
    _, group = th.unique(rollout.timesteps, return_inverse=True)
    totals, counts = (
        th.zeros(int(group.max()) + 1, dtype=x.dtype).index_add_(0, group.flatten(), x.flatten())
        for x in (rollout.returns * rollout.used, rollout.used.to(rollout.returns.dtype))
    )
    return totals[group], counts[group]


BASELINES: dict[str, Baseline] = {
    "none": none,
    "mean": mean,
    "time_mean": time_mean,
    "leave_one_out": leave_one_out,
    "value": value,
    "optimal": optimal,
}
