# %% [markdown]
# # When should episodes share their start?
#
# A courier accepts five orders, one after the other. Each time four depots have the goods at different distances. Half
# of the days are spent in a small town, half in a region that is ten times as wide. The return is minus the distance
# driven: it says more about the day than about the choices.
#
# "Leave one out" compares the return of an episode with the other episodes of the rollout. Most of them had another
# kind of day. With `episodes_per_start=8` it compares eight episodes of the same day
# (Kool et al., 2019, "Buy 4 REINFORCE samples, get a baseline for free!").

# %%
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import compare_starts

th.set_num_threads(1)


class Courier(gym.Env[np.ndarray, np.int64]):
    """Five orders; the observation is the distance to four depots, in units of the width of the map."""

    observation_space = spaces.Box(0, 1, (4,), np.float32)
    action_space = spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.width = self.np_random.choice([1.0, 10.0])
        self.distances = self.np_random.uniform(size=(6, 4)).astype(np.float32)
        self.order = 0
        return self.distances[0], {}

    def step(self, action):
        reward = -self.width * float(self.distances[self.order, action])
        self.order += 1
        return self.distances[self.order], reward, self.order == 5, False, {}


def make_model(episodes_per_start: int, seed: int) -> REINFORCE:
    env = make_vec_env(Courier, 32, seed=seed)
    return REINFORCE(
        "MlpPolicy", env, baseline="leave_one_out", n_episodes=32, episodes_per_start=episodes_per_start, seed=seed,
        device="cpu",
    )  # fmt: skip


# %% [markdown]
# ## Ask before you train
# `compare_starts` plays eight episodes from each of some starts. It reports how much of the variance of the return
# lies between starts, and by what groups would divide the variance of the gradient. Below 1 they make it *noisier*.

# %%
report = compare_starts(make_model(1, seed=0))
print(report)
assert report.share.low > 0.5
assert report.gains[8].low > 1

# %% [markdown]
# ## Both at the same number of episodes
# The best choice costs 5.5 on average, a random one 13.75. Both policies are evaluated on the same days, which happen
# to be cheaper than the average.


# %%
generator = np.random.default_rng(0)
costs = generator.choice([1.0, 10.0], (100_000, 1, 1)) * generator.uniform(size=(100_000, 5, 4))
assert np.allclose(costs.sum(1).mean(), 13.75, rtol=0.02)
assert np.allclose(costs.min(2).sum(1).mean(), 5.5, rtol=0.02)


def cost_by_episodes(model: REINFORCE, n_evaluations: int = 4) -> list[float]:
    """The mean cost of 320 days after every 2,048 episodes of training."""
    costs = []
    for _ in range(n_evaluations):
        model.learn(2048 * 5, reset_num_timesteps=False)
        days = make_vec_env(Courier, 32, seed=1000)
        mean, _ = evaluate_policy(model, days, n_eval_episodes=320, warn=False)
        costs.append(-mean)
    return costs


alone = cost_by_episodes(make_model(1, seed=0))
grouped = cost_by_episodes(make_model(8, seed=0))
print("episodes  independent starts  groups of eight")
for i in range(4):
    print(f"{2048 * (i + 1):8}  {alone[i]:18.2f}  {grouped[i]:15.2f}")
assert grouped[1] < alone[3], "half of the episodes should do"
