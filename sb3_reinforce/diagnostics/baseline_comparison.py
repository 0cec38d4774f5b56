"""Every baseline on the same episodes: which one leaves the least noise in the gradient of a task."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch as th

from sb3_reinforce.common.arguments import check_choice, check_function, check_integer, check_number
from sb3_reinforce.diagnostics.sampling import check_model, sample, seeded
from sb3_reinforce.diagnostics.statistics import compute_moments, gram, signal_to_noise, variance
from sb3_reinforce.diagnostics.tables import UNKNOWN, Estimate, Table, interval, resample_counts
from sb3_reinforce.estimation.baselines import BASELINES, Baseline
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import gradient_blocks
from sb3_reinforce.estimation.weights import returns_minus_baseline
from sb3_reinforce.reinforce import REINFORCE


@dataclass(frozen=True)
class BaselineRow:
    """
    One baseline of a comparison.

    :param baseline: Its name
    :param variance: tr Σ, the trace of the covariance of the gradient of one episode
    :param ratio: tr Σ divided by the tr Σ of the reference, from the same resamples of the same episodes
    :param snr: ``‖E g‖² / tr Σ`` of one episode, NaN for the floor; the mean of N episodes has N times that
    :param bias: ``‖E g − E g_none‖ / ‖E g_none‖`` where it is known in theory, else NaN
    :param seconds: Time to compute b_t; NaN for the floor
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
    progress_bar: bool = False,
) -> Table[BaselineRow]:
    """
    Measure the noise that each baseline leaves in the gradient of the same whole episodes.

    The model's policy samples the episodes, with the model's own returns (γ, λ, reward-to-go); the gradient of an
    episode is the sum over its steps. The table always has the row ``"none"``, and ends with the ``"floor"``: the best
    constant for each single component of the gradient, fitted to these episodes. No scalar constant has a smaller
    variance; a baseline that depends on the time or the state can.

    With an MlpPolicy, all names together cost a few forward and backward passes over the episodes, which
    ``examples/benchmarks/comparison_cost.py`` measures.

    :param model: The model; it is not changed, but a baseline with a memory learns from these episodes too. Its
        environments are left at the start of an episode
    :param n_episodes: Number of episodes, at least 3
    :param baselines: Names or functions; None for all names, ``"value"`` only if the model has a critic
    :param reference: Name of the baseline in the denominator of ``ratio``
    :param n_resamples: Number of bootstrap resamples
    :param confidence: Probability with which an interval should cover the true value
    :param seed: Seed of the resamples and of the actions; the environments continue with their own generators
    :param progress_bar: Display a bar of tqdm that counts the episodes
    :return: A table with one ``BaselineRow`` per baseline
    :raises TypeError: If the model is not a REINFORCE, or a baseline neither a name nor callable
    :raises ValueError: If an argument is out of its range, a name is unknown, belongs to two functions or is
        ``"floor"``, ``"value"`` is given without a critic, the reference is not among the baselines, the model has no
        environment or is collecting a rollout, or the episodes are not independent because they share the noise of gSDE
    """
    check_model(model, independent=True)
    if baselines is None:
        baselines = [name for name in BASELINES if name != "value" or model.has_critic]
    functions = functions_of(baselines)
    check_critic(model, functions)
    check_integer("n_episodes", n_episodes, 3)
    check_choice("reference", reference, tuple(functions))
    check_number("confidence", confidence, 0, 1)
    seed = check_integer("seed", seed, 0)
    counts = resample_counts(n_episodes, n_resamples, seed)
    with seeded(model.policy, seed):
        rollout = sample(model, n_episodes, progress_bar=progress_bar)
        rows = baseline_rows(rollout, functions, reference, counts, confidence)
    legend = {
        "variance": "trace of the covariance of the gradient of one episode",
        "ratio": f"variance / variance of {reference!r}, on the same resamples",
        "snr": "squared norm of the expected gradient / variance; an interval that includes 0: no signal detected",
        "bias": "relative to the gradient of 'none', where it is known in theory",
        "seconds": "time to compute the baseline",
        "[a, b]": f"{confidence:.0%} bootstrap interval; -: not known",
    }
    title = f"Gradient of one episode by baseline ({n_episodes} episodes; floor = best constant per component)"
    return Table(title, rows, legend)


def functions_of(baselines: Any) -> dict[str, Baseline]:
    """Check names and functions of baselines, and return the functions by name, ``"none"`` first."""
    functions: dict[str, Baseline] = {"none": BASELINES["none"]}
    n_unnamed = 0
    is_single = isinstance(baselines, str) or not isinstance(baselines, Iterable)
    for baseline in [baselines] if is_single else baselines:
        function = check_function("baselines", baseline, BASELINES)
        name = baseline if isinstance(baseline, str) else getattr(baseline, "__name__", None)
        if name is None:
            n_unnamed += 1
            name = f"{type(baseline).__name__}_{n_unnamed}"
        if name == "floor" or functions.get(name, function) is not function:
            raise ValueError(
                f"baselines must have names that differ from each other and from 'floor', and {name!r} is taken: set "
                "the __name__ of your function"
            )
        functions[name] = function
    return functions


def check_critic(model: REINFORCE, functions: Mapping[str, Baseline]) -> None:
    """Refuse ``"value"`` for a model without a critic."""
    if BASELINES["value"] in functions.values() and not model.has_critic:
        raise ValueError(
            f"baselines has 'value', but the model has no critic, as its baseline is {model.baseline!r}: leave "
            "'value' out, or train a model with baseline='value'"
        )


def baseline_rows(
    rollout: Rollout, functions: dict[str, Baseline], reference: str, counts: th.Tensor, confidence: float
) -> list[BaselineRow]:
    """The rows of ``compare_baselines`` from whole episodes, with ``counts`` (r, m) of their resamples."""
    weights = {}
    seconds = {"floor": float("nan")}
    for name, function in functions.items():
        begin = time.perf_counter()
        weights[name] = weights_by(function, rollout)
        seconds[name] = time.perf_counter() - begin
    found = {name: compute_moments(products, counts) for name, products in gram_matrices(rollout, weights).items()}
    return [
        BaselineRow(
            baseline=name,
            variance=interval(variance(moments), confidence),
            ratio=interval(variance(moments) / variance(found[reference]), confidence),
            snr=UNKNOWN if name == "floor" else interval(signal_to_noise(moments), confidence),
            bias=float("nan") if name == "floor" else relative_bias(functions[name], rollout),
            seconds=seconds[name],
        )
        for name, moments in found.items()
    ]


def weights_by(baseline: Baseline, rollout: Rollout) -> th.Tensor:
    """``γ^t (G_t − b_t)`` with a baseline, shape ``(n_steps, n_envs)``, float64."""
    return rollout.discounts * returns_minus_baseline(rollout, baseline(rollout))


def relative_bias(baseline: Baseline, rollout: Rollout) -> float:
    """``‖E g − E g_none‖ / ‖E g_none‖``: 0, 1/N if each of N returns is in its mean, or NaN if unknown."""
    if baseline in [BASELINES[name] for name in ("none", "leave_one_out", "value", "optimal")]:
        return 0.0
    lengths = th.unique(rollout.episodes[rollout.used], return_counts=True)[1]
    one_length = bool((lengths == lengths[0]).all())
    one_step = bool((lengths == 1).all())
    own_return_in_mean = (baseline is BASELINES["time_mean"] and one_length) or (
        baseline is BASELINES["mean"] and one_step
    )
    return 1 / len(lengths) if own_return_in_mean else float("nan")


def gram_matrices(rollout: Rollout, weights: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
    """``K_ij = ⟨g_i, g_j⟩`` (m, m) for weights (n_steps, n_envs) by baseline, ``"none"`` first, and the ``"floor"``."""
    n_episodes = len(rollout.used_episodes)
    found = {name: th.zeros(n_episodes, n_episodes, dtype=th.float64) for name in (*weights, "floor")}
    for scores, *gradients in gradient_blocks(rollout, rollout.discounts, *weights.values()):
        for name, each in zip(weights, gradients, strict=True):
            found[name] += gram(each)
        found["floor"] += gram(componentwise_residuals(gradients[0], scores))
    return found


def componentwise_residuals(weighted: th.Tensor, scores: th.Tensor) -> th.Tensor:
    """
    ``A_ik − b_k S_ik`` (m, n) with the constant of least variance ``b_k = Cov(A_k, S_k) / Var(S_k)`` for component k.

    Peters and Schaal (2008), section 3.2, with sample covariances for E[A S] and E[S²], as E[S] = 0. Fitted to the
    episodes that it is applied to, the variance is too small by a share of about 1/m.
    """
    centered = scores - scores.mean(0)
    squares = centered.square().sum(0)
    best = ((weighted - weighted.mean(0)) * centered).sum(0) / squares.clamp(min=th.finfo(squares.dtype).tiny)
    return weighted - best * scores
