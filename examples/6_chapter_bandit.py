"""
How much do the mean and the optimal baseline lower the variance on a bandit?

Two actions with rewards N(3, 4) and N(5, 4): the variance of the gradient between 50 batches of 20 rollouts, for a
uniform policy and for one that prefers the better action. "by formula" is the variance with the baseline known; here it
is estimated from the batch. Batches of 20 do not separate mean and optimal, so their ratio is also taken for single
rollouts, on the same 2000 for both: 1 for the uniform policy, whose scores all have one length, and below 1 else.

    python examples/6_chapter_bandit.py --output bandit.png
"""

import argparse

import gymnasium as gym
import numpy as np
import torch as th

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import compare_baselines, gradient_statistics, gradients_by_episode, sample
from sb3_reinforce.estimation import BASELINES

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=1_000, help="rollouts in batches, 20 a batch")
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
names, results = {"total return": "none", "mean": "mean", "optimal": "optimal"}, []
for p in (0.5, 0.8):
    model.policy.action_net.bias.data = th.tensor([1 - p, p]).log()
    batches = []
    for _ in range(max(2, arguments.timesteps // 20)):
        rollout = sample(model, 20)
        weights = [rollout.returns - BASELINES[name](rollout) for name in names.values()]
        batches.append(gradients_by_episode(rollout, *weights).mean(1))
    variances = [gradient_statistics(gradients).variance for gradients in th.stack(batches, dim=1)]
    pq = p * (1 - p)
    exact = [(4 * pq * (13 * p + 29 * (1 - p)) - 16 * pq**2) / 20, 16 * pq * (2 - 4 * pq) / 20, 16 * pq / 20]
    results.append((f"better action drawn with probability {p}", variances, exact))
    print(results[-1][0])
    for name, variance, truth in zip(names, variances, exact, strict=True):
        print(f"  {name:14s} variance of a batch's gradient {variance}, by formula {truth:.3f}")
    ratios = compare_baselines(model, 2000, ("mean", "optimal"), reference="mean", seed=arguments.seed)
    print(f"  ratios of single rollouts: total return / mean {ratios['none'].ratio}")
    print(f"                             optimal / mean      {ratios['optimal'].ratio}")

if arguments.output:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.6), sharey=True, layout="constrained")
    for ax, (title, variances, exact) in zip(axes, results, strict=True):
        values, low, high = (np.array([getattr(v, key) for v in variances]) for key in ("value", "low", "high"))
        ax.bar(list(names), values, color="#0072B2", alpha=0.5)
        ax.vlines(range(3), low, high, color="black", label="95 % interval")
        ax.plot(exact, linestyle="", marker="D", color="#D55E00", label="by formula")
        ax.set_title(title, fontsize="medium")
    axes[0].set_ylabel("variance of a batch's gradient")
    axes[1].legend()
    figure.savefig(arguments.output, dpi=150)
