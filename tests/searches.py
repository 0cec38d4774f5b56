"""Searches with few perturbations, and tasks whose utilities are known."""

import gymnasium as gym
import numpy as np
from callbacks import Record
from gymnasium import spaces

from sb3_reinforce import FiniteDifference

SMALL = dict(n_delta=3, estimator="central", seed=0, device="cpu")


def make(env="CartPole-v1", policy="LinearPolicy", **kwargs):
    return FiniteDifference(policy, env, **{**SMALL, **kwargs})


class Line(gym.Env):
    """One step an episode: the reward is −(a − 3 s)², with s drawn at reset."""

    observation_space, action_space = spaces.Box(-1, 1, (1,)), spaces.Box(-9, 9, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.state, {}

    def step(self, action):
        return self.state, -float((action[0] - 3 * self.state[0]) ** 2), True, False, {}


class Levels(Line):
    """The start decides most of the reward, 50 l + a, and the observation is 1."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.level = self.np_random.normal()
        return np.ones(1, np.float32), {}

    def step(self, action):
        return np.ones(1, np.float32), 50 * self.level + float(action[0]), True, False, {}


def estimates_of(model, n_updates):
    """Of as many updates, after one of its training."""
    callback = Record(lambda model: None)
    model.learn(1, callback)
    return [model.estimate_gradient(callback) for _ in range(n_updates)]


def estimates(n_updates, env=None, **kwargs):
    """Of as many updates at one θ."""
    return estimates_of(make(env or Line(), learning_rate=0.0, delta_std=0.1, **kwargs), n_updates)
