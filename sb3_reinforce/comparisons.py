"""Every baseline on the same episodes: which of them leaves the least noise in the gradient on a task."""

import time
from collections.abc import Iterable
from dataclasses import dataclass

import torch as th

from sb3_reinforce.arguments import check_function, check_integer, check_number
from sb3_reinforce.baselines import BASELINES, Baseline, ratio_of_others
from sb3_reinforce.gradient_statistics import (
    Estimate,
    interval,
    moments,
    resamples,
    signal_to_noise,
    variance,
)
from sb3_reinforce.reinforce import REINFORCE
from sb3_reinforce.rollouts import Rollout
from sb3_reinforce.sampling import check_model, sample
from sb3_reinforce.scores import CHUNK, gradients_by_episode
from sb3_reinforce.tables import Table
from sb3_reinforce.weighing import check_baseline

UNKNOWN = Estimate(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True)
class BaselineRow:
    """
    One baseline on the episodes of a comparison.

    :param baseline: Its name
    :param variance: tr Σ, the trace of the covariance of the gradient of one episode
    :param ratio: tr Σ over that of ``"none"``, from the same resamples
    :param snr: ``‖E g‖² / tr Σ`` of one episode; the mean of N episodes has N times that
    :param bias: ``‖E g − E g_none‖ / ‖E g_none‖`` as far as theory knows it, else NaN
    :param seconds: What b_t took to compute
    """

    baseline: str
    variance: Estimate
    ratio: Estimate
    snr: Estimate
    bias: float
    seconds: float


def compare_baselines(
    model: REINFORCE,
    n_episodes: int = 100,
    baselines: Iterable[str | Baseline] | None = None,
    n_resamples: int = 500,
    confidence: float = 0.95,
    seed: int = 0,
) -> Table[BaselineRow]:
    """
    Weigh the same whole episodes by each baseline, and measure what noise is left in the gradient.

    The episodes are sampled by the model's policy and weighed with its own returns (γ, λ, reward-to-go); the gradient
    of an episode is the sum over its steps. The row ``"none"`` is always there, and the last one is the ``"floor"``:
    the best constant for every single component of the gradient, fitted to these very episodes. No scalar constant can
    have a smaller variance; a baseline that knows the time or the state can.

    :param model: The model; it is not changed, and its environments are left at the start of an episode
    :param n_episodes: Episodes, at least 3
    :param baselines: Names or functions; None for all names, ``"value"`` only where the model has a critic
    :param n_resamples: Bootstrap resamples behind the intervals
    :param confidence: Probability that an interval is to cover the truth
    :param seed: Seed of the resamples
    :return: A table with a ``BaselineRow`` each
    :raises TypeError: If the model is not a REINFORCE, or a baseline neither a name nor callable
    :raises ValueError: If there are too few episodes, a name is unknown, or ``"value"`` has no critic
    """
    check_model(model)
    functions, n_episodes = functions_of(model, baselines), check_integer("n_episodes", n_episodes, 3)
    check_number("confidence", confidence, 0, 1)
    counts = resamples(n_episodes, check_integer("n_resamples", n_resamples, 1), check_integer("seed", seed, 0))
    rows = baseline_rows(sample(model, n_episodes), functions, counts, confidence)
    return Table(f"Gradient of one episode by baseline ({n_episodes} episodes)", rows)


def functions_of(model: REINFORCE, baselines: Iterable[str | Baseline] | None) -> dict[str, Baseline]:
    """
    The baselines to compare, by name, ``"none"`` first.

    :param model: The model
    :param baselines: As for ``compare_baselines``
    :raises TypeError: If a baseline is neither a name nor callable
    :raises ValueError: If a name is unknown, or ``"value"`` has no critic
    """
    if baselines is None:
        baselines = [name for name in BASELINES if name != "value" or model.has_critic]
    functions: dict[str, Baseline] = {"none": BASELINES["none"]}
    for baseline in [baselines] if isinstance(baselines, str) or callable(baselines) else baselines:
        function = check_function("baselines", baseline, BASELINES)
        if function is BASELINES["value"] and not model.has_critic:
            raise ValueError(
                f"baselines has 'value', and the model has no critic: its baseline is {model.baseline!r}. Train one "
                "with baseline='value', or leave it out"
            )
        functions[baseline if isinstance(baseline, str) else getattr(baseline, "__name__", repr(baseline))] = function
    return functions


def baseline_rows(
    rollout: Rollout, functions: dict[str, Baseline], counts: th.Tensor, confidence: float
) -> list[BaselineRow]:
    """
    The rows of ``compare_baselines``.

    :param rollout: Whole episodes
    :param functions: Baselines by name, ``"none"`` first
    :param counts: As ``resamples`` draws them, shape ``(r, m)``
    :param confidence: Probability that an interval is to cover the truth
    """
    begin = time.perf_counter()
    weighted, scores = gradients_by_episode(rollout, rollout.discounts * rollout.returns, rollout.discounts)
    values, seconds = {}, {"optimal": time.perf_counter() - begin}
    for name, function in functions.items():
        begin = time.perf_counter()
        if function is BASELINES["optimal"]:
            # As the function itself, from the gradients that are there already
            constants = ratio_of_others((weighted * scores).sum(1).double(), scores.square().sum(1).double()).cpu()
            ranks = th.unique(rollout.episodes[rollout.used], return_inverse=True)[1]
            baseline = th.zeros_like(rollout.returns).masked_scatter_(rollout.used, constants[ranks])
        else:
            baseline = function(rollout)
        values[name] = th.as_tensor(check_baseline(baseline, rollout))
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - begin
    found = {name: moments(gram, counts) for name, gram in grams(rollout, values, weighted, scores).items()}
    rows = []
    for name, of in found.items():
        ratio = interval(variance(of) / variance(found["none"]), confidence)
        snr = UNKNOWN if name == "floor" else interval(signal_to_noise(of), confidence)
        bias = float("nan") if name == "floor" else relative_bias(functions[name], rollout)
        took = seconds.get(name, float("nan"))
        rows.append(BaselineRow(name, interval(variance(of), confidence), ratio, snr, bias, took))
    return rows


def grams(
    rollout: Rollout, baselines: dict[str, th.Tensor], weighted: th.Tensor, scores: th.Tensor
) -> dict[str, th.Tensor]:
    """
    ``K_ij = ⟨g_i, g_j⟩`` of the episodes' gradients for each baseline, and for the floor.

    With ``A = Σ_t γ^t ∇log π G_t`` and ``S = Σ_t γ^t ∇log π``, a baseline that is a constant b along an episode leaves
    A − b S, without another derivative. What other baselines leave is taken in groups, to bound the memory.

    :param rollout: m whole episodes
    :param baselines: b_t by name, each of shape ``(n_steps, n_envs)``
    :param weighted: A of each episode, shape ``(m, n)``
    :param scores: S of each episode, shape ``(m, n)``
    :return: Gram matrices by name, shape ``(m, m)``, float64
    """
    used, n_episodes = rollout.used, len(th.unique(rollout.episodes[rollout.used]))
    rank = th.unique(rollout.episodes[used], return_inverse=True)[1]
    found = {"floor": gram(componentwise_residuals(weighted, scores))}
    varying = {}
    for name, baseline in baselines.items():
        constants = th.zeros(n_episodes, dtype=baseline.dtype).index_copy_(0, rank, baseline[used])
        if th.equal(constants[rank], baseline[used]):
            found[name] = gram(weighted - constants.to(scores)[:, None] * scores)
        else:
            varying[name] = rollout.discounts * (rollout.returns - baseline)
    names, at_once = list(varying), max(1, 4 * CHUNK // scores.numel())
    for group in (names[i : i + at_once] for i in range(0, len(names), at_once)):
        gradients = gradients_by_episode(rollout, *(varying[name] for name in group))
        found |= {name: gram(g) for name, g in zip(group, gradients, strict=True)}
    return {name: found[name] for name in (*baselines, "floor")}


def gram(gradients: th.Tensor) -> th.Tensor:
    """
    ``K = g gᵀ``.

    :param gradients: Shape ``(m, n)``
    :return: Shape ``(m, m)``, float64, on the CPU
    """
    gradients = gradients.double()
    product: th.Tensor = (gradients @ gradients.T).cpu()
    return product


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


def relative_bias(baseline: Baseline, rollout: Rollout) -> float:
    """
    ``‖E g − E g_none‖ / ‖E g_none‖`` where theory knows it: 0, or 1/N where each of N returns is in its own mean.

    :param baseline: The baseline
    :param rollout: N whole episodes
    :return: NaN where it is not known
    """
    if baseline in [BASELINES[name] for name in ("none", "leave_one_out", "value", "optimal")]:
        return 0.0
    lengths = th.unique(rollout.episodes[rollout.used], return_counts=True)[1]
    one_length, one_step = bool((lengths == lengths[0]).all()), bool((lengths == 1).all())
    own_return_in_mean = (baseline is BASELINES["time_mean"] and one_length) or (
        baseline is BASELINES["mean"] and one_step
    )
    return 1 / len(lengths) if own_return_in_mean else float("nan")
