"""
Which estimator sees the gradient from the fewest steps, and with which baseline?

At one θ, with the same sampling policy and γ = 1: the likelihood ratio of REINFORCE, and the forward, central and
regression gradients of finite differences. Then every baseline on the same episodes. First the gradient itself is
checked, line by line.

    python examples/4_compare_gradients.py
"""

import argparse

import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import check_gradient, compare_baselines, compare_estimators

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=5_000)
arguments = parser.parse_args()
th.set_num_threads(1)

env = make_vec_env("CartPole-v1", n_envs=8, seed=arguments.seed)
model = REINFORCE(
    "MlpPolicy", env, seed=arguments.seed, device="cpu", policy_kwargs={"net_arch": {"pi": [], "vf": [64]}}
)
model.learn(arguments.timesteps)

print(check_gradient(model), end="\n\n")
print(compare_estimators(model, seed=arguments.seed), end="\n\n")
print(compare_baselines(model, n_episodes=100, seed=arguments.seed))
