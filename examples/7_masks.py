"""
What is it worth to forbid actions that a policy could also learn to avoid?

Each of 40 doors is opened by the key with its number, and 30 keys that are drawn at each door are known not to fit. The
return is the number of doors, of 50, that open at the first try. Without masks all keys are tried.

    python examples/7_masks.py
"""

import argparse

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import REINFORCE, ActionMaskObservation


class Doors(gym.Env):
    """The observation is the number of the door."""

    observation_space = spaces.Discrete(40)
    action_space = spaces.Discrete(40)

    def next_door(self):
        self.door = self.np_random.integers(40)
        self.may_fit = self.np_random.permutation(40) < 10
        self.may_fit[self.door] = True
        return self.door

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_doors = 0
        return self.next_door(), {}

    def step(self, key):
        reward = float(key == self.door)
        self.n_doors += 1
        return self.next_door(), reward, self.n_doors == 50, False, {}

    def action_masks(self):
        return self.may_fit


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=2_000)
arguments = parser.parse_args()
th.set_num_threads(1)

for policy, wrapper in (("MlpPolicy", None), ("MaskedPolicy", ActionMaskObservation)):
    env = make_vec_env(Doors, n_envs=8, seed=arguments.seed, wrapper_class=wrapper)
    model = REINFORCE(policy, env, gamma=0.0, seed=arguments.seed, device="cpu").learn(arguments.timesteps)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=50)
    print(f"{policy:12s} {mean:.1f} of 50 doors")
