# %% [markdown]
# # Which baseline leaves the least noise?
#
# A baseline $b_t$ is subtracted from the return before it weights the score. It leaves the expected gradient alone as
# long as it depends neither on the action nor on its consequences. How much noise it removes depends on what it may
# depend on: nothing, the time, or the state.

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import compare_baselines, sample
from sb3_reinforce.diagnostics.plots import plot_baselines
from sb3_reinforce.estimation import BASELINES, gradients_by_episode

seed = 0
th.set_num_threads(1)

# %% [markdown]
# ## A bandit
#
# Two actions with rewards from $N(3, 4)$ and $N(5, 4)$, and gradients of 20 episodes. Here every variance has a
# formula, for baselines that are known. The second number of $N(3, 4)$ is the variance. With $q = 1 - p$, the weights
# and biases of both logits give $\|S\|^2 = 4 q^2$ for the better action, which has the probability $p$, and $4 p^2$ for
# the other. The optimal baseline is the constant $b$ that minimizes the variance. The return of an episode is $R$, and
# its score is $S = \sum_t \nabla \log \pi(a_t \mid s_t)$. The mean of $(R - b) S$ does not depend on $b$, so only
# $E[\|(R - b) S\|^2]$ matters (Greensmith, Bartlett and Baxter, 2004). The derivative of $E[\|(R - b) S\|^2]$ with
# respect to $b$ is 0 at
#
# $$b^* = \frac{E[R \, \|S\|^2]}{E[\|S\|^2]},$$
#
# the mean of the returns weighted by the squared length of their scores. For a uniform policy all scores have one
# length, and it is the mean of the returns. For a policy that prefers an action it is better than the mean.


# %%
class Bandit(gym.Env):
    """The observation is always 1, and an episode is one step."""

    observation_space, action_space = spaces.Box(1, 1, (1,)), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, dtype=np.float32), {}

    def step(self, action):
        return np.ones(1, dtype=np.float32), self.np_random.normal([3.0, 5.0][action], 2.0), True, False, {}


policy_kwargs = {"net_arch": []}
bandit = make_vec_env(Bandit, 50, seed=seed)
model = REINFORCE("MlpPolicy", bandit, baseline="none", policy_kwargs=policy_kwargs, seed=seed, device="cpu")
th.nn.init.zeros_(model.policy.action_net.weight)
names = ("none", "mean", "optimal")

figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.6), sharey=True, layout="constrained")
for ax, p in zip(axes, (0.5, 0.8), strict=True):
    with th.no_grad():
        model.policy.action_net.bias.copy_(th.tensor([1 - p, p]).log())
    # Of the worse and the better action: probability, mean reward and squared length of the score
    chances, rewards, squares = np.array([1 - p, p]), np.array([3.0, 5.0]), 4 * np.array([p, 1 - p]) ** 2
    constants = (0.0, chances @ rewards, (chances * squares) @ rewards / (chances @ squares))
    # E[‖(R − b) S‖²] − ‖E[R S]‖² with Var(R | a) = 4; E[R S] has four components ±2 p (1 − p)
    exact = [(chances @ (squares * ((rewards - b) ** 2 + 4)) - 16 * (p * (1 - p)) ** 2) / 20 for b in constants]
    rollout = sample(model, 10_000)
    measured = []
    for name, truth in zip(names, exact, strict=True):
        # The baselines are estimated from so many episodes that they are as good as known. The mean of 20 gradients
        # has a twentieth of the variance of one
        (gradients,) = gradients_by_episode(rollout, rollout.returns - BASELINES[name](rollout))
        measured.append(gradients.var(0).sum().item() / 20)
        print(f"p = {p}, {name:8s} variance {measured[-1]:.3f}, exact {truth:.3f}")
    assert np.allclose(measured, exact, rtol=0.08)
    ax.bar(names, measured, color="#56B4E9", label="10,000 episodes")
    ax.plot(exact, linestyle="", marker="D", color="#D55E00", label="exact")
    ax.set(title=f"better action with probability {p}", xlabel="baseline")
axes[0].set_ylabel("variance of the gradient of 20 episodes")
axes[1].legend(frameon=False)
plt.show()

# %% [markdown]
# At $p = 0.5$ mean and optimal coincide at 0.20, against 1.00 without a baseline. At $p = 0.8$ the optimal constant
# leaves 0.13, the mean 0.17 and no baseline 0.50.
#
# ## CartPole
#
# Here the return depends on the step: late in an episode little is left to earn. With the reward-to-go, $A = \sum_t
# \nabla \log \pi(a_t \mid s_t) \, G_t$ takes the place of $R S$, and $b^* = E[\langle A, S \rangle] / E[\|S\|^2]$.
# `compare_baselines` measures every baseline on the same 200 episodes. Both variances of a ratio to "none" come from
# the same resamples (episodes drawn again with replacement), so part of their fluctuation cancels. The ratio of
# "optimal" is therefore known more precisely than its variance.

# %%
env = make_vec_env("CartPole-v1", n_envs=8, seed=seed)
policy_kwargs = {"net_arch": {"pi": [], "vf": [64]}}
model = REINFORCE(
    "MlpPolicy", env, critic_learning_rate=0.01, policy_kwargs=policy_kwargs, seed=seed, device="cpu"
).learn(10_000)
table = compare_baselines(model, n_episodes=200, seed=seed)
print(table)
plot_baselines(table)
plt.show()

# %% [markdown]
# "optimal" is only the best *constant*; "time_mean" and "leave_one_out" depend on the step, "value" on the state. Which
# is best depends on the task. Here the constant leaves less noise than "leave_one_out". Whether it also leaves less
# than "value" depends on the seed. Hollow markers are biased, or may be. "time_mean" contains the return that it is
# subtracted from. For $N$ episodes of one length its gradient is the one of "leave_one_out" times $(N - 1) / N$, signal
# and noise alike. The floor takes the best constant for each single component of the gradient. No constant goes below
# it, but a baseline that depends on the step or the state can.

# %%
ratio = {row.baseline: row.ratio.value for row in table}
assert ratio["floor"] < ratio["optimal"] < ratio["leave_one_out"] < ratio["none"] and ratio["value"] < ratio["none"]
row = table["optimal"]
widths = [(estimate.high - estimate.low) / estimate.value for estimate in (row.ratio, row.variance)]
assert widths[0] < 0.8 * widths[1]

# %% [markdown]
# ## When the best constant is a bad baseline
#
# Twenty steps that earn 1 each, whatever is done: the return falls from 20 to 1, and no constant follows it. The mean
# of the other episodes at the same step removes all noise.


# %%
class Countdown(gym.Env):
    """The observation is the fraction of the time that is over."""

    observation_space, action_space = spaces.Box(0, 1, (1,)), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self.t += 1
        return np.full(1, self.t / 20, dtype=np.float32), 1.0, self.t == 20, False, {}


env = make_vec_env(Countdown, 8, seed=seed)
model = REINFORCE("MlpPolicy", env, baseline="none", gamma=1.0, seed=seed, device="cpu")
table = compare_baselines(model, 200, ("optimal", "leave_one_out"), seed=seed)
for row in table:
    print(f"{row.baseline:14s} variance / variance of none {row.ratio}")
assert table["optimal"].ratio.value > 0.1 and table["leave_one_out"].ratio.value < 1e-6
