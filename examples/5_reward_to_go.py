# %% [markdown]
# # Which rewards can an action change?
#
# Only those that come after it. REINFORCE may weight the score of step $t$ by the return of the whole episode, or by
# the reward-to-go $G_t = \sum_{k \geq t} \gamma^{k-t} r_k$. For $\gamma = 1$ the expected gradient is the same. Given
# $s_t$ and the steps before it, an earlier reward $r_k$ is a known number, and the score has mean zero (page 2). So
# $E[r_k \nabla \log \pi(a_t \mid s_t)] = 0$ for $k < t$. The variance is not the same.

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import gradient_statistics, sample
from sb3_reinforce.estimation import gradients_by_episode, reward_to_go, total_return

seed = 0
th.set_num_threads(1)

# %% [markdown]
# ## By hand
#
# Two episodes one after the other, with rewards 1, 3, 2 and 10, 20. Sums end where an episode ends.

# %%
rewards, dones = np.array([[1.0, 3.0, 2.0, 10.0, 20.0]]).T, np.array([[False, False, True, False, True]]).T
print(reward_to_go(rewards, dones, gamma=1.0)[:, 0].tolist())
assert reward_to_go(rewards, dones, gamma=1.0)[:, 0].tolist() == [6, 5, 2, 30, 20]

# %% [markdown]
# ## On CartPole
#
# The same 400 episodes of an untrained policy, weighted in both ways, with $\gamma = 1$. Each episode gives one
# gradient for each way; the variance is the trace of its covariance. It is several times smaller with the reward-to-go.
# The square brackets are 95 % bootstrap intervals: the episodes are drawn again with replacement, many times.

# %%
env = make_vec_env("CartPole-v1", n_envs=8, seed=seed)
model = REINFORCE("MlpPolicy", env, baseline="none", gamma=1.0, seed=seed, device="cpu")
rollout = sample(model, 400)
# No episode had begun before the rollout, so the rewards before it are 0
whole = total_return(rollout.returns.numpy(), rollout.timesteps.numpy(), model.gamma, np.zeros(env.num_envs))
to_go, total = gradients_by_episode(rollout, rollout.returns, th.as_tensor(whole))
variances = [gradient_statistics(gradients).variance for gradients in (total, to_go)]
print("variance with the total return:", variances[0])
print("variance with the reward-to-go:", variances[1])
print(f"ratio {variances[0].value / variances[1].value:.1f}")
assert variances[0].value > 2.5 * variances[1].value

# %% [markdown]
# The signal-to-noise ratio is the squared norm of the expected gradient divided by the variance of one episode's
# gradient. For the difference of the two gradients its interval contains 0: no signal is detected in the past rewards.
# In expectation there is none.

# %%
difference = gradient_statistics(total - to_go)
print("signal-to-noise ratio of the difference:", difference.snr)
assert difference.snr.low <= 0 <= difference.snr.high

# %% [markdown]
# ## Where does the discount go?
#
# Ten switches one after the other, each worth 1 if it is turned on. The discounted utility is
# $U = \sum_t \gamma^t \, \pi(\text{on} \mid t)$, so for a uniform policy its derivative with respect to the logit of
# "on" at $t$ is $\gamma^t / 4$. The factor $\gamma^t$ comes with `discount_scores=True`. Most libraries leave it out,
# and so does this package by default: then late actions count as much as early ones, and the direction is in general
# not the gradient of any function (Nota and Thomas, 2020).


# %%
class Switches(gym.Env):
    """The observation says which of the ten switches it is."""

    observation_space, action_space = spaces.Box(0, 1, (10,)), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.eye(10, dtype=np.float32)[0], {}

    def step(self, action):
        self.t += 1
        return np.eye(10, dtype=np.float32)[self.t % 10], float(action), self.t == 10, False, {}


arguments = {"baseline": "none", "gamma": 0.8, "discount_scores": True, "policy_kwargs": {"net_arch": []}}
model = REINFORCE("MlpPolicy", make_vec_env(Switches, 8, seed=seed), seed=seed, device="cpu", **arguments)
th.nn.init.zeros_(model.policy.action_net.weight)
rollout = sample(model, 4000)
weights = {"with γᵗ": rollout.discounts * rollout.returns, "without γᵗ": rollout.returns}
truth = 0.25 * 0.8 ** np.arange(10)
is_exact = {}

figure, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
for (name, weight), color, shift in zip(weights.items(), ("#0072B2", "#D55E00"), (-0.1, 0.1), strict=True):
    (gradients,) = gradients_by_episode(rollout, weight)
    # The weights of "off" come first, then those of "on"
    by_switch = gradients[:, 10:20].numpy()
    mean, standard_error = by_switch.mean(axis=0), by_switch.std(axis=0) / len(by_switch) ** 0.5
    label = f"{name} (± 2 standard errors)"
    ax.errorbar(np.arange(10) + shift, mean, 2 * standard_error, fmt="o", color=color, label=label)
    is_exact[name] = (np.abs(mean - truth) < 4.5 * standard_error).all()
assert is_exact["with γᵗ"] and not is_exact["without γᵗ"]
ax.plot(truth, color="black", label="exact: γᵗ / 4")
ax.axhline(0.25, color="black", linestyle="--", label="1 / 4, the gradient without a discount")
ax.set(title="Ten switches, 4000 episodes", xlabel="time step t", ylabel="derivative by the logit of switch t")
ax.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Divided by episodes, or by steps?
#
# Half of the episodes take the short way: one step, return 2. The others take eleven steps and return 3. Only the first
# action is a choice, so each episode has a single score. The long way is better. A sum of gradients divided by the
# number of *steps* is a ratio of two random numbers, and gives long episodes too little weight; with one episode per
# update it even points to the short way. Divided by the number of *episodes* the gradient is unbiased
# (`normalize_by="episodes"`). The bias falls as the number of episodes in an update grows. The default,
# `normalize_by="steps"`, is biased. It gives the updates the scale of A2C's. Here the sums divided by steps are
# multiplied by the mean length, to compare them.

# %%
# The score of the logit of "short" is 1/2 for the short way and -1/2 for the long one
gradient, length = np.array([2 * 0.5, 3 * -0.5]), np.array([1.0, 11.0])
print(f"exact, towards the short way:     {gradient.mean():+.3f}")
print(f"by steps, 1 episode an update:    {(gradient / length).mean() * length.mean():+.3f}")
drawn = np.random.default_rng(seed).integers(2, size=(100_000, 16))
by_steps = (gradient[drawn].sum(1) / length[drawn].sum(1)).mean() * length.mean()
print(f"by steps, 16 episodes an update:  {by_steps:+.3f}")
assert gradient.mean() == -0.25 and (gradient / length).mean() > 0
assert -0.25 < by_steps < -0.15
