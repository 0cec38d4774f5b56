"""Small tasks whose returns, lengths and gradients are known."""

import os
import signal
import time
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


class Faulty(Corridor):
    """
    Episodes of seven steps; does something wrong at one step of its life, or at one reset.

    :param fault: What: "reward", "observation" or "first observation" is ``value``; "raise" or "die", "in step" or "in
        reset"; or the name of a signal that the learner gets in the middle of a step
    :param at: When, counted from 1
    :param value: What is returned then, or raised
    :param truncate: Whether episodes end by truncation
    :param observation_space: Its space, if it is another
    """

    def __init__(
        self,
        fault: str = "",
        at: int = 0,
        value: Any = None,
        truncate: bool = False,
        observation_space: spaces.Space[Any] | None = None,
    ):
        super().__init__((7,), truncate=truncate)
        self.observation_space = observation_space or self.observation_space
        self.fault, self.at, self.value, self.n_steps, self.n_resets = fault, at, value, 0, 0

    def observe(self) -> np.ndarray:
        if self.observation_space.shape == (7,):
            return super().observe()
        return np.zeros(self.observation_space.shape, self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        obs, info = super().reset(seed=seed, options=options)
        self.n_resets += 1
        if self.n_resets == self.at:
            self.go_wrong("reset")
            obs = self.value if self.fault == "first observation" else obs
        return obs, info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        obs, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        if self.n_steps == self.at:
            self.go_wrong("step")
            reward = self.value if self.fault == "reward" else reward
            obs = self.value if self.fault == "observation" else obs
        return obs, reward, terminated, truncated, info

    def go_wrong(self, when: str) -> None:
        if self.fault == f"raise in {when}":
            raise self.value or OSError("the simulator has gone")
        if self.fault == f"die in {when}":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault in signal.Signals.__members__ and when == "step":
            os.kill(os.getppid(), signal.Signals[self.fault])
            # The answer comes when the learner has long stopped waiting for it
            time.sleep(0.2)
