"""From what was collected to the weights G_t − b_t of the scores."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import select
from sb3_reinforce.estimation import baselines
from sb3_reinforce.estimation.baselines import Baseline
from sb3_reinforce.estimation.returns import Bools, Floats, Integers, lambda_return, reward_to_go, total_return
from sb3_reinforce.estimation.rollout import Extent, Rollout, in_finished_episode, timesteps_of, within_quota
from sb3_reinforce.policies.critic import values_after, values_of
from sb3_reinforce.sampling.collection import Ends, by_step


@dataclass(frozen=True)
class Running:
    """
    The episodes that run when a rollout begins.

    :param timesteps: t of their next step, shape ``(n_envs,)``
    :param rewards: ``Σ_{k<t} γ^k r_k``, what they have earned so far, shape ``(n_envs,)``
    """

    timesteps: Integers
    rewards: Floats

    @classmethod
    def none(cls, n_envs: int) -> "Running":
        """
        Every environment is at the start of an episode.

        :param n_envs: Number of environments
        """
        return cls(np.zeros(n_envs, dtype=int), np.zeros(n_envs))

    def after(self, rewards: Floats, dones: Bools, gamma: float) -> "Running":
        """
        The episodes that run when the rollout has ended.

        :param rewards: Shape ``(n_steps, n_envs)``
        :param dones: Shape ``(n_steps, n_envs)``
        :param gamma: Discount factor γ
        """
        timesteps = timesteps_of(dones, self.timesteps)
        earned = total_return(reward_to_go(rewards, dones, gamma), timesteps, gamma, self.rewards)
        return Running(np.where(dones[-1], 0, timesteps[-1] + 1), np.where(dones[-1], 0.0, earned[-1]))


@dataclass(frozen=True)
class Weighing:
    """
    What weighs a score: the arguments of REINFORCE of the same names.

    :param baseline: b_t
    :param gamma: Discount factor γ
    :param gae_lambda: λ of the return
    :param reward_to_go: Whether the return is that from t on, or the total one
    :param discount_scores: Whether the score of step t takes the factor γ^t
    """

    baseline: Baseline
    gamma: float
    gae_lambda: float
    reward_to_go: bool
    discount_scores: bool

    @property
    def has_critic(self) -> bool:
        """Whether V is needed: then it also tells what a cut episode is worth."""
        return self.baseline is baselines.value


def weigh(
    policy: ActorCriticPolicy,
    buffer: RolloutBuffer,
    ends: Ends,
    last_obs: Any,
    extent: Extent,
    running: Running,
    weighing: Weighing,
) -> Rollout:
    """
    Compute G_t and G_t − b_t of a collected rollout, and complete the rollout buffer with them.

    :param policy: The policy that acted
    :param buffer: The rollout buffer: gets ``values``, ``advantages`` (G_t − b_t) and ``returns`` (what a critic is
        fitted to, without one G_t); the latter two are 0 at steps that are not used
    :param ends: How the episodes ended
    :param last_obs: The observations after the last step
    :param extent: What was to be collected
    :param running: The episodes that ran when the rollout began
    :param weighing: How to weigh
    :return: The rollout, as baselines see it
    :raises ValueError: If no step can be used, or the baseline is not as it must be
    """
    rewards, dones, gamma = buffer.rewards, ends.dones, weighing.gamma
    timesteps = timesteps_of(dones, running.timesteps)
    used = within_quota(dones, extent.quota) & (weighing.has_critic | in_finished_episode(dones))
    check_used(used, extent)
    next_values: Floats | float = 0.0
    if weighing.has_critic:
        buffer.values = values_of(policy, buffer)
        next_values = values_after(policy, buffer.values, last_obs, ends)
    returns_to_go = lambda_return(rewards, dones, next_values, gamma, weighing.gae_lambda)
    returns = returns_to_go
    if not weighing.reward_to_go:
        returns = total_return(returns_to_go, timesteps, gamma, running.rewards)
    rollout = Rollout(
        observations=obs_as_tensor(buffer.observations, policy.device),
        actions=th.as_tensor(buffer.actions, device=policy.device),
        rewards=th.as_tensor(rewards).double(),
        dones=th.as_tensor(dones),
        timesteps=th.as_tensor(timesteps),
        used=th.as_tensor(used),
        returns=th.tensor(returns),
        discounts=th.as_tensor(gamma ** (timesteps * (weighing.discount_scores and weighing.reward_to_go))),
        values=th.as_tensor(buffer.values).double() if weighing.has_critic else None,
        policy=policy,
    )
    baseline = check_baseline(weighing.baseline(rollout), rollout)
    buffer.advantages = ((returns - baseline) * used).astype(np.float32)
    buffer.returns = ((returns_to_go if weighing.has_critic else returns) * used).astype(np.float32)
    return rollout


@dataclass(frozen=True)
class Steps:
    """
    The ``n`` used steps of a rollout in a row, as training needs them.

    :param observations: s_t, a tensor of shape ``(n, ...)`` or a dict of such tensors
    :param actions: a_t as ``evaluate_actions`` takes them
    :param weights: What each score is multiplied by: γ^t (G_t − b_t), normalized if asked for; float32
    :param returns: What the critic is fitted to, float32
    :param values: V(s_t) before the critic is fitted, float64 on the CPU; None without a critic
    """

    observations: PyTorchObs
    actions: th.Tensor
    weights: th.Tensor
    returns: th.Tensor
    values: th.Tensor | None


def used_steps(rollout: Rollout, buffer: RolloutBuffer, normalize: bool) -> Steps:
    """
    Take the used steps, with the advantages and returns of the buffer, which a callback may have changed.

    :param rollout: The rollout
    :param buffer: The rollout buffer
    :param normalize: Whether to normalize the advantages
    """
    used, device = rollout.used, rollout.actions.device
    advantages, returns = (
        select(th.as_tensor(by_step(buffer, rows), device=device), used) for rows in (buffer.advantages, buffer.returns)
    )
    return Steps(
        observations=select(rollout.observations, used),
        actions=as_policy_actions(select(rollout.actions, used), rollout.policy.action_space),
        weights=(normalized(advantages) if normalize else advantages) * select(rollout.discounts, used).to(advantages),
        returns=returns,
        values=None if rollout.values is None else select(rollout.values, used),
    )


def normalized(weights: th.Tensor) -> th.Tensor:
    """
    ``(w − mean) / std``, or ``w`` where there are fewer than two samples or they do not differ.

    :param weights: Shape ``(n,)``
    :return: Shape ``(n,)``
    """
    if len(weights) < 2 or weights.max() == weights.min():
        return weights
    return (weights - weights.mean()) / (weights.std() + 1e-8)


def check_used(used: Bools, extent: Extent) -> None:
    """
    Check that a rollout has steps whose return is known, and warn where a fixed rollout leaves steps out.

    :param used: Mask of shape ``(n_steps, n_envs)``
    :param extent: What was to be collected
    :raises ValueError: If no step can be used
    """
    if not used.any():
        raise ValueError(
            f"No episode ended within n_steps={extent.n_steps}, and without a critic the return of an unfinished "
            "episode is not known: raise n_steps, set n_episodes instead, or use baseline='value'"
        )
    if np.isfinite(extent.n_steps) and not used.all():
        warnings.warn(
            "Episodes that n_steps cuts are left out, since without a critic their return is not known. Long episodes "
            "are cut more often than short ones, so the gradient is biased towards short episodes: n_episodes instead "
            "of n_steps removes this bias (see rollout/complete_fraction)",
            stacklevel=2,
        )


def check_baseline(baseline: Any, rollout: Rollout) -> Floats:
    """
    Check what a baseline has returned.

    :param baseline: b_t, meant to be of shape ``(n_steps, n_envs)``
    :param rollout: The rollout it belongs to
    :return: b_t as an array, float64
    :raises TypeError: If it is not a tensor
    :raises ValueError: If its shape is wrong, or it is not finite at a step that is used
    """
    if not isinstance(baseline, th.Tensor):
        raise TypeError(f"baseline must return a tensor, got {type(baseline).__name__}")
    if baseline.shape != rollout.returns.shape:
        raise ValueError(
            f"baseline must return a tensor of shape (n_steps, n_envs) = {tuple(rollout.returns.shape)}, got "
            f"{tuple(baseline.shape)}"
        )
    values = baseline.detach().cpu().double().numpy()
    wrong = np.argwhere(~np.isfinite(values) & rollout.used.numpy())
    if len(wrong):
        step, env = wrong[0]
        got = f"{values[step, env]} at step {step} of environment {env}"
        raise ValueError(f"baseline must return finite values, got {got}")
    return np.where(rollout.used.numpy(), values, 0.0)
