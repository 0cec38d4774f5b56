"""
How much of a gradient's variance is the luck of the start?

    python examples/benchmarks/common_random_numbers.py --env Pendulum-v1

Estimates the gradient at one θ many times, with and without common random numbers. Prints, as CSV, the ratio of the
variances (traces of the covariances) at the same number of episodes, and the ratio of the steps they took.
"""

import argparse
import csv
import sys

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import FiniteDifference


class Gradients(BaseCallback):
    """Collects ĝ of every update."""

    def __init__(self, n_wanted: int) -> None:
        super().__init__()
        self.n_wanted = n_wanted
        self.gradients: list[th.Tensor] = []

    def _on_rollout_end(self) -> None:
        self.gradients.append(self.locals["gradient"])

    def _on_step(self) -> bool:
        return len(self.gradients) < self.n_wanted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Pendulum-v1")
    parser.add_argument("--policy", default="LinearPolicy")
    parser.add_argument("--n-delta", type=int, default=16)
    parser.add_argument("--n-gradients", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(["env", "policy", "n_gradients", "n_delta", "estimator", "variance_ratio", "steps_ratio"])
    for estimator in ("central", "forward", "regression"):
        variances, steps = {}, {}
        for common in (True, False):
            model = FiniteDifference(
                arguments.policy, make_vec_env(arguments.env, 8, seed=arguments.seed), learning_rate=0.0,
                estimator=estimator, n_delta=arguments.n_delta, common_random_numbers=common, seed=arguments.seed,
                device="cpu",
            )  # fmt: skip
            callback = Gradients(arguments.n_gradients)
            model.learn(10**9, callback, log_interval=None)
            variances[common] = float(th.stack(callback.gradients).var(0).sum())
            steps[common] = model.num_timesteps
        measured = [arguments.env, arguments.policy, arguments.n_gradients, arguments.n_delta, estimator]
        ratios = [variances[False] / variances[True], steps[True] / steps[False]]
        writer.writerow([*measured, *(f"{ratio:.2f}" for ratio in ratios)])


if __name__ == "__main__":
    main()
