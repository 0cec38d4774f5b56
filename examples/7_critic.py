# %% [markdown]
# # How far should a critic be trusted?
#
# A critic $V(s)$ can do more than serve as a baseline: it can stand in for the rewards that are still to come. With
# $\delta_t = r_t + \gamma V(s_{t+1}) - V(s_t)$ the generalized advantage estimate is $\sum_k (\gamma \lambda)^k
# \delta_{t+k}$ (Schulman et al., 2016). It equals $G_t^\lambda - V(s_t)$, which the code computes from the λ-return
# $G_t^\lambda = r_t + \gamma [(1 - \lambda) V(s_{t+1}) + \lambda G_{t+1}^\lambda]$. At $\lambda = 1$ it is $G_t -
# V(s_t)$. A wrong $V$ then changes the variance, but not the expectation, where no time limit cuts the episode and $V$
# is 0 after the last state. At $\lambda = 0$ only $\delta_t$ is left: little noise, and all errors of $V$.

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import gradient_statistics, sample
from sb3_reinforce.estimation import gradients_by_episode, lambda_return

seed = 0
th.set_num_threads(1)

# %% [markdown]
# The policy stays as it is (`learning_rate=0`), only its critic learns. 300 episodes are drawn before and 300 after;
# each time the gradients of all $\lambda$ are computed from the same episodes.

# %%
env = make_vec_env("CartPole-v1", n_envs=8, seed=seed)
model = REINFORCE(
    "MlpPolicy", env, learning_rate=0.0, critic_learning_rate=5e-3, n_critic_updates=10, seed=seed, device="cpu"
)
lambdas = (0.0, 0.5, 0.8, 0.95, 1.0)


def norm_of_mean(gradients):
    """‖E g‖. The square of a sample mean's norm is too large by the mean's variance."""
    square = gradients.mean(0).square().sum() - gradients.var(0).sum() / len(gradients)
    return max(0.0, square.item()) ** 0.5


def bias_and_noise():
    """As shares of the gradient: each λ's bias against λ = 1, and the standard deviation of the mean of 16 episodes."""
    rollout = sample(model, 300)
    rewards, dones, next_values = (part.numpy() for part in (rollout.rewards, rollout.dones, rollout.next_values))
    returns = [th.as_tensor(lambda_return(rewards, dones, next_values, model.gamma, lam)) for lam in lambdas]
    gradients = gradients_by_episode(rollout, *(each - rollout.values for each in returns))
    norm = norm_of_mean(gradients[-1])
    bias = [norm_of_mean(gradient - gradients[-1]) / norm for gradient in gradients]
    noise = [(gradient_statistics(gradient).variance.value / 16) ** 0.5 / norm for gradient in gradients]
    return np.array(bias), np.array(noise)


found = {"untrained critic": bias_and_noise()}
model.learn(30_000)
found["trained critic"] = bias_and_noise()

# %%
figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), sharex=True, layout="constrained")
for (name, (bias, noise)), color in zip(found.items(), ("#D55E00", "#0072B2"), strict=True):
    both = np.hypot(bias, noise)
    for ax, values in zip(axes, (bias, noise, both), strict=True):
        # Evenly spaced, since most of the λs are close to 1
        ax.plot([str(lam) for lam in lambdas], values, marker="o", color=color, label=name)
    print(name)
    for row in zip(lambdas, bias, noise, both, strict=True):
        print("  λ = {:4.2f}: bias {:4.2f}, noise {:5.2f}, both {:5.2f}".format(*row))
for ax, title in zip(axes, ("bias", "standard deviation of 16 episodes", "both: √(bias² + noise²)"), strict=True):
    ax.set(title=title, xlabel="λ", ylim=(0, None))
axes[0].set_ylabel("share of the gradient's norm")
axes[0].legend(frameon=False)
figure.suptitle("CartPole-v1, one policy, gradients of 300 episodes for each critic", fontsize="medium")
plt.show()

# %% [markdown]
# An untrained critic knows nothing of the future: at $\lambda = 0$ every weight is about 1. Scores have mean zero, so
# hardly any signal is left, and little noise. A trained one keeps most of the gradient, with less noise than at
# $\lambda = 1$. The usual $\lambda = 0.95$ then has less noise too, and a bias that 300 episodes hardly show (0.00:
# none is detected). At $\lambda = 1$ a wrong critic is only a bad baseline; at $\lambda = 0$ the policy follows its
# errors. Lower $\lambda$ as long as bias and noise together fall: here some $\lambda$ below 1 is best. The noise is for
# updates of 16 episodes. Larger batches have less noise but the same bias, so they need a larger $\lambda$.

# %%
(bias_before, noise_before), (bias_after, noise_after) = found.values()
assert noise_before[0] < noise_before[3] < noise_before[-1]
assert noise_after[0] < noise_after[3] < noise_after[-1] and noise_after[0] < 0.85 * noise_after[-1]
assert bias_before[0] > bias_before[3] > bias_before[-1] == 0
assert bias_before[0] > 0.9 and bias_after[0] < 0.4 and bias_after[3] < 0.2
both = np.hypot(bias_after, noise_after)
assert both[1:-1].min() < both[-1]
