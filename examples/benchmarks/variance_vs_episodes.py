"""
The variance of the gradient against the episodes behind it, for each baseline, on CartPole-v1.

A policy is trained for a while; at its θ, batches of N whole episodes are weighed by every baseline, all by the same
episodes. The variance is the trace of the covariance between batches, taken in 8 groups for the interval. It writes a
CSV and the picture of the README.

    python examples/benchmarks/variance_vs_episodes.py
"""

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import gradients_by_episode, sample
from sb3_reinforce.diagnostics.plots import plot_variances
from sb3_reinforce.estimation import BASELINES

SIZES, N_GROUPS = (4, 8, 16, 32), 8

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=20_000)
parser.add_argument("--batches", type=int, default=8, help="batches of each size and group")
parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
arguments = parser.parse_args()
th.set_num_threads(1)

env = make_vec_env("CartPole-v1", n_envs=8, seed=arguments.seed)
model = REINFORCE("MlpPolicy", env, gae_lambda=1.0, seed=arguments.seed, device="cpu").learn(arguments.timesteps)


def batch_gradients(rollout):
    """The mean over the rollout's episodes of their gradients, for each baseline, shape (n_baselines, n)."""
    weights = [rollout.discounts * (rollout.returns - baseline(rollout)) for baseline in BASELINES.values()]
    return gradients_by_episode(rollout, *weights).mean(1)


def batches_of(size):
    """Gradients of batches of so many episodes, shape (n_batches, n_baselines, n); no episode is in two of them."""
    rollout = sample(model, size * arguments.batches)
    for episodes in th.unique(rollout.episodes[rollout.used]).split(size):
        yield batch_gradients(replace(rollout, used=rollout.used & th.isin(rollout.episodes, episodes)))


variances = np.array(
    [[th.stack(list(batches_of(size))).var(0).sum(1).tolist() for size in SIZES] for _ in range(N_GROUPS)]
)
arguments.output.mkdir(parents=True, exist_ok=True)
with open(arguments.output / "variance_vs_episodes.csv", "w", newline="") as file:
    writer = csv.writer(file)
    writer.writerow(["baseline", "n_episodes", "group", "variance"])
    for index, name in enumerate(BASELINES):
        for group, row in enumerate(variances[:, :, index]):
            writer.writerows([name, size, group, f"{variance:.6g}"] for size, variance in zip(SIZES, row, strict=True))
for index, name in enumerate(BASELINES):
    print(f"{name:14s}", *(f"{variance:10.1f}" for variance in variances[:, :, index].mean(0)))
labels = [f"{name} (biased)" if name in ("mean", "time_mean") else name for name in BASELINES]
ax = plot_variances({label: variances[:, :, index] for index, label in enumerate(labels)}, SIZES)
ax.set_title(f"Gradients on CartPole-v1 after {model.num_timesteps:,} steps of training, {N_GROUPS} repetitions")
ax.figure.savefig(arguments.output / "variance_vs_episodes.png", dpi=150)
