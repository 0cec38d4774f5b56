"""
What was collected: the view of a rollout that baselines see, and the masks and counts behind it.

Arrays are of shape ``(n_steps, n_envs)``; ``dones[t]`` is True where the step at t is the last of its episode.
"""

from dataclasses import dataclass

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.estimation.returns import Bools, Integers


@dataclass(frozen=True)
class Rollout:
    """
    What a baseline may look at: a rollout with its returns. Every tensor begins with ``(n_steps, n_envs)``.

    Observations and actions are on the policy's device, all else on the CPU.

    :param observations: s_t, a tensor or a dict of tensors
    :param actions: a_t as the policy drew them, shape ``(n_steps, n_envs, action_dim)``
    :param rewards: r_t, float64
    :param dones: Whether the step is the last of its episode (terminated or truncated), bool
    :param timesteps: t within the episode, int64
    :param used: Whether the step enters the gradient (m_t), bool
    :param returns: G_t, float64
    :param discounts: The factor of the score besides G_t − b_t: γ^t with ``discount_scores``, else 1; float64
    :param values: V(s_t) by the critic before this rollout trained it, float64; None without ``baseline="value"``
    :param policy: The policy that acted, with the parameters with which it acted
    """

    observations: PyTorchObs
    actions: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor
    timesteps: th.Tensor
    used: th.Tensor
    returns: th.Tensor
    discounts: th.Tensor
    values: th.Tensor | None
    policy: ActorCriticPolicy
    denominator: int = 1

    @property
    def episodes(self) -> th.Tensor:
        """The number of the episode that each step belongs to, from 0 on, shape ``(n_steps, n_envs)``, int64."""
        ended_before = self.dones.long().cumsum(0) - self.dones.long()
        n_episodes = ended_before[-1] + 1
        return ended_before + n_episodes.cumsum(0) - n_episodes


@dataclass(frozen=True)
class Extent:
    """
    When a rollout is complete: after a number of steps, or when each environment has finished its quota of episodes.

    :param n_steps: Steps per environment, infinite for whole episodes
    :param quota: Episodes per environment, shape ``(n_envs,)``; for a number of steps, as many as can end in it
    :param max_episode_steps: Steps after which an episode that is waited for counts as one that never ends
    """

    n_steps: float
    quota: Integers
    max_episode_steps: float

    @classmethod
    def fixed(cls, n_steps: int, n_envs: int) -> "Extent":
        """
        The same number of steps in every environment.

        :param n_steps: Steps per environment
        :param n_envs: Number of environments
        """
        return cls(n_steps, np.full(n_envs, n_steps), np.inf)

    @classmethod
    def whole_episodes(cls, n_episodes: int, n_envs: int, max_episode_steps: int) -> "Extent":
        """
        A number of episodes per environment, fixed beforehand: "the first to finish" would favour short episodes.

        :param n_episodes: Episodes of all environments together; the quotas differ by at most 1
        :param n_envs: Number of environments
        :param max_episode_steps: Steps after which an episode counts as one that never ends
        """
        quota = n_episodes // n_envs + (np.arange(n_envs) < n_episodes % n_envs)
        return cls(np.inf, quota, max_episode_steps)


def within_quota(dones: Bools, quota: Integers) -> Bools:
    """
    Which steps belong to the first ``quota`` episodes of their environment.

    :param dones: Shape ``(n_steps, n_envs)``
    :param quota: Shape ``(n_envs,)``
    :return: Shape ``(n_steps, n_envs)``
    """
    return dones.cumsum(axis=0) - dones < quota


def in_finished_episode(dones: Bools) -> Bools:
    """
    Which steps belong to an episode that ends within the rollout.

    :param dones: Shape ``(n_steps, n_envs)``
    :return: Shape ``(n_steps, n_envs)``
    """
    return np.logical_or.accumulate(dones[::-1], axis=0)[::-1]


def timesteps_of(dones: Bools, first: Integers) -> Integers:
    """
    t within the episode of each step: the row, less the row where the episode began.

    :param dones: Shape ``(n_steps, n_envs)``
    :param first: Timestep of the first row, where the episode may have begun in an earlier rollout, shape ``(n_envs,)``
    :return: Shape ``(n_steps, n_envs)``
    """
    rows = np.arange(len(dones))[:, None]
    begins = np.vstack([-first, np.where(dones, rows + 1, -first)[:-1]])
    return rows - np.maximum.accumulate(begins, axis=0)
