"""
Can the noise scale of the gradient choose the number of episodes in a rollout?

The noise scale tr Σ / ‖E g‖² (McCandlish et al. 2018, arXiv:1812.06162) is the number of episodes with a
signal-to-noise ratio of 1. Here a callback sets ``n_episodes`` to the median of the last ten estimates, rounded to a
multiple of the environments and cut to the range of the fixed sizes. It starts with the second of them. All get the
settings of ``sb3_reinforce.zoo`` with whole episodes instead of ``n_steps``, without gSDE, whose noise episodes
share, and train until a rollout reaches the number of steps. A row of the CSV is the return of 100 deterministic
episodes after one training.

    python examples/benchmarks/noise_scale.py --seeds 100 101 102 103 104 105 --output noise_scale.csv
"""

import argparse
import csv
import itertools
import warnings
from collections import deque
from pathlib import Path

import numpy as np
import torch as th
from compare import Run, make
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import sync_envs_normalization

from sb3_reinforce import Rollout
from sb3_reinforce.diagnostics import GradientQualityCallback

BUDGETS = {
    "CartPole-v1": 50_000, "Acrobot-v1": 100_000, "InvertedPendulum-v5": 100_000, "Pendulum-v1": 100_000,
    "LunarLander-v3": 100_000,
}  # fmt: skip
SIZES = (8, 16, 32, 64)


class NoiseScaleEpisodes(GradientQualityCallback):
    """Sets ``n_episodes`` to the median of the last noise scales, and keeps the sizes of the rollouts."""

    def __init__(self) -> None:
        super().__init__(every=1, baselines=(), max_episodes=SIZES[-1])
        self.scales: deque[float] = deque(maxlen=10)
        self.sizes: list[int] = []

    def measure(self, rollout: Rollout) -> dict[str, float]:
        self.sizes.append(self.model.n_episodes)
        figures = super().measure(rollout)
        self.scales.append(figures["noise_scale"])
        scale = np.clip(np.median(self.scales), SIZES[0], SIZES[-1])
        # With unequal quotas some environments would wait for others
        self.model.n_episodes = self.model.n_envs * max(1, round(scale / self.model.n_envs))
        return figures


def train(run: Run, size: int | None) -> tuple[float, float]:
    """The final return with rollouts of ``size`` episodes, or with the callback, and the mean number of episodes."""
    model, env, eval_env = make(run, {"n_steps": None, "n_episodes": size or SIZES[1], "use_sde": False})
    callback = NoiseScaleEpisodes()
    model.learn(run.budget, None if size else callback, log_interval=None)
    sync_envs_normalization(env, eval_env)
    mean, _ = evaluate_policy(model, eval_env, 100)
    return float(mean), size or float(np.mean(callback.sizes))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(BUDGETS), choices=list(BUDGETS))
    parser.add_argument("--seeds", nargs="+", type=int, required=True)
    parser.add_argument("--timesteps", type=int, help="steps per run; the default depends on the task")
    parser.add_argument("--output", type=Path, required=True, help="a new CSV")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    # Its runs take hours: an older file is kept
    with open(arguments.output, "x", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["task", "budget", "seed", "n_episodes", "mean_episodes", "return"])
        for seed, task, size in itertools.product(arguments.seeds, arguments.tasks, (*SIZES, None)):
            run = Run(task, "reinforce", seed, arguments.timesteps or BUDGETS[task])
            value, episodes = train(run, size)
            row = [task, run.budget, seed, size or "noise_scale", round(episodes, 1), round(value, 1)]
            writer.writerow(row)
            file.flush()
            print(*row)


if __name__ == "__main__":
    main()
