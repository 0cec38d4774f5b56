"""
Figures of what ``diagnostics`` measures; they need the extra ``plots``: ``pip install "sb3-reinforce[plots]"``.

Each function draws on the given Axes, or on new ones, and returns them: ``ax.figure.savefig(...)`` needs no display.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

try:
    import matplotlib.pyplot as plt
    from matplotlib.axes import Axes
    from matplotlib.ticker import NullLocator
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"sb3_reinforce.diagnostics.plots needs {error.name}: pip install 'sb3-reinforce[plots]'"
    ) from error

from sb3_reinforce.common.arguments import check_integer, check_kind, check_number
from sb3_reinforce.diagnostics.baseline_comparison import BaselineRow
from sb3_reinforce.diagnostics.landscapes import Landscape
from sb3_reinforce.diagnostics.tables import Table
from sb3_reinforce.estimation.returns import Floats

__all__ = ["plot_baselines", "plot_landscape", "plot_learning_curves", "plot_variances"]

# Distinguishable with any color vision (Okabe and Ito, 2008)
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")
# Visible on the grays of a landscape, and apart from each other
ON_LANDSCAPE = ("#D55E00", "#0072B2", "#E69F00", "#009E73", "#CC79A7")
# For grayscale prints
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def new_axes(ax: Axes | None, size: tuple[float, float] = (6.4, 4.0)) -> Axes:
    """The Axes to draw on, new ones for None."""
    if ax is not None:
        return ax
    axes: Axes = plt.subplots(figsize=size, layout="constrained")[1]
    return axes


def arrays_of(name: str, given: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """The arrays of a dictionary with at least one."""
    check_kind(name, given, (Mapping,), "a dictionary of arrays by name")
    if not given:
        raise ValueError(f"{name} must have at least one array, got none")
    return {key: np.asarray(value, dtype=float) for key, value in given.items()}


def plot_baselines(table: Table[BaselineRow], ax: Axes | None = None) -> Axes:
    """
    Plot the ratio of each baseline's variance to the reference's with its paired interval, and the floor as a line.

    Hollow markers are baselines whose gradient is biased, or not known to be unbiased.

    :param table: The result of ``compare_baselines``
    :param ax: Axes to draw on; None for new ones
    :return: The Axes
    :raises TypeError: If ``table`` is not the result of ``compare_baselines``
    """
    check_kind("table", table, (Table,), "the Table that compare_baselines returns")
    check_kind("table's first row", table.rows[0], (BaselineRow,), "a BaselineRow of compare_baselines")
    ax = new_axes(ax)
    rows = [row for row in table if row.baseline != "floor"]
    for y, row in enumerate(rows):
        fill = COLORS[0] if row.bias == 0 else "white"
        ax.hlines(y, row.ratio.low, row.ratio.high, color=COLORS[0], linewidth=2)
        ax.plot(row.ratio.value, y, linestyle="", marker=MARKERS[0], color=COLORS[0], markerfacecolor=fill)
    ax.set_yticks(range(len(rows)), [row.baseline for row in rows])
    ax.axvline(table["floor"].ratio.value, color=COLORS[3], linestyle="--", label="floor")
    ax.plot([], linestyle="", marker=MARKERS[0], color=COLORS[0], label="unbiased")
    ax.plot([], linestyle="", marker=MARKERS[0], color=COLORS[0], markerfacecolor="white", label="biased, or unknown")
    ax.invert_yaxis()
    ax.grid(axis="x", alpha=0.3)
    ax.set_xlim(left=0)
    ax.set(xlabel=table.legend["ratio"], title=table.title.replace(" (", "\n("))
    bars = f"lines: {table.legend['[a, b]'].partition(';')[0]}s"
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=3, frameon=False, title=bars)
    return ax


def interquartile_interval(
    runs: Floats, n_resamples: int, confidence: float, seed: int
) -> tuple[Floats, Floats, Floats]:
    """
    Interquartile mean of runs (n_runs, n_tasks, n_points) and its percentile interval, each of shape (n_points,).

    The bootstrap resamples the runs of each task separately (Agarwal et al., 2021, sections 4.1 and 4.3).
    """
    from scipy.stats import trim_mean

    n_runs, n_tasks, n_points = runs.shape
    generator = np.random.default_rng(seed)
    tasks = np.arange(n_tasks)
    drawn = (runs[generator.integers(n_runs, size=(n_runs, n_tasks)), tasks] for _ in range(n_resamples))
    resampled = np.stack([trim_mean(sample.reshape(-1, n_points), 0.25) for sample in drawn])
    low, high = np.quantile(resampled, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return trim_mean(runs.reshape(-1, n_points), 0.25), low, high


def plot_learning_curves(
    runs: Mapping[str, ArrayLike],
    timesteps: ArrayLike,
    ax: Axes | None = None,
    n_resamples: int = 500,
    confidence: float = 0.95,
    seed: int = 0,
) -> Axes:
    """
    Plot the interquartile mean over several runs with its interval, for each of several algorithms.

    :param runs: By name, scores of shape ``(n_runs, n_points)`` or ``(n_runs, n_tasks, n_points)``
    :param timesteps: Environment steps of the points, shape ``(n_points,)``
    :param ax: Axes to draw on; None for new ones
    :param n_resamples: Number of bootstrap resamples
    :param confidence: Probability with which an interval should cover the true value, at each point
    :param seed: Seed of the resamples
    :return: The Axes
    :raises TypeError: If ``runs`` is not a dictionary
    :raises ValueError: If it is empty, there are fewer than two runs, or the shapes do not match
    """
    x = np.asarray(timesteps, dtype=float)
    check_integer("n_resamples", n_resamples, 1)
    check_number("confidence", confidence, 0, 1)
    check_integer("seed", seed, 0)
    given = arrays_of("runs", runs)
    for name, scores in given.items():
        if scores.ndim not in (2, 3) or len(scores) < 2 or scores.shape[-1:] != x.shape:
            raise ValueError(
                f"runs[{name!r}] must be of shape (n_runs, n_points) or (n_runs, n_tasks, n_points), with at least 2 "
                f"runs and n_points = {x.size}, got {scores.shape}"
            )
    ax = new_axes(ax)
    for index, (name, scores) in enumerate(given.items()):
        curve, low, high = interquartile_interval(
            scores.reshape(len(scores), -1, x.size), n_resamples, confidence, seed
        )
        (line,) = ax.plot(x, curve, color=COLORS[index % len(COLORS)], label=f"{name} ({len(scores)} runs)")
        ax.fill_between(x, low, high, color=line.get_color(), alpha=0.2)
    ax.set(xlabel="environment steps", ylabel="interquartile mean of the return", title="Learning curves")
    ax.legend(title=f"bands: {confidence:.0%} bootstrap intervals")
    return ax


def plot_variances(
    curves: Mapping[str, ArrayLike], n_episodes: ArrayLike, ax: Axes | None = None, confidence: float = 0.95
) -> Axes:
    """
    Plot the variance of the gradient estimate against its number of episodes, for each of several baselines.

    A point is the mean over repetitions, with the confidence interval of Student's t distribution. Points are shifted
    sideways, so that none is hidden.

    :param curves: By name, variances of shape ``(n_repetitions, n_points)``
    :param n_episodes: Episodes of the points, shape ``(n_points,)``
    :param ax: Axes to draw on; None for new ones
    :param confidence: Probability with which an interval should cover the true value
    :return: The Axes
    :raises TypeError: If ``curves`` is not a dictionary
    :raises ValueError: If it is empty, there are fewer than two repetitions, or the shapes do not match
    """
    from scipy.stats import t as student_t

    x = np.asarray(n_episodes, dtype=float)
    if check_number("confidence", confidence, 0, 1) == 1:
        raise ValueError("confidence must be below 1, since an interval of confidence 1 is infinite, got 1")
    given = arrays_of("curves", curves)
    for name, variances in given.items():
        if variances.ndim != 2 or len(variances) < 2 or variances.shape[1:] != x.shape:
            raise ValueError(
                f"curves[{name!r}] must be of shape (n_repetitions, n_points), with at least 2 repetitions and "
                f"n_points = {x.size}, got {variances.shape}"
            )
    ax = new_axes(ax)
    for index, (name, variances) in enumerate(given.items()):
        # The interval of Student's t, since the deviation is estimated too
        width = student_t.ppf((1 + confidence) / 2, len(variances) - 1)
        error = variances.std(axis=0, ddof=1) / np.sqrt(len(variances))
        shifted = x * 1.05 ** (index - (len(curves) - 1) / 2)
        color = COLORS[index % len(COLORS)]
        marker = MARKERS[index % len(MARKERS)]
        mean = variances.mean(axis=0)
        ax.errorbar(shifted, mean, width * error, color=color, marker=marker, markersize=5, linewidth=1, label=name)
    ax.set(xscale="log", yscale="log", xlabel="episodes per gradient", ylabel="variance (trace of the covariance)")
    ax.set_title("Variance of the gradient: means of the repetitions")
    ax.set_xticks(x, [f"{episodes:g}" for episodes in x])
    ax.xaxis.set_minor_locator(NullLocator())
    ax.grid(axis="y", alpha=0.3)
    ax.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False, title=f"bars: {confidence:.0%} intervals")
    return ax


def plot_landscape(scape: Landscape, ax: Axes | None = None) -> Axes:
    """
    Plot U(θ) on a plane through θ in grays, and the gradients as arrows: several of one estimator are a fan.

    :param scape: The result of ``landscape``
    :param ax: Axes to draw on; None for new ones
    :return: The Axes
    :raises TypeError: If ``scape`` is not a ``Landscape``
    """
    check_kind("scape", scape, (Landscape,), "the Landscape that landscape returns")
    ax = new_axes(ax, (6.0, 6.6))
    # Half a step beyond the outer points, which are the centers of pixels
    end = scape.scales[-1] * (1 + 1 / (len(scape.scales) - 1))
    # Interpolated between the points, where contours of noisy utilities would be ragged
    square = (-end, end, -end, end)
    surface = ax.imshow(scape.utilities, cmap="Greys_r", origin="lower", extent=square, interpolation="bicubic")
    ax.figure.colorbar(surface, ax=ax, shrink=0.7, label="U(θ), mean return of an episode")
    for index, (name, steps) in enumerate(scape.steps.items()):
        # The lengths differ by estimator, so that no fan hides another
        x, y = np.atleast_2d(steps).T * (0.9 - 0.6 * index / len(scape.steps))
        color = ON_LANDSCAPE[index % len(ON_LANDSCAPE)]
        arrows = ax.quiver(0 * x, 0 * y, x, y, angles="xy", scale_units="xy", scale=1, width=0.009, color=color)
        arrows.set(label=f"{name} ({len(x)})", edgecolor="black", linewidth=0.4)
    ax.plot(0, 0, marker="o", color="white", markeredgecolor="black", zorder=3)
    points = f"{len(scape.scales)} × {len(scape.scales)} points of {scape.n_episodes} episodes"
    title = f"Utility on a plane through θ (the dot)\n{points}"
    ax.set(xlabel="first direction, in units of ‖θ‖", ylabel="second direction, in units of ‖θ‖", title=title)
    if scape.steps:
        title = "directions of gradients (how many); their lengths mean nothing"
        legend = {"fontsize": "small", "frameon": False, "title": title, "title_fontsize": "small"}
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), **legend)
    return ax
