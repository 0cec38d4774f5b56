"""
Masks in the observation beside sb3-contrib's MaskablePPO: returns at equal steps, and steps a second.

The task is contrib's own, 80 actions of which 60 are forbidden, with gamma=0.4 as in contrib's documentation.
MaskablePPO has its defaults, with rollouts of 2048 steps; so has REINFORCE, but its critic makes ten passes as PPO's
does, at a rate chosen on seeds 10 and 11. The two take turns for each seed. A row of the CSV is an evaluation of the
deterministic policy over 20 episodes (the best return is 100); the seconds of training, and of the CPU, are without
evaluations.

    python examples/benchmarks/masks.py --output examples/benchmarks/results/masks.csv
"""

import argparse
import csv
import statistics
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from sb3_contrib import MaskablePPO
from sb3_contrib.common.envs import InvalidActionEnvDiscrete
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_with_masks
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce import REINFORCE, ActionMaskObservation, MaskedPolicy

N_ENVS = 8
COMMON = {"gamma": 0.4, "device": "cpu"}
CRITIC = {"n_critic_updates": 10, "critic_learning_rate": 5e-3}
COLUMNS = ["algorithm", "seed", "timesteps", "return", "seconds", "cpu_seconds"]


def task() -> InvalidActionEnvDiscrete:
    return InvalidActionEnvDiscrete(80, n_invalid_actions=60)


def make(name: str, seed: int) -> tuple[BaseAlgorithm, VecEnv]:
    """A model on environments that draw the same states for the same seed, and an environment to evaluate it in."""
    # The environment draws its masks from NumPy's global generator
    np.random.seed(seed)
    wrapper = ActionMaskObservation if name == "REINFORCE" else None
    env, eval_env = (make_vec_env(task, N_ENVS, seed=each, wrapper_class=wrapper) for each in (seed, 1000 + seed))
    if name == "REINFORCE":
        return REINFORCE(MaskedPolicy, env, seed=seed, **CRITIC, **COMMON), eval_env
    return MaskablePPO("MlpPolicy", env, n_steps=2048 // N_ENVS, seed=seed, **COMMON), eval_env


def rows(name: str, seed: int, evaluate_at: list[int]) -> Iterator[dict[str, Any]]:
    """The evaluations of one training."""
    model, eval_env = make(name, seed)
    evaluate = evaluate_policy if name == "REINFORCE" else evaluate_with_masks
    seconds = cpu_seconds = 0.0
    for timesteps in evaluate_at:
        start, cpu_start = time.perf_counter(), time.process_time()
        model.learn(timesteps - model.num_timesteps, reset_num_timesteps=model.num_timesteps == 0)
        seconds += time.perf_counter() - start
        cpu_seconds += time.process_time() - cpu_start
        mean, _ = evaluate(model, eval_env, n_eval_episodes=20)
        values = [name, seed, model.num_timesteps, float(mean), round(seconds, 2), round(cpu_seconds, 2)]
        yield dict(zip(COLUMNS, values, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--evaluate-at", type=int, nargs="+", default=[4096, 8192, 16384, 32768])
    parser.add_argument("--output", default="masks.csv")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    ratios = []
    with open(arguments.output, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for seed in arguments.seeds:
            cpu_seconds = {}
            for name in ("REINFORCE", "MaskablePPO"):
                for row in rows(name, seed, arguments.evaluate_at):
                    print(*row.values(), flush=True)
                    writer.writerow(row)
                    cpu_seconds[name] = row["cpu_seconds"]
            ratios.append(cpu_seconds["MaskablePPO"] / cpu_seconds["REINFORCE"])
    rounds = ", ".join(f"{ratio:.1f}" for ratio in ratios)
    print(f"steps per second of the CPU: {statistics.median(ratios):.1f} times MaskablePPO (seeds: {rounds})")


if __name__ == "__main__":
    main()
