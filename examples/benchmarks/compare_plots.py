"""
What a comparison shows: tables, learning curves, and a summary by rliable (intervals: 95 % of a stratified bootstrap).

    python examples/benchmarks/compare_plots.py results.csv --output results

Writes results_curves.png (the interquartile mean of the seeds against steps, and against CPU seconds, of the seeds that
all algorithms were run on) and results_summary.png (interquartile mean, performance profiles and probability of
improvement over all tasks), and prints the final evaluations. In the summary 0 is a random policy and 1 the Zoo's
published PPO, or another reference; it has the algorithms that were run on every task. --steps-only leaves out the
curves against seconds, which can only be compared between runs on one machine.
"""

import argparse
import math
from collections.abc import Collection, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from rliable import library, metrics

from sb3_reinforce.diagnostics.plots import COLORS, interquartile_interval

REPETITIONS = 2000
LABELS = {
    "reinforce": "REINFORCE", "finite_difference": "FiniteDifference", "a2c": "A2C", "ppo": "PPO", "ars": "ARS",
    "trpo": "TRPO", "reinforce_lstm": "RecurrentREINFORCE", "ppo_lstm": "RecurrentPPO",
}  # fmt: skip
# Mean return of uniformly random actions (100 episodes), and of PPO in the Zoo's benchmark.md, whose versions of
# LunarLander and MuJoCo's tasks are older
REFERENCES = {
    "CartPole-v1": (23.7, 500.0),
    "Acrobot-v1": (-497.1, -73.5),
    "MountainCar-v0": (-200.0, -110.4),
    "MountainCarContinuous-v0": (-33.3, 88.3),
    "Pendulum-v1": (-1207.6, -172.2),
    "LunarLander-v3": (-192.0, 242.1),
    "LunarLanderContinuous-v3": (-212.7, 270.9),
    "BipedalWalker-v3": (-106.3, 287.9),
    "BipedalWalkerHardcore-v3": (-106.2, 122.4),
    "HalfCheetah-v5": (-282.5, 5819.0),
    "Hopper-v5": (16.7, 2410.0),
    "Walker2d-v5": (1.8, 3479.0),
    "Swimmer-v5": (0.8, 281.6),
    "Ant-v5": (-48.0, 1327.0),
    # Tasks without velocities: random actions earn what they earn in the full tasks; RecurrentPPO in benchmark.md
    "CartPoleNoVel-v1": (23.7, 500.0),
    "MountainCarContinuousNoVel-v0": (-33.3, 91.5),
    "PendulumNoVel-v1": (-1207.6, -217.9),
    # For the tasks below benchmark.md has no PPO. The return at which Gymnasium calls CarRacing solved
    "CarRacing-v3": (-32.6, 900.0),
    # PPO at 1M steps in Tianshou's examples/mujoco/README.md, on versions 2 and 3
    "InvertedPendulum-v5": (5.2, 1000.0),
    "InvertedDoublePendulum-v5": (49.1, 9231.3),
    "Reacher-v5": (-43.3, -4.1),
    "Humanoid-v5": (112.6, 787.1),
    # Version 2, median of six models that qgallouedec trained with the Zoo's PPO and put on the Hugging Face Hub
    "HumanoidStandup-v5": (33320.2, 148896.1),
}


def curve(runs: pd.DataFrame, column: str, end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The interquartile mean of runs and its interval, on 50 points from 0 to ``end`` of a column."""
    points = np.linspace(0, end, 50)
    scores = np.array([np.interp(points, run[column], run["return"]) for _, run in runs.groupby("seed")])
    return points, *interquartile_interval(scores[:, None], REPETITIONS, 0.95, seed=0)


def draw_curves(results: pd.DataFrame, columns: Sequence[str]) -> None:
    tasks = list(results.groupby(["task", "budget"], sort=False))
    n_columns = min(len(tasks) * len(columns), 4)
    n_rows = math.ceil(len(tasks) * len(columns) / n_columns)
    # The legend needs the width of two columns
    size = (3 * max(n_columns, 2), 2.4 * n_rows)
    figure, grid = plt.subplots(n_rows, n_columns, figsize=size, layout="constrained", squeeze=False)
    rows = grid.reshape(-1, len(columns))
    for axes, ((task, budget), runs) in zip(rows, tasks, strict=False):
        common = set.intersection(*(set(mine["seed"]) for _, mine in runs.groupby("algorithm")))
        timed = runs[runs["seed"].isin(common)]
        for axis, column in zip(axes, columns, strict=True):
            drawn = runs if column == "steps" else timed
            for algorithm, mine in drawn.groupby("algorithm", sort=False):
                end = budget if column == "steps" else mine[mine["evaluation"] == "final"][column].median()
                points, iqm, low, high = curve(mine, column, end)
                axis.plot(points, iqm, color=color(algorithm), label=LABELS.get(algorithm, algorithm))
                axis.fill_between(points, low, high, color=color(algorithm), alpha=0.2, linewidth=0)
            axis.set(title=task, xlabel="CPU seconds", xscale="symlog")
        axes[0].set(xlabel="steps", ylabel="return", xscale="linear", xticks=(0, budget))
        axes[0].set_xticklabels(("0", f"{budget:,}"))
        for axis in axes:
            # The bands of early runs that fail would leave the lines little height
            values = np.concatenate([line.get_ydata() for line in axis.get_lines()])
            margin = 0.05 * np.ptp(values)
            axis.set_ylim(values.min() - margin, values.max() + margin)
            axis.title.set_fontsize("medium")
    for axis in rows[len(tasks) :].flat:
        axis.set_axis_off()
    # An algorithm need not have been run on the first task
    lines = {line.get_label(): line for axis in rows[:, 0] for line in axis.get_lines()}
    legend = {"loc": "outside upper center", "ncols": len(lines), "frameon": False}
    counts = results.groupby(["task", "algorithm"])["seed"].nunique()
    title = f"interquartile mean of {seeds(counts)}, bands: 95 % bootstrap intervals"
    figure.legend(handles=list(lines.values()), title=title, **legend)


def seeds(counts: Collection[int]) -> str:
    """The least and the greatest number of seeds, for a title."""
    return f"{min(counts)} seeds" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)} seeds"


def color(algorithm: str) -> str:
    # RecurrentPPO has REINFORCE's color, and is in no picture with it
    return COLORS[list(LABELS).index(algorithm) % len(COLORS)] if algorithm in LABELS else "black"


def final_scores(results: pd.DataFrame) -> dict[str, np.ndarray]:
    """Normalized final returns of each algorithm, of the seeds run on every task, shape ``(n_runs, n_tasks)``."""
    final = results[results["evaluation"] == "final"].copy()
    unknown = set(final["task"]) - REFERENCES.keys()
    if unknown:
        raise ValueError(f"REFERENCES has no random and no good return of {', '.join(sorted(unknown))}: add them")
    low, high = np.array([REFERENCES[task] for task in final["task"]]).T
    final["return"] = (final["return"] - low) / (high - low)
    table = final.pivot_table(index=["algorithm", "seed"], columns=["task", "budget"], values="return", sort=False)
    complete = table.dropna()
    left_out = [f"{LABELS.get(name, name)} (seed {seed})" for name, seed in table.index.difference(complete.index)]
    if left_out:
        print("Left out of the summary, which needs a run on every task:", ", ".join(left_out))
    return {name: runs.to_numpy() for name, runs in complete.groupby("algorithm", sort=False)}


def draw_summary(scores: dict[str, np.ndarray]) -> None:
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    n_tasks = next(iter(scores.values())).shape[1]
    counts = [len(score) for score in scores.values()]
    figure.suptitle(f"{n_tasks} tasks, {seeds(counts)}; bars and bands are 95 % bootstrap intervals", fontsize="medium")
    means, intervals = library.get_interval_estimates(scores, metrics.aggregate_iqm, reps=REPETITIONS)
    draw_intervals(left, means, intervals)
    left.set(title="All tasks together", xlabel="interquartile mean of the return\n(0: random, 1: published PPO)")
    thresholds = np.linspace(0, 1.2, 61)
    profiles, bands = library.create_performance_profile(scores, thresholds, reps=REPETITIONS)
    for name, profile in profiles.items():
        middle.plot(thresholds, profile, color=color(name), label=LABELS.get(name, name))
        middle.fill_between(thresholds, *bands[name], color=color(name), alpha=0.2, linewidth=0)
    middle.set(title="Performance profiles", xlabel="normalized return τ", ylabel="share of runs above τ")
    middle.legend(frameon=False, fontsize="small")
    others = {name: (scores.get("reinforce"), score) for name, score in scores.items() if name != "reinforce"}
    if "reinforce" not in scores or not others:
        print("No probability of improvement: it needs REINFORCE and another algorithm on every task")
        right.set_axis_off()
        return
    chances, spans = library.get_interval_estimates(others, metrics.probability_of_improvement, reps=REPETITIONS)
    draw_intervals(right, chances, spans)
    right.axvline(0.5, color="grey", linestyle=":")
    right.set(title="Probability of improvement", xlabel="probability that REINFORCE ends higher", xlim=(0, 1))


def draw_intervals(axis: Axes, values: dict[str, np.ndarray], intervals: dict[str, np.ndarray]) -> None:
    for row, (name, value) in enumerate(values.items()):
        low, high = np.ravel(intervals[name])
        axis.barh(row, high - low, left=low, height=0.5, color=color(name), alpha=0.5)
        axis.plot(2 * [float(value)], [row - 0.25, row + 0.25], color="black")
    # An interval that begins at the edge of the picture would look cut
    axis.use_sticky_edges = False
    axis.autoscale_view()
    axis.set_yticks(range(len(values)), [LABELS.get(name, name) for name in values])
    axis.invert_yaxis()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+", help="CSVs that compare.py has written")
    parser.add_argument("--output", type=Path, required=True, help="path of the pictures, without suffix")
    parser.add_argument("--steps-only", action="store_true", help="draw no curves against seconds")
    arguments = parser.parse_args()
    matplotlib.use("agg")
    results = pd.concat(pd.read_csv(path) for path in arguments.results)
    runs = results.loc[results["evaluation"] == "final", ["task", "algorithm", "seed", "budget"]]
    if runs.duplicated().any():
        twice = runs[runs.duplicated()].iloc[0].to_dict()
        parser.error(f"results have {twice} twice: remove the second file or the repeated rows")
    order = [*LABELS, *sorted(set(results["algorithm"]) - LABELS.keys())]
    results = results.sort_values(
        ["task", "budget", "algorithm"],
        key=lambda column: column.map(order.index) if column.name == "algorithm" else column,
        kind="stable",
    )
    final = results[results["evaluation"] == "final"].groupby(["task", "budget", "algorithm"], sort=False)
    print(final[["return", "cpu_seconds"]].agg(["count", "median", "min", "max"]).to_string())
    draw_curves(results, ("steps",) if arguments.steps_only else ("steps", "cpu_seconds"))
    plt.savefig(arguments.output.with_name(f"{arguments.output.name}_curves.png"), dpi=120)
    scores = final_scores(results)
    if not scores:
        raise SystemExit("No algorithm was run on every task: there is no summary to draw")
    draw_summary(scores)
    plt.savefig(arguments.output.with_name(f"{arguments.output.name}_summary.png"), dpi=120)


if __name__ == "__main__":
    main()
