"""
How fast does CnnPolicy learn from images, on a GPU or not?

Images of Atari's size (84 x 84 x 4), REINFORCE beside A2C with rollouts of 32 steps and their other defaults; the
environments show prepared images, so the networks and the way of the observations to them are what is measured.

    python examples/benchmarks/images.py --device cuda --n-envs 16 64
"""

import argparse
import csv
import statistics
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from rates import learning
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE


class Images(gym.Env[np.ndarray, np.int64]):
    """Shows prepared images, in episodes of 100 steps, so that it costs next to nothing."""

    observation_space, action_space = spaces.Box(0, 255, (84, 84, 4), np.uint8), spaces.Discrete(6)
    images = np.random.default_rng(0).integers(256, size=(100, 84, 84, 4), dtype=np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.t = 0
        return self.images[0], {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.t += 1
        return self.images[self.t % 100], float(action == self.t % 6), False, self.t == 100, {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-envs", type=int, nargs="+", default=[16])
    parser.add_argument("--timesteps", type=int, default=2048)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(["n_envs", "device", "REINFORCE / A2C"])
    for n_envs in arguments.n_envs:
        kwargs = {"n_steps": 32, "device": arguments.device}
        ratios = []
        for _ in range(arguments.rounds):
            rates = [
                learning(algorithm, "CnnPolicy", make_vec_env(Images, n_envs), arguments.timesteps, **kwargs)
                for algorithm in (REINFORCE, A2C)
            ]
            ratios.append(rates[0] / rates[1])
        writer.writerow([n_envs, arguments.device, f"{statistics.median(ratios):.2f}"])
        sys.stdout.flush()


if __name__ == "__main__":
    main()
