# %% [markdown]
# # When should a policy stay random?
#
# A policy gradient climbs from where it stands. Randomness lets it see what lies beyond, and without a memory the best
# policy may itself be random.

# %%
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule

from sb3_reinforce import REINFORCE

seed = 0
th.set_num_threads(1)
common = {"baseline": "leave_one_out", "n_episodes": 32, "seed": seed, "device": "cpu"}

# %% [markdown]
# ## A local optimum
#
# The action is a number. Near −1 it earns up to 0.5, near 2 up to 1, and little in between. A Gaussian policy with the
# mean −1 and the standard deviation 0.3 almost never samples the higher hill, and stays on the lower one. With a floor
# under the standard deviation (`min_std`) the policy sees both. The floor has a price: with a standard deviation of 1.5
# the best mean is 1.6, not 2.


# %%
class Hills(gym.Env):
    """One step; the reward has two hills."""

    observation_space, action_space = spaces.Box(1, 1, (1,)), spaces.Box(-4, 4, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, dtype=np.float32), {}

    def step(self, action):
        reward = 0.5 * np.exp(-((action[0] + 1) ** 2)) + np.exp(-((action[0] - 2) ** 2))
        return np.ones(1, dtype=np.float32), float(reward), True, False, {}


means = {}
for min_std in (0.0, 1.5):
    policy_kwargs = {"net_arch": [], "log_std_init": np.log(0.3)}
    env = make_vec_env(Hills, 8, seed=seed)
    model = REINFORCE("MlpPolicy", env, learning_rate=0.04, min_std=min_std, policy_kwargs=policy_kwargs, **common)
    th.nn.init.constant_(model.policy.action_net.bias, -1.0)
    model.learn(10_000)
    means[min_std] = float(model.predict(np.ones(1, dtype=np.float32), deterministic=True)[0][0])
    print(f"min_std = {min_std}: the mean action is {means[min_std]:+.2f}")
assert means[0.0] < -0.7 and means[1.5] > 1

# %% [markdown]
# ## Temperature and entropy
#
# Two arguments keep a policy of discrete actions random, and both can be schedules. `temperature` divides the logits:
# $\pi(a \mid s) \propto \exp(z_a / T)$. `ent_coef` is the weight $c$ of the entropy $H$ (Williams and Peng, 1991). It
# adds $c \sum_t \nabla H(\pi(\cdot \mid s_t))$ to the gradient, which for one step is the gradient of
# $E[\text{return}] + c H$. Here three arms pay 1, 1.1 and 1.2 on average, with noise of standard deviation 1. At
# temperature 1 the policy starts with a probability of 0.999 for the worst arm, and hardly sees the others. Without a
# schedule the policy mostly keeps choosing the worst arm. With a schedule it tries the other arms first and decides
# later: at temperature 5 the worst arm has a probability of only 0.71. The runs with this schedule print
# π(best arm) at its last temperature, 0.1, which sharpens the policy; the other runs print it at temperature 1.


# %%
class Arms(gym.Env):
    """One step, three noisy rewards."""

    observation_space, action_space = spaces.Box(1, 1, (1,)), spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, dtype=np.float32), {}

    def step(self, action):
        return np.ones(1, dtype=np.float32), self.np_random.normal(1.0 + 0.1 * action), True, False, {}


def probabilities(model):
    """π(·|s) for the only observation."""
    with th.no_grad():
        return model.policy.get_distribution(th.ones(1, 1)).distribution.probs[0]


schedules = {
    "neither": {},
    "ent_coef falls from 0.3 to 0": {"ent_coef": LinearSchedule(0.3, 0.0, 1.0)},
    "temperature falls from 5 to 0.1": {"temperature": LinearSchedule(5.0, 0.1, 1.0)},
}


def best_arm(arguments, seed):
    """The probability of the best arm after training."""
    arguments = {**common, "learning_rate": 0.03, "policy_kwargs": {"net_arch": []}, **arguments, "seed": seed}
    model = REINFORCE("MlpPolicy", make_vec_env(Arms, 8, seed=seed), **arguments)
    # At temperature 1 the worst arm has the probability 0.999
    with th.no_grad():
        model.policy.action_net.bias[0] = 8.0
    return probabilities(model.learn(10_000))[2].item()


found = {}
for name, arguments in schedules.items():
    found[name] = [best_arm(arguments, seed + run) for run in range(3)]
    print(f"{name:32s} π(best arm) in three runs: {', '.join(f'{each:.2f}' for each in found[name])}")
neither, *scheduled = found.values()
assert np.mean(neither) < 0.5 and np.min(scheduled) > 0.6

# %% [markdown]
# ## A problem whose best memoryless policy is random
#
# A corridor of three cells that look alike (Sutton and Barto, 2018, example 13.1). In the middle cell left and right
# are exchanged. Each step costs 1 until the end on the right is reached. Always right and always left never arrive; the
# best policy without a memory goes right with probability $2 - \sqrt 2 \approx 0.59$, and needs 11.7 steps. A policy
# that is greedy in action values is deterministic and cannot represent this one. A softmax can. (With a memory three
# steps would do: right, left, right.)


# %%
class Corridor(gym.Env):
    """Three cells, one observation."""

    observation_space, action_space = spaces.Box(1, 1, (1,)), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return np.ones(1, dtype=np.float32), {}

    def step(self, action):
        is_right = bool(action) != (self.cell == 1)
        self.cell = max(0, self.cell + (1 if is_right else -1))
        return np.ones(1, dtype=np.float32), -1.0, self.cell == 3, False, {}


env = make_vec_env(Corridor, 8, seed=seed)
model = REINFORCE("MlpPolicy", env, gamma=1.0, learning_rate=0.01, policy_kwargs={"net_arch": []}, **common)
model.learn(30_000)
right = probabilities(model)[1].item()
length = np.mean([info["l"] for info in model.ep_info_buffer])
print(f"π(right) = {right:.2f}, mean length of the last 100 episodes {length:.1f}")
# From the three cells' equations, an episode takes 2 (2 − p) / (p (1 − p)) steps
best = 2 - 2**0.5
assert round(best, 2) == 0.59 and round(2 * (2 - best) / (best * (1 - best)), 1) == 11.7
assert abs(right - best) < 0.12 and abs(length - 11.7) < 4
