"""
The variance of the gradient against the episodes behind it, for each baseline, on CartPole-v1.

A policy is trained for a while; at its θ, batches of N whole episodes are weighed by every baseline, all by the same
episodes. The variance is the trace of the covariance between batches, taken in 8 groups for the interval. It writes a
CSV and the picture of the page on the gradient lab.

    python examples/benchmarks/variance_vs_episodes.py
"""

import argparse
import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE, Rollout
from sb3_reinforce.diagnostics import gradients_by_episode, sample
from sb3_reinforce.diagnostics.plots import plot_variances
from sb3_reinforce.estimation import BASELINES

SIZES, N_GROUPS = (4, 8, 16, 32), 8


def batch_gradients(rollout: Rollout) -> th.Tensor:
    """The mean over the rollout's episodes of their gradients, for each baseline, shape (n_baselines, n)."""
    weights = [rollout.discounts * (rollout.returns - baseline(rollout)) for baseline in BASELINES.values()]
    return gradients_by_episode(rollout, *weights).mean(1)


def batches_of(model: REINFORCE, size: int, n_batches: int) -> Iterator[th.Tensor]:
    """Gradients of batches of so many episodes, shape (n_batches, n_baselines, n); no episode is in two of them."""
    rollout = sample(model, size * n_batches)
    for episodes in rollout.used_episodes.split(size):
        yield batch_gradients(replace(rollout, used=rollout.used & th.isin(rollout.episodes, episodes)))


def draw(variances: np.ndarray, timesteps: int, n_batches: int, path: Path) -> None:
    """The picture of variances of shape (n_groups, n_sizes, n_baselines)."""
    matplotlib.use("agg")
    unbiased = ("none", "leave_one_out", "value", "optimal")
    labels = [name if name in unbiased else f"{name} (biased)" for name in BASELINES]
    ax = plot_variances({label: variances[:, :, index] for index, label in enumerate(labels)}, SIZES)
    measured = f"mean of {len(variances)} groups of {n_batches} gradients"
    ax.set_title(f"CartPole-v1, one policy after {timesteps:,} steps\n{measured}", fontsize="medium")
    ax.figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timesteps", type=int, default=20_000)
    parser.add_argument("--batches", type=int, default=8, help="batches of each size and group")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    env = make_vec_env("CartPole-v1", n_envs=8, seed=arguments.seed)
    model = REINFORCE("MlpPolicy", env, gae_lambda=1.0, seed=arguments.seed, device="cpu").learn(arguments.timesteps)
    groups = [[th.stack([*batches_of(model, size, arguments.batches)]) for size in SIZES] for _ in range(N_GROUPS)]
    variances = np.array([[gradients.var(0).sum(1).tolist() for gradients in group] for group in groups])
    arguments.output.mkdir(parents=True, exist_ok=True)
    with open(arguments.output / "variance_vs_episodes.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["baseline", "n_episodes", "group", "variance"])
        for index, name in enumerate(BASELINES):
            for group, row in enumerate(variances[:, :, index]):
                points = zip(SIZES, row, strict=True)
                writer.writerows([name, size, group, f"{variance:.6g}"] for size, variance in points)
    for index, name in enumerate(BASELINES):
        print(f"{name:14s}", *(f"{variance:10.1f}" for variance in variances[:, :, index].mean(0)))
    draw(variances, arguments.timesteps, arguments.batches, arguments.output / "variance_vs_episodes.png")


if __name__ == "__main__":
    main()
