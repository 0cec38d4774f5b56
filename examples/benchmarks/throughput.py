"""
How many environment steps a second does each algorithm learn from?

REINFORCE beside SB3's A2C and PPO on the same VecEnv, one thread each, and ``raw``: the VecEnv stepped with prepared
actions and no learner, the ceiling. The contenders take turns in each round; only ratios of one round are compared,
and their medians printed. With rollouts of 2048 steps REINFORCE and A2C make one pass of the critic over each rollout.

    python examples/benchmarks/throughput.py --env CartPole-v1 --n-envs 1 8 64

Where the time of a vector step of 8 CartPole-v1 environments goes, in rollouts of 2048 steps (microseconds on one core
of a shared machine; the shares are what counts): environment 66, actor and sampling 12, bookkeeping, callback and
storage 14, checks and returns 3, critic's values 3, policy step 12, critic's pass 9. Found with ``cProfile`` and
``torch.profiler``; half of the learner's share is tanh and matrix products.
"""

import argparse
import csv
import statistics
import sys
import time
import warnings

import numpy as np
import torch as th
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE

ONE_PASS = {"n_critic_updates": 1, "batch_size": 2048}
COLUMNS = ["env", "n_envs", "REINFORCE / raw", "REINFORCE / A2C", "REINFORCE / PPO", "defaults: REINFORCE / A2C"]


def raw(env_id: str, n_envs: int, timesteps: int) -> float:
    """Steps a second of the VecEnv alone."""
    env = make_vec_env(env_id, n_envs, seed=0)
    actions = [np.stack([env.action_space.sample() for _ in range(n_envs)]) for _ in range(64)]
    env.reset()
    start = time.perf_counter()
    for step in range(timesteps // n_envs):
        env.step(actions[step % 64])
    return timesteps / (time.perf_counter() - start)


def learning(algorithm: type, env_id: str, n_envs: int, timesteps: int, **kwargs: object) -> float:
    """Steps a second of ``learn()``, after a first rollout that is not counted."""
    model = algorithm("MlpPolicy", make_vec_env(env_id, n_envs, seed=0), seed=0, device="cpu", **kwargs).learn(1)
    before, start = model.num_timesteps, time.perf_counter()
    model.learn(timesteps, reset_num_timesteps=False)
    return (model.num_timesteps - before) / (time.perf_counter() - start)


def row(env_id: str, n_envs: int, timesteps: int, rounds: int) -> dict[str, object]:
    """Medians over the rounds of the ratios of one task."""
    n_steps, common = max(16, 2048 // n_envs), (env_id, n_envs, timesteps)
    ratios = []
    for _ in range(rounds):
        ours = learning(REINFORCE, *common, n_steps=n_steps, **ONE_PASS)
        ratios.append([
            ours / raw(*common),
            ours / learning(A2C, *common, n_steps=n_steps),
            ours / learning(PPO, *common, n_steps=n_steps),
            learning(REINFORCE, *common) / learning(A2C, *common),
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
    writer = csv.DictWriter(sys.stdout, COLUMNS)
    writer.writeheader()
    for env_id in arguments.env:
        for n_envs in arguments.n_envs:
            writer.writerow(row(env_id, n_envs, arguments.timesteps, arguments.rounds))
            sys.stdout.flush()


if __name__ == "__main__":
    main()
