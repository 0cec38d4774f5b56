"""
How many gradients a second does FiniteDifference estimate, beside SB3-Contrib's ARS?

Both evaluate the same number of candidates, an episode each, with one thread. FiniteDifference has several environments
and ARS one: it plays the episodes of a candidate alone, and with more environments would throw most of their steps
away. All episodes of a task should have one length, or the two would not do the same work; the learning rate is 0. The
two take turns in each round; the median, least and greatest ratio of the rounds are printed, as CSV.

    python examples/benchmarks/search_throughput.py --env Pendulum-v1 --policy LinearPolicy
"""

import argparse
import csv
import statistics
import sys
import time
import warnings

import torch as th
from sb3_contrib import ARS
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import FiniteDifference


def gradients_per_second(algorithm: type, n_envs: int, arguments: argparse.Namespace, **kwargs: object) -> float:
    """The pace of as many updates as are asked for, after a first one that is not counted."""
    env = make_vec_env(arguments.env, n_envs, seed=0)
    kwargs = {"n_delta": arguments.n_delta, "learning_rate": 0.0, "seed": 0, "device": "cpu", **kwargs}
    model = algorithm(arguments.policy, env, **kwargs).learn(1)
    start = time.perf_counter()
    for _ in range(arguments.updates):
        model.learn(1, reset_num_timesteps=False)
    return arguments.updates / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Pendulum-v1")
    parser.add_argument("--policy", default="LinearPolicy", help="LinearPolicy or MlpPolicy")
    parser.add_argument("--n-envs", type=int, default=8, help="environments of FiniteDifference")
    parser.add_argument("--n-delta", type=int, default=16, help="pairs of candidates per gradient")
    parser.add_argument("--updates", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    ratios = []
    for _ in range(arguments.rounds):
        ours = gradients_per_second(FiniteDifference, arguments.n_envs, arguments, estimator="central")
        ratios.append(ours / gradients_per_second(ARS, 1, arguments, zero_policy=False))
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(["env", "policy", "rounds", "median", "least", "greatest"])
    figures = (statistics.median(ratios), min(ratios), max(ratios))
    writer.writerow([arguments.env, arguments.policy, arguments.rounds, *(f"{figure:.1f}" for figure in figures)])


if __name__ == "__main__":
    main()
