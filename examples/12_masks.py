# %% [markdown]
# # What is an action mask worth?
#
# Each of 40 doors is opened by the key with its number. At each door 29 or 30 keys are known not to fit: a mask forbids
# them. The discount is 0, since no key changes a later door. A policy without the mask could learn to avoid wrong keys,
# too. How many doors does each policy open after 4,000 steps of training?

# %%
import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import REINFORCE, ActionMaskObservation

seed = 0
th.set_num_threads(1)


# %%
class Doors(gym.Env):
    """The observation is the number of the door; an episode is 50 doors, and a door that opens earns 1."""

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


# %% [markdown]
# `ActionMaskObservation` adds the mask from `action_masks()`, the name in sb3-contrib's MaskablePPO, to the
# observation. `MaskedPolicy` gives forbidden actions the probability 0. Algorithms need no change. An untrained policy
# opens 50 / 40 = 1.25 doors without masks and about 4.7 doors with them.

# %%
# The door's own key is among the ten random ones for a quarter of the doors
untrained = {"MlpPolicy": 50 / 40, "MaskedPolicy": 50 * (0.25 / 10 + 0.75 / 11)}
assert round(untrained["MaskedPolicy"], 1) == 4.7

means = {}
for policy, wrapper in (("MlpPolicy", None), ("MaskedPolicy", ActionMaskObservation)):
    env = make_vec_env(Doors, n_envs=8, seed=seed, wrapper_class=wrapper)
    model = REINFORCE(policy, env, gamma=0.0, learning_rate=0.01, seed=seed, device="cpu").learn(4_000)
    eval_env = make_vec_env(Doors, n_envs=8, seed=1000 + seed, wrapper_class=wrapper)
    means[policy], _ = evaluate_policy(model, eval_env, n_eval_episodes=200, deterministic=False)
    print(f"{policy:12s} {means[policy]:4.1f} of 50 doors in 200 episodes")
learned = {policy: means[policy] - untrained[policy] for policy in means}
assert learned["MaskedPolicy"] > 3 * learned["MlpPolicy"] > 0
assert learned["MaskedPolicy"] - learned["MlpPolicy"] > untrained["MaskedPolicy"] - untrained["MlpPolicy"]

# %% [markdown]
# Most of the difference between the two is learned. With the mask an untrained policy opens almost four times as many
# doors, so there are more successes to learn from.
