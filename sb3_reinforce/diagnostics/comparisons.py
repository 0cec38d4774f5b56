"""Every baseline on the same episodes: which of them leaves the least noise in the gradient on a task."""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import torch as th

from sb3_reinforce.common.arguments import check_choice, check_function, check_integer, check_number
from sb3_reinforce.diagnostics.baseline_gradients import grams
from sb3_reinforce.diagnostics.bootstrap import UNKNOWN, Estimate, interval, resamples
from sb3_reinforce.diagnostics.moments import moments, signal_to_noise, variance
from sb3_reinforce.diagnostics.sampling import check_independent, check_model, sample, seeded
from sb3_reinforce.diagnostics.tables import Table
from sb3_reinforce.estimation.baselines import BASELINES, Baseline
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.weights import check_baseline
from sb3_reinforce.reinforce import REINFORCE


@dataclass(frozen=True)
class BaselineRow:
    """
    One baseline on the episodes of a comparison.

    :param baseline: Its name
    :param variance: tr Σ, the trace of the covariance of the gradient of one episode
    :param ratio: tr Σ over that of the reference, from the same resamples of the same episodes
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
    reference: str = "none",
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

    What all names cost with an MlpPolicy and 100 episodes of CartPole-v1, in plain forward and backward passes over
    each of these episodes (``examples/benchmarks/comparison_cost.py``; medians of 11 runs, one thread): 1.2 before
    training, and 1.8 with collecting the episodes; for a trained policy, whose episodes last 500 steps, 1.9, and 8.9
    with collecting them, which is the environments' own time for the most part.

    :param model: The model; it is not changed, and its environments are left at the start of an episode
    :param n_episodes: Episodes, at least 3
    :param baselines: Names or functions; None for all names, ``"value"`` only where the model has a critic
    :param reference: Name of the baseline that the ratios of variances are to
    :param n_resamples: Bootstrap resamples behind the intervals
    :param confidence: Probability that an interval is to cover the truth
    :param seed: Seed of the resamples and of the actions; the environments go on from where they are
    :return: A table with a ``BaselineRow`` each
    :raises TypeError: If the model is not a REINFORCE, or a baseline neither a name nor callable
    :raises ValueError: If there are too few episodes, a name is unknown or taken twice, ``"value"`` has no critic, the
        reference is not among the baselines, or episodes are not independent because they share the noise of gSDE
    """
    check_model(model)
    check_independent(model)
    functions, n_episodes = functions_of(model, baselines), check_integer("n_episodes", n_episodes, 3)
    check_choice("reference", reference, tuple(functions))
    check_number("confidence", confidence, 0, 1)
    counts = resamples(n_episodes, check_integer("n_resamples", n_resamples, 1), check_integer("seed", seed, 0))
    with seeded(model.policy, seed):
        rows = baseline_rows(sample(model, n_episodes), functions, reference, counts, confidence)
    return Table(f"Gradient of one episode by baseline ({n_episodes} episodes; floor: of constants)", rows)


def functions_of(model: REINFORCE, baselines: Iterable[str | Baseline] | None) -> dict[str, Baseline]:
    """
    The baselines to compare, by name, ``"none"`` first.

    :param model: The model
    :param baselines: As for ``compare_baselines``
    :raises TypeError: If a baseline is neither a name nor callable
    :raises ValueError: If a name is unknown, taken by another baseline or by a row, or ``"value"`` has no critic
    """
    if baselines is None:
        baselines = [name for name in BASELINES if name != "value" or model.has_critic]
    functions: dict[str, Baseline] = {"none": BASELINES["none"]}
    if not isinstance(baselines, Iterable) or isinstance(baselines, str):
        baselines = [cast(str | Baseline, baselines)]
    for baseline in baselines:
        function = check_function("baselines", baseline, BASELINES)
        if function is BASELINES["value"] and not model.has_critic:
            raise ValueError(
                f"baselines has 'value', and the model has no critic: its baseline is {model.baseline!r}. Train one "
                "with baseline='value', or leave it out"
            )
        name = baseline if isinstance(baseline, str) else getattr(baseline, "__name__", repr(baseline))
        if name in ("optimal", "floor") and function is not BASELINES.get(name):
            raise ValueError(
                f"baselines has a function named {name!r}, which is the name of a row: give it another one"
            )
        if functions.setdefault(name, function) is not function:
            raise ValueError(f"baselines must have names that differ, and two of its functions are named {name!r}")
    return functions


def baseline_rows(
    rollout: Rollout, functions: dict[str, Baseline], reference: str, counts: th.Tensor, confidence: float
) -> list[BaselineRow]:
    """
    The rows of ``compare_baselines``.

    :param rollout: Whole episodes
    :param functions: Baselines by name, ``"none"`` first
    :param reference: Name of the baseline that the ratios are to
    :param counts: As ``resamples`` draws them, shape ``(r, m)``
    :param confidence: Probability that an interval is to cover the truth
    """
    values, seconds = {}, {"floor": float("nan")}
    for name, function in functions.items():
        if function is not BASELINES["optimal"]:
            begin = time.perf_counter()
            values[name] = th.as_tensor(check_baseline(function(rollout), rollout))
            seconds[name] = time.perf_counter() - begin
    matrices, seconds["optimal"] = grams(rollout, values)
    found = {name: moments(matrices[name], counts) for name in (*functions, "floor")}
    rows = []
    for name, of in found.items():
        ratio = interval(variance(of) / variance(found[reference]), confidence)
        snr = UNKNOWN if name == "floor" else interval(signal_to_noise(of), confidence)
        bias = float("nan") if name == "floor" else relative_bias(functions[name], rollout)
        rows.append(BaselineRow(name, interval(variance(of), confidence), ratio, snr, bias, seconds[name]))
    return rows


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
