"""
Can the plain policy gradient balance a pole?

One gradient step per rollout, no clipping of ratios, no replay: REINFORCE with a critic as its baseline. Training stops
once 20 episodes in a row of the best actions score 490 on average; then 100 more are scored.

    python examples/1_reinforce.py --seed 0
"""

import argparse

import torch as th
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import REINFORCE

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=150_000)
arguments = parser.parse_args()
th.set_num_threads(1)

env = make_vec_env("CartPole-v1", n_envs=8, seed=arguments.seed)
model = REINFORCE("MlpPolicy", env, gae_lambda=0.95, seed=arguments.seed, device="cpu")

until_solved = EvalCallback(
    make_vec_env("CartPole-v1", n_envs=5, seed=1000 + arguments.seed),
    callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=490),
    n_eval_episodes=20,
    eval_freq=500,
    verbose=0,
)
model.learn(arguments.timesteps, callback=until_solved, progress_bar=True)

mean, std = evaluate_policy(
    model, make_vec_env("CartPole-v1", n_envs=5, seed=2000 + arguments.seed), n_eval_episodes=100
)
print(f"Mean return of 100 episodes after {model.num_timesteps} steps: {mean:.1f} +- {std:.1f}")
