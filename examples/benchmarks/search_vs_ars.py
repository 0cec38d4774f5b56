"""
Does FiniteDifference end as high as SB3-Contrib's ARS with the RL Zoo's settings, at the same number of real steps?

    python examples/benchmarks/search_vs_ars.py --env Pendulum-v1 --seeds 20 21 22 23 24 --output search.csv

FiniteDifference takes the settings of ``sb3_reinforce.zoo``. Each run adds a line to the CSV, with the mean return of
100 episodes of the policy before the last update, which may end beyond the budget. A VecNormalize has the statistics of
the end of training, one update later.
"""

import argparse
import csv
from pathlib import Path

import torch as th
from compare import Run, make, settings_of
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize, sync_envs_normalization

# As they are called in the results, and in rl_zoo3.ALGOS
NAMES = {"FiniteDifference": "finite_difference", "ARS": "ars"}


class BeforeLastUpdate(BaseCallback):
    """Remembers the policy from which the last update started."""

    def _on_rollout_start(self) -> None:
        self.policy = {name: value.clone() for name, value in self.model.policy.state_dict().items()}
        self.steps = self.num_timesteps

    def _on_step(self) -> bool:
        return True


def mean_return(model: BaseAlgorithm, env_id: str) -> float:
    """The mean return of 100 episodes in an environment with the same seed for all models."""
    env = make_vec_env(env_id, 1, seed=1000)
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        env = VecNormalize(env, training=False, norm_obs=normalization.norm_obs, norm_reward=False)
        sync_envs_normalization(normalization, env)
    return float(evaluate_policy(model, env, 100)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Pendulum-v1")
    parser.add_argument("--algo", nargs="+", default=list(NAMES), choices=list(NAMES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[20, 21, 22, 23, 24])
    parser.add_argument("--timesteps", type=int, help="by default as many as the Zoo gives ARS")
    parser.add_argument("--output", type=Path, required=True, help="the CSV; rows are added to it")
    arguments = parser.parse_args()
    needed = set(arguments.algo)
    if not arguments.timesteps:
        needed.add("ARS")
    for name in needed:
        if settings_of(NAMES[name], arguments.env) is None:
            parser.error(f"--env: {name} has no settings for {arguments.env}")
    th.set_num_threads(1)
    timesteps = arguments.timesteps or int(settings_of("ars", arguments.env)["n_timesteps"])
    for seed in arguments.seeds:
        for name in arguments.algo:
            model, _, _ = make(Run(arguments.env, NAMES[name], seed, timesteps))
            callback = BeforeLastUpdate()
            model.learn(timesteps, callback, log_interval=None)
            after = mean_return(model, arguments.env)
            model.policy.load_state_dict(callback.policy)
            row = [arguments.env, name, seed, timesteps, callback.steps, round(mean_return(model, arguments.env), 1)]
            print(*row, "| after learn():", model.num_timesteps, round(after, 1), flush=True)
            is_new = not arguments.output.exists()
            with arguments.output.open("a", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                if is_new:
                    writer.writerow(["env", "algorithm", "seed", "budget", "steps", "mean_return"])
                writer.writerow(row)


if __name__ == "__main__":
    main()
