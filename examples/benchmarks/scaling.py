"""
How does throughput grow with the number of environments, and how far is it from the environments alone?

CartPole-v1 with 1 to 256 copies: REINFORCE and A2C on a DummyVecEnv, REINFORCE on Gymnasium's native vectorization
through ``GymnasiumVecEnv``, and the ``step`` of both VecEnvs with no learner. Writes a CSV and the picture.

    python examples/benchmarks/scaling.py --output examples/benchmarks/results/scaling
"""

import argparse
import csv
import statistics
import warnings
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import matplotlib
import torch as th
from matplotlib import pyplot as plt
from rates import ONE_PASS, bare, learning
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_reinforce import REINFORCE, GymnasiumVecEnv
from sb3_reinforce.diagnostics.plots import COLORS


def dummy(n_envs: int) -> VecEnv:
    return make_vec_env("CartPole-v1", n_envs, seed=0)


def native(n_envs: int) -> VecEnv:
    return VecMonitor(GymnasiumVecEnv(gym.make_vec("CartPole-v1", n_envs, vectorization_mode="vector_entry_point")))


def reinforce(env: VecEnv, timesteps: int) -> float:
    return learning(REINFORCE, "MlpPolicy", env, timesteps, n_steps=max(8, 2048 // env.num_envs), **ONE_PASS)


def a2c(env: VecEnv, timesteps: int) -> float:
    return learning(A2C, "MlpPolicy", env, timesteps, n_steps=max(8, 2048 // env.num_envs))


CONTENDERS: dict[str, Callable[[int, int], float]] = {
    "GymnasiumVecEnv, no learner": lambda n, steps: bare(native(n), steps),
    "DummyVecEnv, no learner": lambda n, steps: bare(dummy(n), steps),
    "REINFORCE, GymnasiumVecEnv": lambda n, steps: reinforce(native(n), steps),
    "REINFORCE": lambda n, steps: reinforce(dummy(n), steps),
    "A2C": lambda n, steps: a2c(dummy(n), steps),
}


def draw(rows: list[dict[str, object]], n_rounds: int, path: Path) -> None:
    matplotlib.use("Agg")
    figure, axes = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
    colors = (COLORS[0], COLORS[1], COLORS[0], COLORS[1], COLORS[2])
    for name, style, color in zip(CONTENDERS, (":", ":", "-o", "-o", "-s"), colors, strict=True):
        points = [(row["n_envs"], row["steps_per_second"]) for row in rows if row["contender"] == name]
        axes.loglog(*zip(*points, strict=True), style, color=color, label=name, markersize=4)
    axes.set(
        title=f"Speed by number of environments: medians of {n_rounds} rounds",
        xlabel="copies of CartPole-v1",
        ylabel="steps a second, one core",
    )
    axes.set_xscale("log", base=2)
    axes.legend(frameon=False, fontsize="small")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-envs", type=int, nargs="+", default=[2**k for k in range(9)])
    parser.add_argument("--timesteps", type=int, default=40_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--output", type=Path, required=True, help="path without suffix")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    rows: list[dict[str, object]] = []
    for n_envs in arguments.n_envs:
        rates = {name: [] for name in CONTENDERS}
        for _ in range(arguments.rounds):
            for name, contender in CONTENDERS.items():
                rates[name].append(contender(n_envs, arguments.timesteps))
        rows += [
            {"n_envs": n_envs, "contender": name, "steps_per_second": round(statistics.median(rates[name]))}
            for name in CONTENDERS
        ]
        print(*rows[-len(CONTENDERS) :], sep="\n", flush=True)
    with arguments.output.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    draw(rows, arguments.rounds, arguments.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
