"""What each baseline leaves of the gradients of the same episodes, from one pass over them."""

import time
from collections.abc import Iterator

import torch as th

from sb3_reinforce.diagnostics.moments import gram
from sb3_reinforce.estimation.baselines import ratio_of_others
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import CHUNK, gradients_by_episode, scored_parameters


def grams(rollout: Rollout, baselines: dict[str, th.Tensor]) -> tuple[dict[str, th.Tensor], float]:
    """
    ``K_ij = ⟨g_i, g_j⟩`` of the episodes' gradients for each baseline, for ``"optimal"`` and for the ``"floor"``.

    With ``A = Σ_t γ^t ∇log π G_t`` and ``S = Σ_t γ^t ∇log π``, a baseline that is a constant b along an episode leaves
    A − b S, whose products follow from those of A and S; so do those of the optimal one. The others are one more weight
    each, in the pass that A and S need anyway.

    :param rollout: m whole episodes
    :param baselines: b_t by name, each of shape ``(n_steps, n_envs)``
    :return: Gram matrices by name, shape ``(m, m)``, float64; and the seconds behind A and S, their share of the pass
    """
    rank = th.unique(rollout.episodes[rollout.used], return_inverse=True)[1]
    n_episodes = int(rank.max()) + 1
    constants, weights = {}, {}
    for name, baseline in baselines.items():
        along = baseline[rollout.used]
        b = along.new_zeros(n_episodes).index_copy_(0, rank, along)
        if th.equal(b[rank], along):
            constants[name] = b
        else:
            weights[name] = rollout.discounts * (rollout.returns - baseline)

    names = ("A A", "A S", "S S", "floor", *weights)
    found = {name: th.zeros(n_episodes, n_episodes, dtype=th.float64) for name in names}
    seconds, begin = 0.0, time.perf_counter()
    for weighted, scores, *others in gradient_blocks(
        rollout, rollout.discounts * rollout.returns, rollout.discounts, *weights.values()
    ):
        seconds += (time.perf_counter() - begin) * 2 / (2 + len(others))
        products = gram(th.cat([weighted, scores]))
        found["A A"] += products[:n_episodes, :n_episodes]
        found["A S"] += products[:n_episodes, n_episodes:]
        found["S S"] += products[n_episodes:, n_episodes:]
        found["floor"] += gram(componentwise_residuals(weighted, scores))
        for name, gradients in zip(weights, others, strict=True):
            found[name] += gram(gradients)
        begin = time.perf_counter()
    a_a, a_s, s_s = (found.pop(name) for name in ("A A", "A S", "S S"))
    # As the baseline itself computes them, from the products that are there already
    constants["optimal"] = ratio_of_others(a_s.diagonal(), s_s.diagonal())
    for name, b in constants.items():
        found[name] = a_a - a_s * b - (a_s * b).T + s_s * b * b[:, None]
    return found, seconds


def gradient_blocks(rollout: Rollout, *weights: th.Tensor, floats: int = 2 * CHUNK) -> Iterator[th.Tensor]:
    """
    ``gradients_by_episode``, some components of θ at a time: sums over θ need not hold all of it.

    :param rollout: The rollout, with m episodes that have used steps
    :param weights: k times w_t, each of shape ``(n_steps, n_envs)``
    :param floats: Those that a block may have; what they are cut from is computed anew for each block
    :return: Blocks of shape ``(k, m, c)``
    """
    n_parameters = sum(parameter.numel() for parameter in scored_parameters(rollout))
    n_columns = max(1, floats // (len(weights) * len(th.unique(rollout.episodes[rollout.used]))))
    for start in range(0, n_parameters, n_columns):
        yield gradients_by_episode(rollout, *weights, columns=slice(start, start + n_columns))


def componentwise_residuals(weighted: th.Tensor, scores: th.Tensor) -> th.Tensor:
    """
    ``A_ik − b_k S_ik`` with ``b_k = Cov(A_k, S_k) / Var(S_k)``, the constant of least variance for each component k.

    (Peters and Schaal, 2008, section 3.2, with the sample covariance for E[A S] and E[S²], since E[S] = 0.) Fitted to
    the episodes that it is applied to, it can only be too small, by about 1/m.

    :param weighted: A_i, shape ``(m, n)``
    :param scores: S_i, shape ``(m, n)``
    :return: Shape ``(m, n)``
    """
    centred = scores - scores.mean(0)
    squares = centred.square().sum(0)
    best = ((weighted - weighted.mean(0)) * centred).sum(0) / squares.clamp(min=th.finfo(squares.dtype).tiny)
    return weighted - best * scores
