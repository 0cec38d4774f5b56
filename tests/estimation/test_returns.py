"""Returns against their definitions and against Stable-Baselines3's rollout buffer."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_reinforce.estimation import discounted_sum, lambda_return, reward_to_go, total_return
from sb3_reinforce.estimation.rollout import timesteps_of

N_STEPS, N_ENVS = 37, 3


def test_rewards_to_go_by_hand():
    rewards, dones = np.array([[1.0, 3.0, 2.0]]).T, np.array([[False, False, True]]).T
    assert reward_to_go(rewards, dones, gamma=1.0)[:, 0].tolist() == [6, 5, 2]


@pytest.fixture
def rollout():
    rng = np.random.default_rng(0)
    rewards, values, next_values = rng.normal(size=(3, N_STEPS, N_ENVS))
    return rewards, rng.random((N_STEPS, N_ENVS)) < 0.2, values, next_values


def double_sum(rewards, dones, gamma, bootstrap):
    """The return from its definition, one reward at a time."""
    result = np.zeros_like(rewards)
    for t, env in np.ndindex(*rewards.shape):
        for k in range(t, len(rewards)):
            result[t, env] += gamma ** (k - t) * rewards[k, env]
            if dones[k, env] or k == len(rewards) - 1:
                result[t, env] += gamma ** (k - t + 1) * bootstrap[k, env]
                break
    return result


@pytest.mark.parametrize("n_steps", [1, 2, 3, 8, 37])
def test_discounted_sum_is_the_recursion(n_steps):
    x, discounts = np.random.default_rng(n_steps).random((2, n_steps, 2))
    expected = np.zeros((n_steps + 1, 2))
    for t in reversed(range(n_steps)):
        expected[t] = x[t] + discounts[t] * expected[t + 1]
    np.testing.assert_allclose(discounted_sum(x, discounts), expected[:-1], rtol=1e-12)


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
def test_reward_to_go_and_lambda_return_at_one_are_the_double_sum(rollout, gamma):
    rewards, dones, _, next_values = rollout
    expected = double_sum(rewards, dones, gamma, next_values)
    np.testing.assert_allclose(lambda_return(rewards, dones, next_values, gamma, 1.0), expected, atol=1e-12)
    expected = double_sum(rewards, dones, gamma, np.zeros_like(rewards))
    for kind in (bool, int, np.float32):
        np.testing.assert_allclose(reward_to_go(rewards, dones.astype(kind), gamma), expected, atol=1e-12)


@pytest.mark.parametrize("gae_lambda", [0.0, 0.9, 1.0])
def test_generalized_advantage_is_sb3s(rollout, gae_lambda):
    rewards, dones, values, next_values = rollout
    buffer = RolloutBuffer(N_STEPS, spaces.Box(-1, 1), spaces.Discrete(2), "cpu", gae_lambda, 0.97, N_ENVS)
    buffer.rewards, buffer.values = rewards, values
    buffer.episode_starts = np.vstack([np.ones(N_ENVS), dones[:-1]])
    buffer.compute_returns_and_advantage(th.as_tensor(next_values[-1]), dones[-1])
    following = np.where(dones, 0.0, np.vstack([values[1:], next_values[-1]]))
    ours = lambda_return(rewards, dones, following, 0.97, gae_lambda)
    np.testing.assert_allclose(ours - values, buffer.advantages, atol=1e-5)
    np.testing.assert_allclose(ours, buffer.returns, atol=1e-5)


@pytest.mark.parametrize("gamma", [0.0, 0.5, 1.0])
def test_total_return_is_the_reward_to_go_of_the_first_step(rollout, gamma):
    """Also if the episode began before the rollout: two halves give the total returns of the whole."""
    rewards, dones, *_ = rollout
    dones[-1] = True
    timesteps = timesteps_of(dones, np.zeros(N_ENVS, dtype=int))
    to_go = double_sum(rewards, dones, gamma, np.zeros_like(rewards))
    expected = np.array([[to_go[t - timesteps[t, i], i] for i in range(N_ENVS)] for t in range(N_STEPS)])
    ours = total_return(reward_to_go(rewards, dones, gamma), timesteps, gamma, np.zeros(N_ENVS))
    np.testing.assert_allclose(ours, expected, atol=1e-12)

    earlier = [
        [gamma**k * rewards[10 - timesteps[10, i] + k, i] for k in range(timesteps[10, i])] for i in range(N_ENVS)
    ]
    second_half = total_return(
        reward_to_go(rewards[10:], dones[10:], gamma), timesteps[10:], gamma, np.array([sum(part) for part in earlier])
    )
    np.testing.assert_allclose(second_half, expected[10:], atol=1e-12)


def test_returns_and_timesteps_of_a_grid_drawn_by_hand():
    """Two environments, five steps; the first one's episode began one step before the rollout."""
    rewards = np.array([[1, 1], [2, 10], [4, 100], [8, 1000], [16, 10000]], dtype=float)
    dones = np.array([[0, 0], [1, 0], [0, 0], [1, 1], [0, 0]], dtype=bool)
    assert timesteps_of(dones, np.array([1, 0])).tolist() == [[1, 0], [2, 1], [0, 2], [1, 3], [0, 0]]
    to_go = reward_to_go(rewards, dones, 1.0)
    assert to_go.tolist() == [[3, 1111], [2, 1110], [12, 1100], [8, 1000], [16, 10000]]
    total = total_return(to_go, timesteps_of(dones, np.array([1, 0])), 1.0, np.array([32, 0]))
    assert total.tolist() == [[35, 1111], [35, 1111], [12, 1111], [12, 1111], [16, 10000]]
