# %% [markdown]
# # What can go wrong, and how do you notice?
#
# `PitfallCallback` watches a run, changes nothing, and warns once about each known pitfall. In a healthy run it is
# silent. Here is a run for each pitfall.

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
# Two traps are CartPole with a wrong learning rate. The others are tasks of a few steps, in which a function gives the
# reward.


# %%
class Task(gym.Env):
    """Episodes of random length; the observation is the one-hot time step."""

    action_space = spaces.Discrete(2)

    def __init__(self, lengths, reward=lambda env, action: 1.0):
        self.lengths, self.reward = lengths, reward
        self.observation_space = spaces.Box(0, 1, (max(lengths) + 1,))
        self.n_steps = 0

    def observe(self):
        return np.eye(max(self.lengths) + 1, dtype=np.float32)[self.t]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.length = 0, int(self.np_random.choice(self.lengths))
        return self.observe(), {}

    def step(self, action):
        self.n_steps += 1
        reward = self.reward(self, action)
        self.t += 1
        return self.observe(), reward, self.t == self.length, False, {}


def huge(env, action):
    return 5e3


def noisy(env, action):
    """Little signal: the better action earns 0.1 more, and the later steps 1 more."""
    return 0.1 * action + float(env.t > 1) + env.np_random.normal()


def jackpot(env, action):
    """Pays a thousandfold once, after 40 episodes of three steps."""
    return 1000.0 if env.n_steps == 40 * 3 else 1.0


def run(env, timesteps, prepare=None, **arguments):
    """Train, and return what the callback found, by name; ``prepare`` changes the policy first."""
    model = REINFORCE("MlpPolicy", make_vec_env(env, seed=seed), seed=seed, device="cpu", **arguments)
    if prepare is not None:
        with th.no_grad():
            prepare(model.policy)
    callback = PitfallCallback()
    with warnings.catch_warnings():
        # They are printed below instead
        warnings.simplefilter("ignore")
        model.learn(timesteps, callback)
    return callback.found


def wild_critic(policy):
    policy.value_net.weight.mul_(20)


def strong_preference(policy):
    policy.action_net.bias.copy_(th.tensor([9.0, 0.0]))


# %%
one_episode = {"baseline": "none", "n_episodes": 1}
total_return = {"baseline": "none", "n_episodes": 4, "reward_to_go": False}
runs = {
    "rate_too_large": ("CartPole-v1", 2000, {"learning_rate": 1.0}),
    # PPO's defaults
    "rate_too_small": ("CartPole-v1", 40_960, {"learning_rate": 3e-4, "n_steps": 2048, "gae_lambda": 0.95}),
    "unscaled_returns": (lambda: Task((5,), huge), 64, {}),
    "too_few_episodes": (lambda: Task((4,), noisy), 400, one_episode),
    "total_return": (lambda: Task((4,)), 64, total_return),
    "spikes_without_clipping": (lambda: Task((3,), jackpot), 300, {**one_episode, "max_grad_norm": None}),
    # Its critic starts with wild values and does not learn
    "useless_critic": (lambda: Task((4,), noisy), 4000, {"critic_learning_rate": 0.0, "prepare": wild_critic}),
    "deterministic_too_early": (lambda: Task((4,)), 640, {"prepare": strong_preference}),
    "cut_episodes": (lambda: Task((3, 7)), 200, {"baseline": "mean", "n_steps": 10}),
}
for name, (env, timesteps, arguments) in runs.items():
    found = run(env, timesteps, **arguments)
    assert name in found, found
    print(f"{name}:\n    {found[name]}")

# %% [markdown]
# Each sentence names the argument to change. The healthy run: CartPole with the default learning rate and rollouts of
# 256 steps.

# %%
found = run("CartPole-v1", 5000, n_steps=256)
print("found in a healthy run:", found)
assert found == {}
