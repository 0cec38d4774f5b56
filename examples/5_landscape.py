"""
What does the performance landscape look like around a policy, and where do the estimators point?

U(θ) on a plane through θ, spanned by the likelihood-ratio gradient of 300 episodes and a random direction; drawn on it
are the gradients of 10 episodes for each of three baselines, and a finite-difference regression on 20.

    python examples/5_landscape.py --output landscape.png
"""

import argparse

import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import CandidateUtility, gradients_by_episode, landscape, sample
from sb3_reinforce.diagnostics.plots import plot_landscape
from sb3_reinforce.estimation import BASELINES, regression_gradient

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=5_000)
parser.add_argument("--points", type=int, default=9)
parser.add_argument("--output", help="where to save the picture; it is not saved without")
arguments = parser.parse_args()
th.set_num_threads(1)

env = make_vec_env("CartPole-v1", n_envs=8, seed=arguments.seed)
kwargs = {"net_arch": {"pi": [], "vf": [64]}}
model = REINFORCE("MlpPolicy", env, gamma=1.0, seed=arguments.seed, device="cpu", policy_kwargs=kwargs)
model.learn(arguments.timesteps)


def gradient(name, n_episodes):
    """The likelihood-ratio gradient of some episodes, with a baseline."""
    rollout = sample(model, n_episodes)
    return gradients_by_episode(rollout, rollout.returns - BASELINES[name](rollout))[0].mean(0).double()


gradients = {f"REINFORCE, {name}": gradient(name, 10) for name in ("none", "time_mean", "value")}
utility = CandidateUtility(model, 1, arguments.seed)
deltas = 0.3 * th.randn(20, len(utility.theta), dtype=th.float64)
gradients["regression"] = regression_gradient(utility, utility.theta, deltas)

plane = th.stack([gradient("value", 300), th.randn(len(utility.theta), dtype=th.float64)])
found = landscape(model, gradients, plane, extent=15.0, n_points=arguments.points, n_episodes=5, seed=arguments.seed)
print(f"U(θ) is {found.utilities.min():.0f} to {found.utilities.max():.0f} on the plane")
for name, (x, y) in found.steps.items():
    print(f"{name:24s} points to ({x:+.2f}, {y:+.2f})")
ax = plot_landscape(found)
if arguments.output:
    ax.figure.savefig(arguments.output, dpi=150)
