# %% [markdown]
# # How large may a step be?
#
# A noisy gradient is right on average. So is noise only a matter of patience? No: a policy acts on what it has learned,
# and a step that was too large in the wrong direction may never be taken back. Less noise allows larger steps.
# (`step="natural"` bounds the change of the policy instead, by `target_kl`: see the guide to `REINFORCE`.)

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import GradientQualityCallback

seed = 0
th.set_num_threads(1)
generator = np.random.default_rng(seed)

# %% [markdown]
# ## A thousand runs of two actions
#
# Left earns 8 and Right 12; $\pi(\text{Right}) = \sigma(\theta)$, starting from $\theta = 0$. Every return is positive,
# so without a baseline each drawn action is made more likely. A run that draws Left often at first may never see Right
# again. The baseline is the mean of the other episodes of the update. All runs have 4,000 episodes.


# %%
def climb(rate, n_episodes, with_baseline):
    """The mean of π(Right) over the runs, before the first update and after each; a baseline needs two episodes."""
    theta, means = np.zeros((1000, 1)), []
    for _ in range(4000 // n_episodes + 1):
        p = 1 / (1 + np.exp(-theta))
        right = generator.random((1000, n_episodes)) < p
        returns = np.where(right, 12.0, 8.0)
        if with_baseline:
            returns = returns - (returns.sum(1, keepdims=True) - returns) / (n_episodes - 1)
        theta = theta + rate * (returns * (right - p)).mean(1, keepdims=True)
        means.append(p.mean())
    return np.array(means)


settings = {
    "rate 0.5, 1 episode": (0.5, 1, False),
    "rate 0.2, 1 episode": (0.2, 1, False),
    "rate 0.01, 1 episode": (0.01, 1, False),
    "rate 4, 20 episodes": (4.0, 20, False),
    "rate 4, 20 episodes, baseline": (4.0, 20, True),
}
curves = {name: climb(*setting) for name, setting in settings.items()}
figure, ax = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
colors = ("#D55E00", "#CC79A7", "#E69F00", "#56B4E9", "#0072B2")
for (name, curve), (_, n_episodes, _), color in zip(curves.items(), settings.values(), colors, strict=True):
    ax.semilogx(n_episodes * np.arange(1, len(curve)), curve[1:], color=color, label=name)
    early = curve[40 // n_episodes]
    print(f"{name:32s} π(Right) after 40 episodes {early:.3f}, after 4,000 {curve[-1]:.4f}")
ax.set(title="Mean of 1000 runs", xlabel="episodes", ylabel="π(Right)", ylim=(0.4, 1.02))
ax.legend(frameon=False, fontsize="small")
plt.show()
large, medium, small, batch, baseline = curves.values()
assert large[-1] < 0.88 and 0.93 < min(medium[-1], batch[-1]) and max(medium[-1], batch[-1]) < 0.99 < small[-1]
# A single run that is lost costs 0.001
assert small[40] < 0.62 and small[400] < 0.93 and baseline[20] > 0.99 and baseline[-1] > 0.9992

# %% [markdown]
# A lost run ends with π(Right) near 0 and the others near 1, so 1 minus the mean is about the share of lost runs. The
# large step with one episode ends on the wrong action in many runs. The small step loses none, but it is slow at first.
# With twenty episodes a rate of 4, eight times the large rate, loses only a few runs in a hundred. For the same data
# this gains little: it is a rate of 0.2 per episode, and the rate 0.2 with one episode loses 3 to 5 runs in a hundred.
# The baseline makes the difference. With it, the rate of 4 is the fastest and loses no run.
#
# ## How noisy is the gradient of a real run?
#
# `GradientQualityCallback` logs `gradient/noise_scale`, the number of episodes whose mean gradient has a
# signal-to-noise ratio of 1 (inf where no signal is detected). In this run it rises as the policy improves, though not
# at every update.


# %%
class Print(GradientQualityCallback):
    """Prints the noise scale that it logs, and keeps it."""

    def __init__(self):
        super().__init__(every=1)
        self.scales = []

    def measure(self, rollout):
        figures = super().measure(rollout)
        self.scales.append(figures["noise_scale"])
        print(f"{self.num_timesteps:6,} steps: noise scale {figures['noise_scale']:6.1f} episodes")
        return figures


env = make_vec_env("CartPole-v1", n_envs=8, seed=seed)
model = REINFORCE(
    "MlpPolicy", env, baseline="leave_one_out", n_episodes=32, learning_rate=0.01, seed=seed, device="cpu"
)
callback = Print()
model.learn(15_000, callback=callback, log_interval=None)
scales = np.array(callback.scales)
assert np.median(scales[-3:]) > 1.5 * np.median(scales[:3])

# %% [markdown]
# ## Two guards
#
# `max_grad_norm` bounds the norm of the gradient, which limits the weight of one unlucky batch.
# `normalize_advantage=True` scales the weights of a batch to mean 0 and standard deviation 1. With either of them
# rewards that are 100 times as large make the same step here, also with plain gradient ascent (Adam itself divides by
# the scale). Both guards bias the gradient: clipping shortens large estimates, and the mean and the scale come from the
# batch's own returns. The bound cuts both gradients here; one that is never reached changes nothing:


# %%
class Scaled(gym.Env):
    """Two actions, worth 0 and ``scale``."""

    observation_space, action_space = spaces.Box(1, 1, (1,)), spaces.Discrete(2)

    def __init__(self, scale):
        self.scale = scale

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, dtype=np.float32), {}

    def step(self, action):
        return np.ones(1, dtype=np.float32), self.scale * float(action), True, False, {}


arguments = {"baseline": "none", "n_episodes": 20, "device": "cpu", "seed": seed}
arguments["policy_kwargs"] = {"net_arch": [], "optimizer_class": th.optim.SGD}
guards = {
    "none": {"max_grad_norm": None},
    "max_grad_norm": {"max_grad_norm": 0.1},
    "normalize_advantage": {"max_grad_norm": None, "normalize_advantage": True},
}
for name, guard in guards.items():
    steps = []
    for scale in (1.0, 100.0):
        model = REINFORCE("MlpPolicy", Scaled(scale), **guard, **arguments)
        before = model.policy.action_net.bias.detach().clone()
        steps.append((model.learn(1).policy.action_net.bias.detach() - before).norm().item())
    print(f"{name:20s} lengths of the steps {steps[0]:.6f} and {steps[1]:.6f}")
    assert np.isclose(steps[1] / steps[0], 100 if name == "none" else 1, rtol=0.01)
