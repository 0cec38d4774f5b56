"""
Baselines: what is subtracted from the return before it weights a score. One pure function each.

A baseline takes a ``Rollout`` and returns b_t of shape ``(n_steps, n_envs)``. It keeps the gradient unbiased as long as
b_t does not depend on the action at t or on its consequences (Greensmith, Bartlett and Baxter, 2004). A user's own
function is a baseline too.

Statements about bias are for whole episodes, and with a critic for episodes that no time limit cuts.

"Other episodes" are the others of the same group: of the rollout, or with ``episodes_per_start`` of the same start.
``mean`` always takes all.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import torch as th

from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import CHUNK, gradients_by_episode

Baseline: TypeAlias = Callable[[Rollout], th.Tensor]


def none(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = 0``. Unbiased.

    :param rollout: The rollout
    :return: Shape ``(n_steps, n_envs)``, float64, as for all baselines
    """
    return th.zeros_like(rollout.returns)


def mean(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = mean of G over all used steps of the rollout``.

    Biased: the mean contains the returns that it is subtracted from. For N episodes of one length and without γ^t, the
    expected gradient is too small by ``∇E[mean_t G_t] / N``.

    :param rollout: The rollout
    :return: b_t, shape ``(n_steps, n_envs)``, float64
    """
    return th.full_like(rollout.returns, float(rollout.returns[rollout.used].mean()))


def time_mean(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = mean of G_t over the episodes that reach step t``.

    With N episodes of one length the expected gradient is exactly (N − 1)/N of the true one: each return is in its own
    mean with weight 1/N. A step that a single episode reaches has weight G_t − b_t = 0.

    :param rollout: The rollout
    :return: b_t, shape ``(n_steps, n_envs)``, float64
    """
    totals, counts = sums_by_timestep(rollout)
    return totals / counts.clamp(min=1)


def leave_one_out(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = mean of G_t over the other episodes that reach step t``, and 0 where there is none.

    Unbiased if episodes do not influence each other: the returns of the others do not depend on this one's actions
    (Kool et al., 2019, "Buy 4 REINFORCE samples").

    :param rollout: The rollout
    :return: b_t, shape ``(n_steps, n_envs)``, float64
    """
    totals, counts = sums_by_timestep(rollout)
    return (totals - rollout.returns) * rollout.used / (counts - 1).clamp(min=1)


def value(rollout: Rollout) -> th.Tensor:
    """
    ``b_t = V(s_t)``, by the critic as it was before this rollout trained it. Unbiased with ``gae_lambda=1`` where no
    episode is cut.

    :param rollout: The rollout; ``values`` must not be None
    :return: b_t, shape ``(n_steps, n_envs)``, float64
    :raises ValueError: If the rollout has no values
    """
    if rollout.values is None:
        raise ValueError("baseline='value' needs a rollout with values: collect it with a model that has a critic")
    return rollout.values


def optimal(rollout: Rollout) -> th.Tensor:
    """
    ``b_i = Σ_{j≠i} ⟨A_j, S_j⟩ / Σ_{j≠i} ‖S_j‖²`` for all steps of episode i, and 0 where the other scores vanish.

    ``S_j = Σ_t γ^t ∇log π(a_t|s_t)`` is the score of episode j and ``A_j = Σ_t γ^t ∇log π(a_t|s_t) G_t``, with γ^t only
    as in the gradient (``Rollout.discounts``). A constant b leaves the trace of the covariance of A − b S as E‖A‖² − 2b
    E⟨A, S⟩ + b² E‖S‖² + const, since E[S] = 0; this b minimizes it. For the total return it is the mean of G_0 weighted
    by ‖S_j‖² (Greensmith, Bartlett and Baxter, 2004; for each component: Peters and Schaal, 2008, section 3.2).
    Unbiased, because the sums leave out the episode that b is applied to.

    :param rollout: The rollout
    :return: b_t, shape ``(n_steps, n_envs)``, float64
    """
    products, squares = score_products(rollout)
    b = th.zeros_like(products)
    for group in th.unique(rollout.groups):
        members = th.unique(rollout.episodes[rollout.groups == group])
        above = sum_of_others(products[members])
        below = sum_of_others(squares[members])
        b[members] = th.where(below > 0, above / below, 0.0)
    return b[rollout.episodes]


def score_products(rollout: Rollout) -> tuple[th.Tensor, th.Tensor]:
    """⟨A_j, S_j⟩ and ‖S_j‖² of ``optimal``, shape ``(n_episodes,)``, float64; 0 for an episode without used steps."""
    # ⟨A, S⟩ = ⟨A − c S, S⟩ + c ‖S‖², with the mean c of G in the group. Without this split, rounding in float32 would
    # give equal returns c a baseline that differs from c
    totals, counts = sums_at(rollout.groups, rollout)
    level = totals / counts.clamp(min=1)
    products = th.zeros(int(rollout.episodes.max()) + 1, 2, dtype=th.float64)
    n_parameters = sum(parameter.numel() for parameter in rollout.policy.parameters())
    for group in th.split(rollout.used_episodes, max(1, CHUNK // (2 * n_parameters))):
        part = replace(rollout, used=rollout.used & th.isin(rollout.episodes, group))
        weights = rollout.discounts * (rollout.returns - level)
        weighted, scores = gradients_by_episode(part, weights, rollout.discounts)
        products[group] = th.stack([(weighted * scores).sum(1), scores.square().sum(1)], dim=1).cpu().double()
    centered, squares = products.T
    levels = th.zeros_like(squares)
    levels[rollout.episodes] = level
    return centered + levels * squares, squares


def sum_of_others(x: th.Tensor) -> th.Tensor:
    """``y_i = Σ_{j≠i} x_j``, the sum before i plus the sum after i: a difference of sums would lose digits."""
    zero = x.new_zeros(1)
    before = th.cat([zero, x[:-1]]).cumsum(0)
    after = th.cat([x[1:], zero]).flip(0).cumsum(0).flip(0)
    return before + after


def sums_by_timestep(rollout: Rollout) -> tuple[th.Tensor, th.Tensor]:
    """The sum of G_t over the group's used steps of the same t, and their number; each ``(n_steps, n_envs)``."""
    place = rollout.timesteps + rollout.groups * (rollout.timesteps.max() + 1)
    return sums_at(th.unique(place, return_inverse=True)[1], rollout)


def sums_at(place: th.Tensor, rollout: Rollout) -> tuple[th.Tensor, th.Tensor]:
    """The sum of G_t over the used steps of the same place, and their number; each ``(n_steps, n_envs)``."""
    used = rollout.used.to(rollout.returns)
    zeros = used.new_zeros(int(place.max()) + 1)
    totals = zeros.index_add(0, place.flatten(), (rollout.returns * used).flatten())
    counts = zeros.index_add(0, place.flatten(), used.flatten())
    return totals[place], counts[place]


BASELINES: dict[str, Baseline] = {
    "none": none,
    "mean": mean,
    "time_mean": time_mean,
    "leave_one_out": leave_one_out,
    "value": value,
    "optimal": optimal,
}
