"""
How much do the mean and the optimal baseline lower the variance on a bandit?

Two actions with rewards N(3, 4) and N(5, 4), a uniform policy, and 50 batches of 20 rollouts: the variance of the
batch's gradient between the batches, for the total return, the mean baseline and the optimal one.

    python examples/6_chapter_bandit.py --output bandit.png
"""

import argparse

import gymnasium as gym
import numpy as np
import torch as th

from sb3_reinforce import REINFORCE
from sb3_reinforce.baselines import BASELINES
from sb3_reinforce.diagnostics import gradient_statistics, gradients_by_episode, sample

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=1_000, help="rollouts in all, 20 a batch")
parser.add_argument("--output", help="where to save the picture")
arguments = parser.parse_args()
th.set_num_threads(1)


class Bandit(gym.Env):
    observation_space, action_space = gym.spaces.Box(1, 1, (1,)), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, dtype=np.float32), {}

    def step(self, action):
        return np.ones(1, dtype=np.float32), self.np_random.normal([3.0, 5.0][action], 2.0), True, False, {}


model = REINFORCE(
    "MlpPolicy", Bandit(), baseline="none", seed=arguments.seed, policy_kwargs={"net_arch": []}, device="cpu"
)
th.nn.init.zeros_(model.policy.action_net.weight)
names, batches = {"total return": "none", "mean": "mean", "optimal": "optimal"}, []
for _ in range(max(2, arguments.timesteps // 20)):
    rollout = sample(model, 20)
    weights = [rollout.returns - BASELINES[name](rollout) for name in names.values()]
    batches.append(gradients_by_episode(rollout, *weights).mean(1))

variances = [gradient_statistics(gradients).variance for gradients in th.stack(batches, dim=1)]
for name, variance in zip(names, variances, strict=True):
    print(f"{name:14s} variance of a batch's gradient {variance}")
if arguments.output:
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(layout="constrained")
    values, low, high = (np.array([getattr(v, key) for v in variances]) for key in ("value", "low", "high"))
    ax.bar(list(names), values, yerr=[values - low, high - values], capsize=4)
    ax.set(ylabel="variance of a batch's gradient", title=f"{len(batches)} batches of 20 rollouts")
    figure.savefig(arguments.output, dpi=150)
