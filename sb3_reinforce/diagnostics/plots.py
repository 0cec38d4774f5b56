"""
Pictures of what ``diagnostics`` measures. They need matplotlib: ``pip install "sb3-reinforce[plots]"``.

Each function draws on the Axes that it is given, or on new ones, and returns them: ``ax.figure.savefig(...)`` works
without a display.
"""

from collections.abc import Mapping
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

try:
    import matplotlib.pyplot as plt
    from matplotlib.axes import Axes
    from matplotlib.ticker import NullLocator
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "sb3_reinforce.diagnostics.plots needs matplotlib: pip install 'sb3-reinforce[plots]'"
    ) from error

from sb3_reinforce.common.arguments import check_integer, check_number
from sb3_reinforce.diagnostics.comparisons import BaselineRow
from sb3_reinforce.diagnostics.landscapes import Landscape
from sb3_reinforce.diagnostics.tables import Table
from sb3_reinforce.estimation.returns import Floats

# Colours that readers with any colour vision tell apart (Okabe and Ito, 2008)
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")
# Those that are seen on the blue, green and yellow of a landscape
ON_LANDSCAPE = ("#FFFFFF", "#D55E00", "#CC79A7", "#000000", "#E69F00")
# For print in grey
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def new_axes(ax: Axes | None) -> Axes:
    """
    The Axes to draw on.

    :param ax: Axes, or None for new ones
    """
    if ax is not None:
        return ax
    axes: Axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")[1]
    return axes


def plot_baselines(table: Table[BaselineRow], ax: Axes | None = None) -> Axes:
    """
    The variance of the gradient of one episode for each baseline, with its interval; the floor as a line.

    :param table: What ``compare_baselines`` returned
    :param ax: Axes to draw on
    """
    ax = new_axes(ax)
    rows = [row for row in table if row.baseline != "floor"]
    values = np.array([row.variance.value for row in rows])
    ends = np.array([[row.variance.low for row in rows], [row.variance.high for row in rows]])
    # On a logarithmic axis a bar has no foot to be compared from
    ax.hlines(range(len(rows)), *ends, color=COLOURS[0], linewidth=2)
    ax.plot(values, range(len(rows)), linestyle="", marker=MARKERS[0], color=COLOURS[0])
    ax.set_yticks(range(len(rows)), [row.baseline for row in rows])
    ax.axvline(table["floor"].variance.value, color=COLOURS[3], linestyle="--", label="best constant per component")
    ax.invert_yaxis()
    ax.grid(axis="x", alpha=0.3)
    ax.set(xscale="log", xlabel="variance of one episode's gradient")
    ax.set_title(table.title, wrap=True)
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, -0.35), frameon=False)
    return ax


def interquartile_mean(scores: Floats) -> Floats:
    """
    The mean of the middle half of the scores (Agarwal et al., 2021, section 4.3).

    :param scores: Shape ``(n_scores, ...)``
    :return: Shape ``(...)``
    """
    ordered, cut = np.sort(scores, axis=0), len(scores) // 4
    middle: Floats = ordered[cut : len(scores) - cut].mean(axis=0)
    return middle


def interquartile_interval(
    runs: Floats, n_resamples: int, confidence: float, seed: int
) -> tuple[Floats, Floats, Floats]:
    """
    The interquartile mean over runs and tasks, and the percentile interval of a bootstrap that resamples the runs of
    each task for itself (Agarwal et al., 2021, section 4.1).

    :param runs: Shape ``(n_runs, n_tasks, n_points)``
    :param n_resamples: Bootstrap resamples
    :param confidence: Probability that the interval is to cover the truth, at each point
    :param seed: Seed of the resamples
    :return: The mean and the two ends, each of shape ``(n_points,)``
    """
    n_runs, n_tasks, n_points = runs.shape
    generator, tasks = np.random.default_rng(seed), np.arange(n_tasks)
    drawn = (runs[generator.integers(n_runs, size=(n_runs, n_tasks)), tasks] for _ in range(n_resamples))
    resampled = np.stack([interquartile_mean(sample.reshape(-1, n_points)) for sample in drawn])
    low, high = np.quantile(resampled, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return interquartile_mean(runs.reshape(-1, n_points)), low, high


def plot_learning_curves(
    runs: Mapping[str, ArrayLike],
    timesteps: ArrayLike,
    ax: Axes | None = None,
    n_resamples: int = 500,
    confidence: float = 0.95,
    seed: int = 0,
) -> Axes:
    """
    The interquartile mean of several runs with its interval, for each of some algorithms.

    :param runs: By name, scores of shape ``(n_runs, n_points)`` or ``(n_runs, n_tasks, n_points)``
    :param timesteps: Environment steps of the points, shape ``(n_points,)``
    :param ax: Axes to draw on
    :param n_resamples: Bootstrap resamples
    :param confidence: Probability that an interval is to cover the truth, at each point
    :param seed: Seed of the resamples
    :raises ValueError: If there are fewer than two runs, or the shapes do not go together
    """
    ax, x = new_axes(ax), np.asarray(timesteps, dtype=float)
    check_integer("n_resamples", n_resamples, 1)
    check_number("confidence", confidence, 0, 1)
    for index, (name, given) in enumerate(runs.items()):
        scores = np.asarray(given, dtype=float)
        if scores.ndim not in (2, 3) or len(scores) < 2 or scores.shape[-1:] != x.shape:
            raise ValueError(
                f"runs[{name!r}] must be of shape (n_runs, n_points) or (n_runs, n_tasks, n_points), with at least 2 "
                f"runs and n_points = {len(x)}, got {scores.shape}"
            )
        curve, low, high = interquartile_interval(
            scores.reshape(len(scores), -1, len(x)), n_resamples, confidence, seed
        )
        (line,) = ax.plot(x, curve, color=COLOURS[index % len(COLOURS)], label=f"{name} ({len(scores)} runs)")
        ax.fill_between(x, low, high, color=line.get_color(), alpha=0.2)
    ax.set(xlabel="environment steps", ylabel="interquartile mean of the return")
    ax.legend()
    return ax


def plot_variances(
    curves: Mapping[str, ArrayLike], n_episodes: ArrayLike, ax: Axes | None = None, confidence: float = 0.95
) -> Axes:
    """
    The variance of the gradient estimate against the episodes that it is made of: the mean over repetitions and its
    normal interval, for each of some baselines.

    :param curves: By name, variances of shape ``(n_repetitions, n_points)``
    :param n_episodes: Episodes of the points, shape ``(n_points,)``
    :param ax: Axes to draw on
    :param confidence: Probability that an interval is to cover the truth
    """
    ax, x = new_axes(ax), np.asarray(n_episodes, dtype=float)
    width = NormalDist().inv_cdf((1 + check_number("confidence", confidence, 0, 1)) / 2)
    for index, (name, given) in enumerate(curves.items()):
        variances = np.asarray(given, dtype=float)
        mean, error = variances.mean(axis=0), variances.std(axis=0, ddof=1) / np.sqrt(len(variances))
        # Side by side: bands or bars at the same place would hide each other
        shifted = x * 1.05 ** (index - (len(curves) - 1) / 2)
        colour, marker = COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)]
        ax.errorbar(shifted, mean, width * error, color=colour, marker=marker, markersize=5, linewidth=1, label=name)
    ax.set(xscale="log", yscale="log", xlabel="episodes per gradient", ylabel="variance of the gradient")
    ax.set_xticks(x, [f"{episodes:g}" for episodes in x])
    ax.xaxis.set_minor_locator(NullLocator())
    ax.grid(axis="y", alpha=0.3)
    ax.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    return ax


def plot_landscape(scape: Landscape, ax: Axes | None = None) -> Axes:
    """
    U(θ) on a plane through θ, as colours, with the direction in which each estimator's gradient points.

    :param scape: What ``landscape`` returned
    :param ax: Axes to draw on
    """
    ax = new_axes(ax)
    colours = ax.contourf(scape.scales, scape.scales, scape.utilities, levels=20, cmap="viridis")
    ax.figure.colorbar(colours, ax=ax, label="U(θ)")
    ax.plot(0, 0, marker="o", color="white", markeredgecolor="black", zorder=3)
    for index, (name, (x, y)) in enumerate(scape.steps.items()):
        ax.quiver(
            *(0, 0, x, y),
            angles="xy",
            scale_units="xy",
            scale=2,
            color=ON_LANDSCAPE[index % len(ON_LANDSCAPE)],
            edgecolor="black",
            linewidth=0.5,
            width=0.015,
            label=name,
        )
    ax.set(xlabel="first direction", ylabel="second direction", aspect="equal")
    if scape.steps:
        ax.legend(loc="lower left", fontsize="small", facecolor="0.85")
    return ax
