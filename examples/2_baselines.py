"""
How much noise does each baseline leave in the gradient?

A baseline is there to lower the variance of the estimate and to leave its mean alone. Here each one weighs the very
same episodes, and the trace of the covariance of the episodes' gradients is printed.

    python examples/2_baselines.py
"""

import argparse

import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import sample
from sb3_reinforce.estimation import BASELINES, gradients_by_episode

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=20_000)
parser.add_argument("--episodes", type=int, default=100)
arguments = parser.parse_args()
th.set_num_threads(1)

env = make_vec_env("CartPole-v1", n_envs=8, seed=arguments.seed)
model = REINFORCE("MlpPolicy", env, gae_lambda=0.95, seed=arguments.seed, device="cpu").learn(arguments.timesteps)

rollout = sample(model, arguments.episodes)
traces = {}
for name, baseline in BASELINES.items():
    weights = rollout.discounts * (rollout.returns - baseline(rollout))
    (gradients,) = gradients_by_episode(rollout, weights)
    traces[name] = gradients.var(dim=0).sum().item()

print(f"{'baseline':16s} {'trace of the covariance':>24s} {'of none':>8s}")
for name, trace in traces.items():
    print(f"{name:16s} {trace:24.1f} {trace / traces['none']:8.3f}")
