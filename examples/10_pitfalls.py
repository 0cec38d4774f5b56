# %% [markdown]
# # What can go wrong, and how do you notice?
#
# `PitfallCallback` watches a training, changes nothing, and warns once about each of eight known pitfalls. In a
# healthy run it is silent. Here are eight runs that each fall into one.

# %%
import warnings

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import PitfallCallback

seed = 0
th.set_num_threads(1)

# %% [markdown]
# The traps are tasks of a few steps, in which a function of the step and the action gives the reward.


# %%
class Task(gym.Env):
    """Episodes of drawn lengths; the observation is the one-hot time step."""

    action_space = spaces.Discrete(2)

    def __init__(self, lengths, reward=lambda t, action: 1.0):
        self.lengths, self.reward = lengths, reward
        self.observation_space = spaces.Box(0, 1, (max(lengths) + 1,))

    def observe(self):
        return np.eye(max(self.lengths) + 1, dtype=np.float32)[self.t]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.length = 0, int(self.np_random.choice(self.lengths))
        return self.observe(), {}

    def step(self, action):
        reward = self.reward(self.t, action)
        self.t += 1
        return self.observe(), reward, self.t == self.length, False, {}


def noise(t, action):
    return float(np.random.normal())


class Jackpot(Task):
    """Pays a thousandfold, once, after 40 episodes."""

    def __init__(self):
        super().__init__((3,), self.pay)
        self.n_paid = 0

    def pay(self, t, action):
        self.n_paid += 1
        return 1000.0 if self.n_paid == 120 else 1.0


def run(env, timesteps=2000, change=None, **arguments):
    """Train, and return what the callback found, by name."""
    model = REINFORCE("MlpPolicy", make_vec_env(env, seed=seed), seed=seed, device="cpu", **arguments)
    if change is not None:
        with th.no_grad():
            change(model.policy)
    callback = PitfallCallback()
    with warnings.catch_warnings():
        # They are printed below instead
        warnings.simplefilter("ignore")
        model.learn(timesteps, callback)
    return callback.found


# %%
one_episode = {"baseline": "none", "n_episodes": 1}
runs = {
    "rate_too_large": ("CartPole-v1", 2000, {"learning_rate": 1.0}),
    "unscaled_returns": (lambda: Task((5,), lambda t, action: 5e3), 64, {}),
    "too_few_episodes": (lambda: Task((4,), noise), 400, one_episode),
    "total_return": (lambda: Task((4,)), 64, {"baseline": "none", "n_episodes": 4, "reward_to_go": False}),
    "spikes_without_clipping": (Jackpot, 300, {**one_episode, "max_grad_norm": None}),
    # A critic that starts with wild values and does not learn
    "useless_critic": (
        lambda: Task((4,), noise),
        8000,
        {"critic_learning_rate": 0.0, "change": lambda policy: policy.value_net.weight.mul_(20)},
    ),
    # A policy that starts with a strong preference
    "deterministic_too_early": (
        lambda: Task((4,)),
        640,
        {"change": lambda policy: policy.action_net.bias.copy_(th.tensor([9.0, 0.0]))},
    ),
    "cut_episodes": (lambda: Task((3, 7)), 100, {"baseline": "mean", "n_steps": 10}),
}
for name, (env, timesteps, arguments) in runs.items():
    found = run(env, timesteps, **arguments)
    print(f"{name}:\n    {found.get(name)}")
    assert name in found

# %% [markdown]
# Each sentence names the argument to change. The healthy run: CartPole with the default learning rate and rollouts of
# 256 steps.

# %%
found = run("CartPole-v1", 5000, n_steps=256)
print("found in a healthy run:", found)
assert found == {}
