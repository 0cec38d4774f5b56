"""Small tasks whose returns, lengths and gradients are known."""

import os
import signal
import time
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

from sb3_reinforce import GymnasiumVecEnv


class Tree(gym.Env[np.ndarray, np.int64]):
    """Node 0, then node 1 or 2 by the first action; if ``ragged``, a first action 1 ends the episode."""

    rewards = np.array([[3.0, -1.0], [5.0, -2.0], [1.0, 4.0]])
    masks = np.ones((3, 2), dtype=bool)

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
                seconds = np.flatnonzero(self.masks[1 + first]).tolist()
                found += [[*begin, (1 + first, second, self.rewards[1 + first, second])] for second in seconds]
        return found


class Scales(gym.Env[np.ndarray, np.int64]):
    """One step with the reward ``scale · x + (2a − 1) · effect``, where the start draws x = −1 or 1, unobserved."""

    def __init__(self, scale: float = 1.0, effect: float = 1.0, ignores_seed: bool = False):
        self.observation_space = spaces.Box(-1, 1, (1,))
        self.action_space = spaces.Discrete(2)
        self.scale, self.effect, self.ignores_seed = scale, effect, ignores_seed
        self.x = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=None if self.ignores_seed else seed)
        self.x = 2 * int(self.np_random.integers(2)) - 1
        return np.full(1, self.np_random.random() if self.ignores_seed else 1.0, dtype=np.float32), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward = self.scale * self.x + (2 * int(action) - 1) * self.effect
        return np.ones(1, dtype=np.float32), reward, True, False, {}


class Corridor(gym.Env[np.ndarray, Any]):
    """Episodes of drawn lengths, whatever the action; the observation is the one-hot timestep."""

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
        if seed is not None:
            self.observation_space.seed(seed)
        self.t, self.length = 0, int(self.np_random.choice(self.lengths))
        return self.observe(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward = self.reward(self.t, action)
        self.t += 1
        done = self.t == self.length
        return self.observe(), reward, done and not self.truncate, done and self.truncate, {}

    def observe(self) -> np.ndarray:
        return np.eye(max(self.lengths) + 1, dtype=np.float32)[self.t, :-1]


class Random(Corridor):
    """Observations drawn from any space; counts steps and episodes and refuses actions outside their space."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any] | None = None,
        lengths: tuple[int, ...] = (5,),
        truncate: bool = True,
    ):
        super().__init__(lengths, lambda t, action: self.draw_reward(), action_space, truncate)
        # Other environments may have the same space, and each draws its random numbers alone
        self.observation_space = deepcopy(observation_space)
        self.n_steps = self.n_episodes = 0

    def draw_reward(self) -> float:
        return float(self.np_random.normal() * 10.0 ** self.np_random.integers(-3, 4))

    def observe(self) -> Any:
        return self.observation_space.sample()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        assert self.action_space.contains(action), action
        obs, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        self.n_episodes += terminated or truncated
        return obs, reward, terminated, truncated, info


class Faulty(Corridor):
    """
    Episodes of seven steps; something goes wrong at step ``at`` of its life, or at reset ``at``.

    The fault is "reward", "observation" or "first observation", which are ``value`` then; "raise" or "die", "in step"
    or "in reset"; or a signal, such as "SIGINT" or "SIGINT in reset", that the learner gets meanwhile. A callback may
    call ``go_wrong`` too.
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
        name, _, place = self.fault.partition(" in ")
        if name in signal.Signals.__members__ and when == (place or "step"):
            os.kill(os.getppid(), signal.Signals[name])
            # The answer comes when the learner has long stopped waiting for it
            time.sleep(0.2)


class Wrapper(VecEnvWrapper):
    """Changes nothing."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


class NumericEnds(Wrapper):
    """Says in numbers which episodes end, as some VecEnvs do."""

    def step_wait(self):
        obs, rewards, dones, infos = super().step_wait()
        return obs, rewards, dones.astype(np.float32), infos


class Reused(Wrapper):
    """Hands out the same arrays at each step: dones, as numbers, observations and terminal observations."""

    def reset(self):
        return self.reused(self.venv.reset())

    def reused(self, obs):
        self.obs = getattr(self, "obs", np.zeros_like(obs))
        self.obs[:] = obs
        return self.obs

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        self.dones = getattr(self, "dones", np.zeros(self.num_envs, dtype=np.uint8))
        self.dones[:] = dones
        self.last = getattr(self, "last", np.zeros_like(obs))
        for i in np.flatnonzero(dones):
            self.last[i] = infos[i]["terminal_observation"]
            infos[i]["terminal_observation"] = self.last[i]
        return self.reused(obs), rewards, self.dones, infos


def of_two(**fault: Any) -> DummyVecEnv:
    """Two environments, of which the second has the fault."""
    both = {"observation_space": fault.get("observation_space"), "truncate": fault.get("truncate", False)}
    return DummyVecEnv([lambda: Faulty(**both), lambda: Faulty(**fault)])


def native(n_envs: int, **kwargs: Any) -> GymnasiumVecEnv:
    """Gymnasium's own vector environment of CartPole."""
    return GymnasiumVecEnv(gym.make_vec("CartPole-v1", n_envs, vectorization_mode="vector_entry_point", **kwargs))
