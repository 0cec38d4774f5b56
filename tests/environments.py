"""Small tasks whose returns, lengths and gradients are known."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Tree(gym.Env[np.ndarray, np.int64]):
    """
    Two actions, two steps, observations one-hot: node 0, then node 1 or 2 by the first action.

    :param ragged: Whether the first action 1 ends the episode at once
    """

    rewards = np.array([[3.0, -1.0], [5.0, -2.0], [1.0, 4.0]])

    def __init__(self, ragged: bool = False):
        self.observation_space = spaces.Box(0, 1, (3,))
        self.action_space = spaces.Discrete(2)
        self.ragged = ragged
        self.node = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.node = 0
        return self.observe(0), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward, terminated = self.rewards[self.node, action], self.node > 0 or (self.ragged and action == 1)
        self.node = 1 + int(action)
        return self.observe(self.node), float(reward), bool(terminated), False, {}

    @staticmethod
    def observe(node: int) -> np.ndarray:
        return np.eye(3, dtype=np.float32)[node]

    def trajectories(self) -> list[list[tuple[int, int, float]]]:
        """Every possible episode, as a list of (node, action, reward)."""
        found = []
        for first in (0, 1):
            begin = [(0, first, self.rewards[0, first])]
            if self.ragged and first == 1:
                found.append(begin)
            else:
                found += [[*begin, (1 + first, second, self.rewards[1 + first, second])] for second in (0, 1)]
        return found


class Corridor(gym.Env[np.ndarray, Any]):
    """
    Episodes of drawn lengths, whatever the action; the observation is the one-hot timestep.

    :param lengths: The lengths to draw from
    :param reward: The reward of (timestep, action)
    :param action_space: Any action space
    :param truncate: Whether an episode ends by truncation instead of termination
    """

    def __init__(
        self,
        lengths: tuple[int, ...] = (3,),
        reward: Callable[[int, Any], float] = lambda t, action: 1.0,
        action_space: spaces.Space[Any] | None = None,
        truncate: bool = False,
    ):
        self.observation_space = spaces.Box(0, 1, (max(lengths),))
        self.action_space = action_space or spaces.Discrete(2)
        self.lengths, self.reward, self.truncate = lengths, reward, truncate
        self.t = self.length = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.t, self.length = 0, int(self.np_random.choice(self.lengths))
        return self.observe(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward = self.reward(self.t, action)
        self.t += 1
        done = self.t == self.length
        return self.observe(), reward, done and not self.truncate, done and self.truncate, {}

    def observe(self) -> np.ndarray:
        return np.eye(max(self.lengths) + 1, dtype=np.float32)[self.t, :-1]
