# %% [markdown]
# # Can REINFORCE balance a pole?
#
# A pole stands on a cart. Each step earns 1. An episode ends when the pole falls, the cart leaves the track, or after
# 500 steps. A policy with parameters $\theta$ draws the actions. Its utility $U(\theta) = E[\text{return}]$ has no
# formula: we only see samples of it, one per episode.
#
# REINFORCE (Williams, 1992) estimates the gradient of $U$ from $N$ episodes of the present policy,
#
# $$\hat g = \frac{1}{N} \sum_{i=1}^{N} \sum_t \nabla_\theta \log \pi_\theta(a_t \mid s_t) \, (G_t - b_t),$$
#
# and takes one step along it. $G_t$ is the sum of the rewards from step $t$ on and $b_t$ a baseline: here the mean of
# $G_t$ over the other episodes that reach step $t$.
#
# Why the scores $\nabla_\theta \log \pi_\theta$? For the probability $p_\theta$ of an episode,
# $\nabla p_\theta = p_\theta \nabla \log p_\theta$, so the gradient of an expectation, a sum over all episodes, is an
# expectation too: $\nabla \sum p_\theta \cdot \text{return} = E[\text{return} \cdot \nabla \log p_\theta]$. In
# $\log p_\theta = \log p(s_0) + \sum_t [\log \pi_\theta(a_t \mid s_t) + \log p(s_{t+1} \mid s_t, a_t)]$, with states
# $s_t$ and actions $a_t$, the dynamics of the cart do not depend on $\theta$ and drop out of the gradient. Only the
# scores remain. $G_t$ may replace the return, since an action does not change earlier rewards (page 5). A $b_t$ that
# depends neither on $a_t$ nor on what follows it may be subtracted, since scores have mean zero (pages 2 and 6).

# %%
import torch as th
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import REINFORCE

seed = 0
th.set_num_threads(1)

# %% [markdown]
# Whole episodes, no critic, one policy step per 16 episodes. The policy is Stable-Baselines3's `MlpPolicy`. By default
# the gradient is clipped to the norm 0.5 (page 9), Adam takes the step, the sum is divided by the number of steps
# instead of $N$, and rewards are discounted with 0.99 (page 5 shows what the last two change). Replace `REINFORCE` by
# `PPO`, without the arguments `baseline` and `n_episodes`, and the code below runs unchanged.

# %%
env = make_vec_env("CartPole-v1", n_envs=8, seed=seed)
model = REINFORCE(
    "MlpPolicy", env, baseline="leave_one_out", n_episodes=16, learning_rate=0.01, seed=seed, device="cpu"
)

# %% [markdown]
# Training takes at most 200,000 steps. Every 4,000 steps the policy is evaluated on 20 episodes with its most likely
# actions, and training stops when their mean return is at least 490. This is not $U(\theta)$, for which actions are
# sampled.

# %%
until_solved = EvalCallback(
    make_vec_env("CartPole-v1", n_envs=20, seed=1000 + seed),
    callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=490),
    n_eval_episodes=20,
    # It counts calls, each a step of all environments
    eval_freq=4_000 // env.num_envs,
    verbose=0,
)
model.learn(200_000, callback=until_solved, progress_bar=True)
if model.num_timesteps < 200_000:
    print(f"Stopped after {model.num_timesteps:,} of 200,000 steps because the task is solved:")
print(f"The best evaluation of 20 episodes scored {until_solved.best_mean_reward:.1f} on average.")

# %% [markdown]
# One evaluation that was good enough to stop may have been lucky. So 100 more episodes are played. The number after ±
# is the standard deviation of one return; the standard error of the mean is a tenth of it.

# %%
mean, std = evaluate_policy(model, make_vec_env("CartPole-v1", n_envs=50, seed=2000 + seed), n_eval_episodes=100)
print(f"Mean return of 100 more episodes: {mean:.1f} ± {std:.1f}")
assert until_solved.best_mean_reward >= 490 and mean > 400, mean
