# %% [markdown]
# # What does one update do?
#
# One state and two actions: Left earns −1, Right earns 5. The policy has a single parameter, $\pi_\theta(\text{Right})
# = \sigma(\theta) = 1 / (1 + e^{-\theta})$. One update from three episodes fits on a page.

# %%
from dataclasses import replace

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import sample
from sb3_reinforce.estimation import gradients_by_episode, leave_one_out, mean

seed = 0
th.set_num_threads(1)
th.manual_seed(seed)

# %% [markdown]
# ## By hand
#
# The score of an action is $\nabla_\theta \log \pi_\theta(a)$: here $1 - \pi(\text{Right})$ for Right and
# $-\pi(\text{Right})$ for Left. At $\theta = 0$ three episodes go Right, Left, Right. REINFORCE averages return times
# score and takes a step of rate 0.1.

# %%
p = 0.5
scores = np.array([1 - p, -p, 1 - p])
returns = np.array([5, -1, 5])
gradient = (returns * scores).mean()
theta = 0 + 0.1 * gradient
print(f"gradient {gradient:.2f}, θ: 0 → {theta:.3f}, π(Right): 0.5 → {1 / (1 + np.exp(-theta)):.3f}")
assert round(gradient, 2) == 1.83 and round(theta, 3) == 0.183

# %% [markdown]
# The exact gradient of $U = 5 \sigma(\theta) - (1 - \sigma(\theta))$ at 0 is $6 / 4 = 1.5$. The rest is sampling noise.
#
# Programs do not write scores down. They differentiate the surrogate loss
# $L = -\frac{1}{N} \sum_i R_i \log \pi_\theta(a_i)$, in which actions and returns are fixed numbers. Its gradient is
# $-\hat g$. Its value means nothing: a smaller loss is not a better policy.

# %%
logit = th.zeros((), dtype=th.float64, requires_grad=True)
log_probs = th.nn.functional.logsigmoid(th.stack([logit, -logit, logit]))
(-(th.as_tensor(returns) * log_probs).mean()).backward()
print(f"by automatic differentiation {-logit.grad.item():.2f}")
assert abs(-logit.grad.item() - gradient) < 1e-9

# %% [markdown]
# ## By the package
#
# The same problem as an environment, with a policy that is linear in an observation that is always 1. Its parameters
# are a weight and a bias for the logit of each action. `sample` plays three episodes, in which the actions and returns
# above replace those that were drawn. `gradients_by_episode` returns $\sum_t w_t \nabla \log \pi(a_t \mid s_t)$ of each
# episode, in one array for each choice of the weights $w$: here one. Its mean for the weight of Right is the gradient
# above.


# %%
class OneStep(gym.Env):
    """Each action has its reward, and then the episode is over."""

    observation_space = spaces.Box(1, 1, (1,))

    def __init__(self, *rewards):
        self.rewards = rewards
        self.action_space = spaces.Discrete(len(rewards))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, dtype=np.float32), {}

    def step(self, action):
        return np.ones(1, dtype=np.float32), self.rewards[action], True, False, {}


def make_model(*rewards):
    """A uniform policy, and stochastic gradient ascent."""
    policy_kwargs = {"net_arch": [], "optimizer_class": th.optim.SGD}
    arguments = {"baseline": "none", "n_episodes": 3, "learning_rate": 0.1, "max_grad_norm": None}
    model = REINFORCE("MlpPolicy", OneStep(*rewards), policy_kwargs=policy_kwargs, device="cpu", seed=seed, **arguments)
    for parameter in model.policy.action_net.parameters():
        th.nn.init.zeros_(parameter)
    return model


model = make_model(-1.0, 5.0)
rollout = replace(
    sample(model, 3),
    actions=th.tensor([1.0, 0.0, 1.0]).reshape(3, 1, 1),
    returns=th.tensor([[5.0], [-1.0], [5.0]], dtype=th.float64),
)
(by_episode,) = gradients_by_episode(rollout, rollout.returns)
print("gradient of the weights of Left and Right:", by_episode.mean(0)[:2].tolist())
assert abs(by_episode.mean(0)[1] - gradient) < 1e-6

# %% [markdown]
# `learn(1)` trains for at least one step, which is one update here. It draws its own three episodes, and moves the
# weight by 0.1 times their gradient. The bias of Right moves as far, and both parameters of Left as far in the opposite
# direction. The difference of the logits, which is the $\theta$ from above, changes by four times as much.

# %%
model.learn(1)
is_right = model.rollout.actions.flatten()
expected = 0.1 * (model.rollout.returns.flatten() * (is_right - 0.5)).mean()
print(f"drawn {is_right.int().tolist()}, weight of Right: 0 → {model.policy.action_net.weight[1].item():.3f}")
assert abs(model.policy.action_net.weight[1].item() - expected) < 1e-6

# %% [markdown]
# ## The score has mean zero
#
# $E_{a \sim \pi}[\nabla \log \pi(a)] = 0$ for every differentiable policy whose set of possible actions does not depend
# on $\theta$. So a constant that is subtracted from all returns leaves the expected gradient alone. For a softmax the
# score of the logits is $1(a' = a) - \pi(a')$, and its mean can be computed exactly. For a Gaussian the score of $\mu$
# is $(a - \mu) / \sigma^2$, and the mean of 100,000 samples is zero up to its standard error.

# %%
probabilities = th.softmax(th.randn(4), dim=0)
softmax_scores = th.eye(4) - probabilities
gaussian_scores = (th.normal(0.7, 1.5, (100_000,)) - 0.7) / 1.5**2
standard_error = gaussian_scores.std() / 100_000**0.5
print("softmax: ", (probabilities @ softmax_scores).abs().max().item())
print(f"Gaussian: {gaussian_scores.mean():.4f}, standard error {standard_error:.4f}")
assert (probabilities @ softmax_scores).abs().max() < 1e-6 and gaussian_scores.mean().abs() < 4.5 * standard_error

# %% [markdown]
# ## When all returns are positive
#
# Three actions with returns 8, 10 and 12, each taken once. (Only the returns of the sampled rollout are replaced, since
# these baselines do not read the actions.) Without a baseline each episode pushes its action up, only by different
# amounts. With the mean of the batch the action with the average return is left alone. The mean contains the return
# that it is subtracted from, which scales the expected gradient by $(N - 1) / N$; the mean of the *other* episodes does
# not.

# %%
rollout = replace(sample(make_model(8.0, 10.0, 12.0), 3), returns=th.tensor([[8.0], [10.0], [12.0]], dtype=th.float64))
print("no baseline:  ", rollout.returns.flatten().tolist())
print("mean:         ", (rollout.returns - mean(rollout)).flatten().tolist())
print("leave one out:", (rollout.returns - leave_one_out(rollout)).flatten().tolist())
assert (rollout.returns - mean(rollout)).flatten().tolist() == [-2, 0, 2]
assert (rollout.returns - leave_one_out(rollout)).flatten().tolist() == [-3, 0, 3]

# %% [markdown]
# Without a baseline and with the constant baseline 10, the gradient has the same mean. But if every episode pushes its
# action up, most of the gradient is sampling noise. Over the three equally likely episodes the variance can be computed
# exactly:

# %%
scores = np.eye(3) - 1 / 3
returns = np.array([8.0, 10.0, 12.0])
none, centered = ((returns - baseline)[:, None] * scores for baseline in (0.0, 10.0))
for name, gradients in (("no baseline", none), ("baseline 10", centered)):
    print(f"{name}: mean {gradients.mean(0).round(3)}, variance {gradients.var(0).sum():.2f}")
assert np.allclose(none.mean(0), centered.mean(0)) and none.var(0).sum() > 70 * centered.var(0).sum()

# %% [markdown]
# ## The whole algorithm
#
# Several states change little: the scores of all steps of an episode are weighted, each by the sum of the rewards that
# follow it (page 5 says why). This is REINFORCE in PyTorch, on CartPole with a linear policy and without a baseline.


# %%
def play(env, policy):
    """The log π and the reward of each step of an episode."""
    log_probs, rewards = [], []
    obs, _ = env.reset()
    is_over = False
    while not is_over:
        pi = th.distributions.Categorical(logits=policy(th.as_tensor(obs)))
        action = pi.sample()
        obs, reward, terminated, truncated, _ = env.step(action.item())
        log_probs.append(pi.log_prob(action))
        rewards.append(reward)
        is_over = terminated or truncated
    return th.stack(log_probs), th.tensor(rewards)


env, policy = gym.make("CartPole-v1"), th.nn.Linear(4, 2)
env.reset(seed=seed)
optimizer = th.optim.Adam(policy.parameters(), lr=0.1)
means = []
for _ in range(10):
    episodes = [play(env, policy) for _ in range(16)]
    # The reward-to-go is a cumulative sum from the end
    terms = [(log_probs * rewards.flip(0).cumsum(0).flip(0)).sum() for log_probs, rewards in episodes]
    loss = -th.stack(terms).sum() / 16
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    means.append(sum(len(rewards) for _, rewards in episodes) / 16)
print("mean returns of ten rollouts:", [round(each) for each in means])
assert means[-1] > 1.5 * means[0]
