"""Models with action masks, and environments that refuse forbidden actions."""

import numpy as np
from environments import Random
from gymnasium import spaces
from sb3_contrib import TRPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE, ActionMaskObservation, FiniteDifference, MaskedPolicy
from sb3_reinforce.policies.masks import sizes_of
from sb3_reinforce.recurrent import MaskedLstmPolicy, RecurrentREINFORCE

ALGORITHMS = {
    "reinforce": (REINFORCE, {"n_steps": 16}),
    "episodes": (REINFORCE, {"n_episodes": 4, "baseline": "leave_one_out"}),
    "search": (FiniteDifference, {"n_delta": 4, "estimator": "central", "deterministic": False}),
    "a2c": (A2C, {"n_steps": 16}),
    "ppo": (PPO, {"n_steps": 64, "batch_size": 64, "n_epochs": 2}),
    "trpo": (TRPO, {"n_steps": 16, "batch_size": 16}),
    "recurrent": (RecurrentREINFORCE, {"n_steps": 16}),
}
VECTOR = spaces.Box(-1, 1, (3,))
IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)
TASKS = {
    "discrete": (VECTOR, spaces.Discrete(5)),
    "multidiscrete": (VECTOR, spaces.MultiDiscrete([2, 4, 3])),
    "image": (spaces.Dict({"image": IMAGE, "vector": VECTOR}), spaces.Discrete(5)),
    "numbers": (spaces.MultiDiscrete([2, 3]), spaces.Discrete(5)),
}


class Masked(Random):
    """Draws a new mask at each step, which allows nothing when the episode is over, and refuses forbidden actions."""

    def observe(self):
        sizes = sizes_of(self.action_space)
        parts = [self.np_random.random(size) < 0.4 for size in sizes]
        for part in parts:
            part[self.np_random.integers(len(part))] = True
        self.parts = parts if self.t < self.length else [np.zeros(size, bool) for size in sizes]
        return super().observe()

    def action_masks(self):
        return np.concatenate(self.parts)

    def step(self, action):
        chosen = np.atleast_1d(action - getattr(self.action_space, "start", 0))
        assert all(part[a] for part, a in zip(self.parts, chosen, strict=True)), f"{action} is forbidden"
        return super().step(action)


def environment(task="discrete"):
    return ActionMaskObservation(Masked(*TASKS[task], lengths=(3, 7)))


def two_environments(**kwargs):
    return make_vec_env(environment, 2, **{"seed": 0, **kwargs})


def make(algorithm, env, **kwargs):
    cls, arguments = ALGORITHMS[algorithm]
    fixed = {"seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}
    policy = MaskedLstmPolicy if cls is RecurrentREINFORCE else MaskedPolicy
    return cls(policy, env, **{**fixed, **arguments, **kwargs})
