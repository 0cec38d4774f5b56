"""
Masks in the observation beside sb3-contrib's MaskablePPO: returns at equal steps, and steps a second.

The task is contrib's own, 80 actions of which 60 are forbidden, with gamma=0.4 as in contrib's documentation.
MaskablePPO has its defaults, with rollouts of 2048 steps. REINFORCE has rollouts of 128 steps, and its critic makes ten
passes as PPO's does; its settings were chosen on seeds 100 to 105, but for the falling rate, which was added when the
last evaluations of seeds 0 to 9 were known. The two take turns for each seed. A row of the CSV is an evaluation of the
deterministic policy over 20 episodes (the best return is 100); the seconds of training, and of the CPU, are without
evaluations.

    python examples/benchmarks/masks.py --output examples/benchmarks/results/masks.csv
"""

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th
from sb3_contrib import MaskablePPO
from sb3_contrib.common.envs import InvalidActionEnvDiscrete
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_with_masks
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce import REINFORCE, ActionMaskObservation, MaskedPolicy

N_ENVS = 8
COMMON = {"gamma": 0.4, "device": "cpu"}
SETTINGS = {
    "n_steps": 16,
    # Falls to 0 in the second half
    "learning_rate": lambda progress_remaining: 8e-4 * min(1.0, 2 * progress_remaining),
    # No action has an effect on later states
    "gae_lambda": 0.0,
    "n_critic_updates": 10,
    "critic_learning_rate": 5e-3,
}
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
        return REINFORCE(MaskedPolicy, env, seed=seed, **SETTINGS, **COMMON), eval_env
    return MaskablePPO("MlpPolicy", env, n_steps=2048 // N_ENVS, seed=seed, **COMMON), eval_env


class Evaluations(BaseCallback):
    """Evaluates the policy at given numbers of steps; the clocks of training stand still meanwhile."""

    def __init__(self, evaluate: Callable[..., Any], eval_env: VecEnv, steps: list[int]):
        super().__init__()
        self.evaluate = evaluate
        self.eval_env = eval_env
        self.steps = steps
        self.rows: list[list[Any]] = []
        self.starts = (0.0, 0.0)

    def _on_training_start(self) -> None:
        self.starts = (time.perf_counter(), time.process_time())

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if len(self.rows) < len(self.steps) and self.num_timesteps >= self.steps[len(self.rows)]:
            self.add_row()

    def _on_training_end(self) -> None:
        self.add_row()

    def add_row(self) -> None:
        """Steps, return, seconds and seconds of the CPU."""
        clocks = (time.perf_counter(), time.process_time())
        mean, _ = self.evaluate(self.model, self.eval_env, n_eval_episodes=20)
        seconds, cpu_seconds = (clock - start for clock, start in zip(clocks, self.starts, strict=True))
        self.rows.append([self.num_timesteps, float(mean), round(seconds, 2), round(cpu_seconds, 2)])
        self.starts = (time.perf_counter() - seconds, time.process_time() - cpu_seconds)


def rows(name: str, seed: int, steps: list[int]) -> Iterator[dict[str, Any]]:
    """The evaluations of one training."""
    model, eval_env = make(name, seed)
    evaluations = Evaluations(evaluate_policy if name == "REINFORCE" else evaluate_with_masks, eval_env, steps)
    model.learn(steps[-1], callback=evaluations)
    for values in evaluations.rows:
        yield dict(zip(COLUMNS, [name, seed, *values], strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[*range(10)])
    parser.add_argument("--evaluate-at", type=int, nargs="+", default=[4096, 8192, 16384, 32768])
    parser.add_argument("--output", default="masks.csv")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    with open(arguments.output, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for seed in arguments.seeds:
            for name in ("REINFORCE", "MaskablePPO"):
                for row in rows(name, seed, arguments.evaluate_at):
                    print(*row.values(), flush=True)
                    writer.writerow(row)


if __name__ == "__main__":
    main()
