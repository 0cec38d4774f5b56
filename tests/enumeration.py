"""
The expected gradient by exact enumeration: the sum over all batches of N episodes of their probability times ĝ.

The policy is a softmax over a table, in float64; weights and denominators are the package's. ∇E[G_0] comes from
autograd through the probabilities of the trajectories.
"""

from functools import partial
from itertools import product

import numpy as np
import torch as th
from environments import Tree
from models import Double, float64
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_reinforce import REINFORCE
from sb3_reinforce.estimation import BASELINES
from sb3_reinforce.estimation.rollout import Running
from sb3_reinforce.estimation.weights import complete_rollout
from sb3_reinforce.policies.critic import rollout_values

GAMMA = 0.5
ARGUMENTS = ("gamma", "gae_lambda", "reward_to_go", "discount_scores", "normalize_by", "episodes_per_start")
LOGITS = th.tensor([[0.3, -0.4], [-0.7, 0.2], [0.5, 0.1]], dtype=th.float64)


def make_model(ragged=False, env=None, **kwargs):
    arguments = {"gamma": GAMMA, "n_episodes": 2, "normalize_by": "episodes", "discount_scores": True, **kwargs}
    policy_kwargs = {"net_arch": [], "features_extractor_class": Double}
    with float64():
        env = env or Tree(ragged)
        model = REINFORCE("MlpPolicy", env, policy_kwargs=policy_kwargs, device="cpu", **arguments)
    with th.no_grad():
        model.policy.action_net.weight.copy_(LOGITS.T)
        model.policy.action_net.bias.zero_()
    model.policy.action_net.bias.requires_grad_(False)
    return model


def log_prob_of(trajectory, logits=LOGITS):
    return th.stack([logits[node].log_softmax(0)[action] for node, action, _ in trajectory]).sum()


def score(*step):
    logits = LOGITS.clone().requires_grad_()
    return th.autograd.grad(log_prob_of([step], logits), logits)[0]


def true_gradient(trajectories, utility):
    """∇ Σ p(τ) utility(τ)."""
    logits = LOGITS.clone().requires_grad_()
    expected = sum(log_prob_of(trajectory, logits).exp() * utility(trajectory) for trajectory in trajectories)
    return th.autograd.grad(expected, logits)[0]


def discounted_return(trajectory, begin=0):
    return sum(GAMMA**k * reward for k, (_, _, reward) in enumerate(trajectory[begin:]))


def fill(model, batch):
    """A buffer of one episode per environment; what follows an episode has absurd rewards and must not be used."""
    n_steps, n_envs = max(map(len, batch)), len(batch)
    buffer = RolloutBuffer(n_steps, model.observation_space, model.action_space, "cpu", n_envs=n_envs)
    buffer.rewards += 1e6
    dones = np.zeros((n_steps, n_envs), dtype=bool)
    for i, trajectory in enumerate(batch):
        for t, (node, action, reward) in enumerate(trajectory):
            buffer.observations[t, i], buffer.actions[t, i], buffer.rewards[t, i] = Tree.observe(node), action, reward
        dones[len(trajectory) - 1, i] = True
    return buffer, dones


def complete(model, buffer, dones, next_values=None):
    """What the package makes of episodes that begin with the rollout: the rollout, advantages and returns."""
    n_envs = dones.shape[1]
    return complete_rollout(
        buffer,
        model.policy,
        dones,
        np.ones(n_envs, dtype=int),
        Running.none(n_envs),
        next_values,
        baseline=BASELINES.get(str(model.baseline), model.baseline),
        **{name: getattr(model, name) for name in ARGUMENTS},
    )


def rollout_of(model, batch):
    """A batch of episodes with returns, masks and denominator, and the baseline."""
    buffer, dones = fill(model, batch)
    next_values = None
    if model.has_critic:
        last_obs = buffer.observations[-1]
        buffer.values, next_values = rollout_values(model.policy, False, buffer, dones, last_obs, {})
    rollout, *_ = complete(model, buffer, dones, next_values)
    return rollout, BASELINES.get(str(model.baseline), model.baseline)(rollout)


def estimate(model, batch):
    """ĝ of a batch of episodes: the package's weights and denominator, the scores of the table."""
    rollout, baseline = rollout_of(model, batch)
    weights = rollout.discounts * (rollout.returns - baseline) * rollout.used
    terms = [weights[t, i] * score(*step) for i, episode in enumerate(batch) for t, step in enumerate(episode)]
    return sum(terms) / rollout.denominator


def expectation(statistic, episodes, log_probs, n_episodes):
    """Σ over all batches of N episodes of p(batch) · statistic(batch)."""
    total = 0.0
    for batch in product(range(len(episodes)), repeat=n_episodes):
        p = th.stack([log_probs[i] for i in batch]).sum().exp().detach()
        total = total + p * statistic([episodes[i] for i in batch])
    return total


def trajectories_of(model):
    return model.env.envs[0].unwrapped.trajectories()


def expected_gradient(model, n_episodes=2, statistic=estimate):
    trajectories = trajectories_of(model)
    log_probs = [log_prob_of(trajectory) for trajectory in trajectories]
    return expectation(partial(statistic, model), trajectories, log_probs, n_episodes)


def gradient_of_return(model):
    return true_gradient(trajectories_of(model), discounted_return)


def assert_equal(gradient, expected):
    th.testing.assert_close(gradient, expected, rtol=0, atol=1e-10)


def episode_terms(trajectory, reward_to_go):
    """A and S of an episode: Σ_t γ^t score_t G_t and Σ_t γ^t score_t, or Σ_t score_t G_0 and Σ_t score_t."""
    discounts = [GAMMA ** (t * reward_to_go) for t in range(len(trajectory))]
    returns = [discounted_return(trajectory, t * reward_to_go) for t in range(len(trajectory))]
    scores = [score(*step).flatten() for step in trajectory]
    weighted = [d * g * s for d, g, s in zip(discounts, returns, scores, strict=True)]
    return sum(weighted), sum(d * s for d, s in zip(discounts, scores, strict=True))
