"""
How many environment steps a second does each algorithm learn from?

REINFORCE beside SB3's A2C and PPO on the same VecEnv, one thread each, and ``raw``: the VecEnv's own ``step`` with
prepared actions and no learner. The contenders take turns in each round; only ratios of one round are compared,
and their medians printed. With rollouts of 2048 steps REINFORCE and A2C make one pass of the critic over each rollout.

    python examples/benchmarks/throughput.py --env CartPole-v1 --n-envs 1 8 64

Where the time of a vector step of 8 CartPole-v1 environments goes, in rollouts of 2048 steps (microseconds on one core
of a shared machine; the shares are what counts): environments 46 (their VecEnv's own ``step`` takes 54), actor and
sampling 7, bookkeeping and storage 5 (and 4 with a callback), critic's values 3, returns and checks 1, policy step 11,
critic's pass 5. Measured once with a timer around each part (not listed). Of what is learning, more than half is matrix
products.
"""

import argparse
import csv
import statistics
import sys
import warnings

import torch as th
from rates import ONE_PASS, bare, learning
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE

COLUMNS = ["env", "n_envs", "REINFORCE / raw", "REINFORCE / A2C", "REINFORCE / PPO", "defaults: REINFORCE / A2C"]


def row(env_id: str, n_envs: int, timesteps: int, rounds: int) -> dict[str, object]:
    """Medians over the rounds of the ratios of one task."""
    n_steps = max(16, 2048 // n_envs)

    def rate(algorithm: type, **kwargs: object) -> float:
        return learning(algorithm, "MlpPolicy", make_vec_env(env_id, n_envs, seed=0), timesteps, **kwargs)

    ratios = []
    for _ in range(rounds):
        ours = rate(REINFORCE, n_steps=n_steps, **ONE_PASS)
        ratios.append([
            ours / bare(make_vec_env(env_id, n_envs, seed=0), timesteps),
            ours / rate(A2C, n_steps=n_steps),
            ours / rate(PPO, n_steps=n_steps),
            rate(REINFORCE) / rate(A2C),
        ])  # fmt: skip
    medians = [round(statistics.median(column), 2) for column in zip(*ratios, strict=True)]
    return dict(zip(COLUMNS, [env_id, n_envs, *medians], strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["CartPole-v1"])
    parser.add_argument("--n-envs", type=int, nargs="+", default=[1, 8, 64])
    parser.add_argument("--timesteps", type=int, default=40_000)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    writer = csv.DictWriter(sys.stdout, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for env_id in arguments.env:
        for n_envs in arguments.n_envs:
            writer.writerow(row(env_id, n_envs, arguments.timesteps, arguments.rounds))
            sys.stdout.flush()


if __name__ == "__main__":
    main()
