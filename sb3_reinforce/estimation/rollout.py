"""What was collected: the rollout that baselines read, and which of its steps belong to which episode."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import select
from sb3_reinforce.estimation.returns import Bools, Floats, Integers
from sb3_reinforce.policies.sequences import RecurrentPolicy, episode_numbers, rows_of


@dataclass(frozen=True)
class Rollout:
    """
    A rollout with its returns, as a baseline sees it.

    The shape of every tensor but ``state`` starts with ``(n_steps, n_envs)``. Observations, actions and ``state`` are
    on the policy's device, all else on the CPU.

    :param observations: s_t, a tensor or a dict of tensors
    :param actions: a_t as the policy drew them, shape ``(n_steps, n_envs, action_dim)``
    :param rewards: r_t, float64
    :param dones: Whether the step is the last of its episode (terminated or truncated), bool
    :param timesteps: t within the episode, int64
    :param used: Whether the step enters the gradient (m_t), bool
    :param returns: G_t, float64; known only where ``used``; elsewhere the sum is not complete
    :param discounts: The factor of the score besides G_t − b_t: γ^t with ``discount_scores`` and
        ``reward_to_go``, else 1; float64
    :param values: V(s_t) by the critic before this rollout trained it, float64; None without ``baseline="value"``
    :param policy: The policy that acted; its parameters are those of the rollout until ``train`` changes them
    :param denominator: What the sum over all steps is divided by
    :param next_values: V(s_{t+1}), which is 0 after a terminal state, float64; None without ``baseline="value"``
    :param state: The state of a recurrent policy before the first step, shape
        ``(n_envs, 2, 2, n_layers, n_hidden)`` for actor and critic, hidden and cell state; None if all start from zero
    :param episodes_per_start: The number of neighboring environments whose episodes start alike; 1 if all differ
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
    denominator: int
    next_values: th.Tensor | None = None
    state: th.Tensor | None = None
    episodes_per_start: int = 1

    @cached_property
    def episodes(self) -> th.Tensor:
        """The number of the episode that each step belongs to, from 0 on, shape ``(n_steps, n_envs)``, int64."""
        return episode_numbers(self.dones)

    @property
    def used_episodes(self) -> th.Tensor:
        """The numbers of the m episodes with used steps, ascending, shape ``(m,)``, int64."""
        numbers: th.Tensor = th.unique(self.episodes[self.used])
        return numbers

    @property
    def groups(self) -> th.Tensor:
        """
        The number of the group whose returns are compared, shape ``(n_steps, n_envs)``, int64.

        The number of the start, or 0 for all where each episode has a start to itself.
        """
        n_steps, n_envs = self.dones.shape
        size = n_envs if self.episodes_per_start == 1 else self.episodes_per_start
        return (th.arange(n_envs) // size).expand(n_steps, n_envs)

    @property
    def inputs(self) -> Any:
        """What the policy is evaluated on: the observations, with their sequences and states if it is recurrent."""
        if isinstance(self.policy, RecurrentPolicy):
            return rows_of(self.observations, self.dones.to(self.actions.device), self.state)
        return self.observations


def used_inputs(rollout: Rollout) -> tuple[Any, th.Tensor]:
    """The policy's inputs and the actions of the n used steps, each flattened to ``(n, ...)``."""
    actions = as_policy_actions(select(rollout.actions, rollout.used), rollout.policy.action_space)
    return select(rollout.inputs, rollout.used), actions


@dataclass(frozen=True)
class Running:
    """
    The episodes that run when a rollout starts: t of their next step and ``Σ_{k<t} γ^k r_k``, both ``(n_envs,)``.
    """

    timesteps: Integers
    rewards: Floats

    @classmethod
    def none(cls, n_envs: int) -> "Running":
        """Every environment is at the start of an episode."""
        return cls(np.zeros(n_envs, dtype=int), np.zeros(n_envs))

    def restarted(self, where: Bools) -> "Running":
        """Start new episodes ``where`` it is True; where environments were added, it must be True."""
        timesteps = np.resize(self.timesteps, len(where))
        rewards = np.resize(self.rewards, len(where))
        return Running(np.where(where, 0, timesteps), np.where(where, 0.0, rewards))

    def after(self, rewards: Floats, dones: Bools, gamma: float) -> "Running":
        """The episodes that run when a rollout of shape ``(n_steps, n_envs)`` has ended."""
        timesteps = timesteps_of(dones, self.timesteps)
        runs_on = ~in_finished_episode(dones)
        # Σ_{k<t} γ^k r_k of the episode that runs on, with what it had earned before the rollout
        earned = runs_on[0] * self.rewards + (runs_on * gamma**timesteps * rewards).sum(axis=0)
        return Running(np.where(dones[-1], 0, timesteps[-1] + 1), earned)


def within_quota(dones: Bools, quota: Integers) -> Bools:
    """Which steps, ``(n_steps, n_envs)``, belong to the first ``quota`` episodes of their environment."""
    return dones.cumsum(axis=0) - dones < quota


def in_finished_episode(dones: Bools) -> Bools:
    """Which steps, ``(n_steps, n_envs)``, belong to an episode that ends within the rollout."""
    return np.logical_or.accumulate(dones[::-1], axis=0)[::-1]


def timesteps_of(dones: Bools, first: Integers) -> Integers:
    """t ``(n_steps, n_envs)``: the row minus the row of the episode's start, ``−first`` if before the rollout."""
    rows = np.arange(len(dones))[:, None]
    starts = np.vstack([-first, np.where(dones, rows + 1, -first)[:-1]])
    return rows - np.maximum.accumulate(starts, axis=0)
