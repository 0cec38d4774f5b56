"""
Returns of a rollout, as pure functions of NumPy arrays of shape ``(n_steps, n_envs)``.

Time is the first axis. ``dones[t]`` is True where step t is the last of its episode; episodes may start before the
rollout and continue after it. ``next_values[t]`` is V(s_{t+1}): 0 after a terminal state, and 0 everywhere without a
critic.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.floating]
Bools: TypeAlias = NDArray[np.bool_]
Integers: TypeAlias = NDArray[np.integer]


def discounted_sum(x: Floats, discounts: Floats) -> Floats:
    """
    ``y_t = x_t + discounts_t · y_{t+1}``, with ``y_{n_steps} = 0``.

    Computed in log2(n_steps) passes over the whole array (Hillis and Steele, 1986, "Data parallel algorithms"): each
    pass doubles the number of terms in y_t.

    :param x: Shape ``(n_steps, n_envs)``
    :param discounts: Shape ``(n_steps, n_envs)``; a 0 at t removes all later terms from y_t
    :return: Shape ``(n_steps, n_envs)``, float64
    """
    y = x.astype(np.float64)
    discounts = discounts.astype(np.float64)
    reach = 1
    while reach < len(y):
        y[:-reach] += discounts[:-reach] * y[reach:]
        discounts[:-reach] *= discounts[reach:]
        reach *= 2
    return y


def lambda_return(
    rewards: Floats, dones: Bools, next_values: Floats | float, gamma: float, gae_lambda: float
) -> Floats:
    """
    ``G_t = r_t + γ [(1 − λ) V(s_{t+1}) + λ G_{t+1}]``, and ``G_t = r_t + γ V(s_{t+1})`` at the last step of an episode
    or of the rollout.

    Source: Sutton and Barto (2018), equation 12.9 in recursive form. G_t − V(s_t) is the generalized advantage estimate
    (Schulman et al., 2016, equation 16).

    :param rewards: Shape ``(n_steps, n_envs)``
    :param dones: Whether each step is the last of its episode, shape ``(n_steps, n_envs)``
    :param next_values: V(s_{t+1}), 0 after a terminal state, shape ``(n_steps, n_envs)``, or one number for all
    :param gamma: Discount factor γ
    :param gae_lambda: λ: 1 is the Monte Carlo return, 0 the one-step return
    :return: Shape ``(n_steps, n_envs)``, float64
    """
    continues = ~np.asarray(dones, dtype=bool)
    continues[-1] = False
    # G_t = r_t + γ (1 − λ c_t) V(s_{t+1}) + γ λ c_t G_{t+1}, with c_t = 1 where the episode goes on in the rollout
    return discounted_sum(rewards + gamma * (1 - gae_lambda * continues) * next_values, gamma * gae_lambda * continues)


def reward_to_go(rewards: Floats, dones: Bools, gamma: float) -> Floats:
    """
    ``G_t = Σ_{k≥t} γ^{k−t} r_k`` over the rest of the episode, or of the rollout.

    It is the λ-return with λ = 1 and without a critic. Source: Sutton and Barto (2018), equation 3.11.

    :param rewards: Shape ``(n_steps, n_envs)``
    :param dones: Whether each step is the last of its episode, shape ``(n_steps, n_envs)``
    :param gamma: Discount factor γ
    :return: Shape ``(n_steps, n_envs)``, float64
    """
    return lambda_return(rewards, dones, 0.0, gamma, gae_lambda=1.0)


def total_return(reward_to_go: Floats, timesteps: Integers, gamma: float, earlier_rewards: Floats) -> Floats:
    """
    ``G_0 = Σ_{k<t} γ^k r_k + γ^t G_t``, the same at every step of an episode (Williams, 1992, for γ = 1).

    Evaluated at the episode's first step in the rollout, where the sum over k < t was earned in earlier rollouts.

    :param reward_to_go: G_t, shape ``(n_steps, n_envs)``
    :param timesteps: t within the episode, shape ``(n_steps, n_envs)``
    :param gamma: Discount factor γ
    :param earlier_rewards: Discounted rewards of the running episode before the rollout, shape ``(n_envs,)``
    :return: Shape ``(n_steps, n_envs)``, float64
    """
    steps = np.arange(len(timesteps))[:, None]
    from_start = gamma**timesteps * reward_to_go
    from_start[0] += earlier_rewards
    # G_0 stands in the row of the episode's first step in the rollout
    return np.take_along_axis(from_start, np.maximum(steps - timesteps, 0), axis=0)
