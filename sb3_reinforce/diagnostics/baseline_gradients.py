"""What each baseline leaves of the gradients of the same episodes, from one pass over them."""

import time

import torch as th

from sb3_reinforce.baselines import ratio_of_others
from sb3_reinforce.diagnostics.moments import gram
from sb3_reinforce.rollouts import Rollout
from sb3_reinforce.scores import CHUNK, gradients_by_episode, scored_parameters


def grams(rollout: Rollout, baselines: dict[str, th.Tensor]) -> tuple[dict[str, th.Tensor], float]:
    """
    ``K_ij = ⟨g_i, g_j⟩`` of the episodes' gradients for each baseline, for ``"optimal"`` and for the ``"floor"``.

    With ``A = Σ_t γ^t ∇log π G_t`` and ``S = Σ_t γ^t ∇log π``, a baseline that is a constant b along an episode leaves
    A − b S, without another derivative; so do the optimal one and the floor. The others are one more weight each, in
    the pass that A and S need anyway, and in as many more as memory asks for.

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
    at_once = 4 * CHUNK // (n_episodes * sum(parameter.numel() for parameter in scored_parameters(rollout)))
    names, n_first = list(weights), max(0, at_once - 2)
    first = [weights[name] for name in names[:n_first]]

    begin = time.perf_counter()
    weighted, scores, *gradients = gradients_by_episode(
        rollout, rollout.discounts * rollout.returns, rollout.discounts, *first
    )
    seconds = (time.perf_counter() - begin) * 2 / (2 + len(first))
    # As the baseline itself computes them, from the gradients that are there already
    constants["optimal"] = ratio_of_others((weighted * scores).sum(1).double(), scores.square().sum(1).double())

    found = {"floor": gram(componentwise_residuals(weighted, scores))}
    found |= {name: gram(weighted - b.to(scores)[:, None] * scores) for name, b in constants.items()}
    found |= {name: gram(g) for name, g in zip(names[:n_first], gradients, strict=True)}
    for start in range(n_first, len(names), max(1, at_once)):
        group = names[start : start + max(1, at_once)]
        more = gradients_by_episode(rollout, *(weights[name] for name in group))
        found |= {name: gram(g) for name, g in zip(group, more, strict=True)}
    return found, seconds


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
