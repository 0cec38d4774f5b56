"""How a rollout is collected: a number of steps per environment, or a quota of whole episodes per environment."""

import warnings
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.spaces import env_actions_of
from sb3_reinforce.common.tensors import map_parts
from sb3_reinforce.envs.checks import check_finite, check_length
from sb3_reinforce.estimation.returns import Bools, Integers
from sb3_reinforce.policies.evaluation import calls
from sb3_reinforce.sampling.actors import Actor, NumpyActor

# The terminal observation at each (step, environment) where a time limit ended an episode that counts
TerminalObs: TypeAlias = dict[tuple[int, int], Any]

# The arrays of a RolloutBuffer that have one row per step
ROWS = ("observations", "actions", "rewards", "returns", "episode_starts", "values", "log_probs", "advantages")


@dataclass(frozen=True)
class Columns:
    """
    What was collected besides the rows of the buffer; ``dones`` is of shape ``(n_steps, n_envs)``.

    ``quota`` is the largest number of episodes that count in each environment, ``has_values`` whether the buffer has
    V(s_t); ``state`` is as in ``Rollout``.
    """

    dones: Bools
    terminal_obs: TerminalObs
    last_obs: Any
    quota: Integers
    state: th.Tensor | None = None
    has_values: bool = False


class Extent:
    """
    When a rollout is complete: after ``n_steps`` per environment, or with ``quota`` episodes of each environment.

    An episode that is waited for and lasts longer than ``max_episode_steps`` is an error.
    """

    def __init__(self, quota: NDArray[np.integer], n_steps: float = np.inf, max_episode_steps: float = np.inf):
        self.quota = quota
        self.n_steps = n_steps
        self.max_episode_steps = max_episode_steps
        self.remaining = quota.copy()
        self.started_at = np.zeros_like(quota)
        # The first step of the longest episode that is waited for
        self.first_step = 0
        self.is_complete = False

    @classmethod
    def fixed(cls, n_steps: int, n_envs: int) -> "Extent":
        """The same number of steps in every environment, and as many episodes as end in them."""
        # A step ends at most one episode
        return cls(np.full(n_envs, n_steps), n_steps=n_steps)

    @classmethod
    def whole_episodes(cls, n_episodes: int, n_envs: int, max_episode_steps: int) -> "Extent":
        """Quotas that differ by at most 1, fixed beforehand: "the first to finish" would favor short episodes."""
        quota = n_episodes // n_envs + (np.arange(n_envs) < n_episodes % n_envs)
        return cls(quota, max_episode_steps=max_episode_steps)

    def count(self, dones: Bools, n_steps: int) -> list[int]:
        """Count the episodes that ended with this step; return the environments whose episode is in the quota."""
        counted = np.flatnonzero(dones & (self.remaining > 0))
        self.remaining[counted] -= 1
        self.started_at[counted] = n_steps
        self.is_complete = not self.remaining.any()
        self.first_step = int(self.started_at[self.remaining > 0].min(initial=n_steps))
        return list(counted.tolist())


def collect(
    model: OnPolicyAlgorithm,
    env: VecEnv,
    callback: BaseCallback,
    rollout_buffer: RolloutBuffer,
    extent: Extent,
    with_critic: bool,
    actor_of: Callable[[bool, bool], Actor],
) -> Columns | None:
    """
    Step the environments and write what happens into a rollout buffer, which ends with one row per step.

    Returns None if the callback stopped the collection. The ``log_probs`` are 0 unless a callback can read them, or
    ``forward`` returns them with the actions: training has no use for them.
    """
    policy = model.policy
    has_callback = is_attached(callback)
    has_values = calls(policy, "forward", with_critic)
    actor = actor_of(has_values, has_callback)
    as_env_actions = env_actions_of(policy)
    # Row t: which environments start an episode at step t. From row 1 on, it is ``dones`` of the step before
    starts = [cast(Bools, model._last_episode_starts)]
    terminal_obs: TerminalObs = {}
    n_steps = 0
    first_row = 0
    while n_steps < extent.n_steps and not extent.is_complete:
        check_length(
            n_steps - extent.first_step, extent.max_episode_steps, ", or train with n_steps instead of n_episodes"
        )
        if n_steps == rollout_buffer.buffer_size:
            resize(rollout_buffer, 2 * n_steps)
        if model.use_sde and model.sde_sample_freq > 0 and n_steps % model.sde_sample_freq == 0:
            policy.reset_noise(env.num_envs)
        actions, values, log_probs = actor.act(model._last_obs)
        write_row(rollout_buffer.observations, n_steps, model._last_obs)
        write_row(rollout_buffer.actions, n_steps, actions)
        write_row(rollout_buffer.values, n_steps, values)
        write_row(rollout_buffer.log_probs, n_steps, log_probs)
        # The environment would be blamed for what it does with NaN
        check_finite("The policy's action", actions, (None,))
        clipped_actions = as_env_actions(actions)
        new_obs, rewards, dones, infos = env.step(clipped_actions)
        model.num_timesteps += env.num_envs
        if has_callback:
            callback.update_locals(locals())
            if not goes_on(callback):
                return None
        # As with A2C, the callback finds s_t here
        model._last_obs = new_obs  # type: ignore[assignment]
        # After the callback, which may have changed the rewards in place
        rollout_buffer.rewards[n_steps] = rewards
        # Copies as booleans: some VecEnvs return numbers, or reuse the array
        starts.append(dones.astype(bool))
        model._last_episode_starts = starts[-1]
        n_steps += 1
        rollout_buffer.pos = n_steps
        if dones.any():
            counted = extent.count(starts[-1], n_steps)
            model._update_info_buffer([infos[i] for i in counted], dones[counted])
            for i in counted:
                if infos[i].get("TimeLimit.truncated") and infos[i].get("terminal_observation") is not None:
                    # Of a dict only what the space has; some VecEnvs write the next one into the same array
                    found = map_parts(lambda _, part: part, new_obs, infos[i]["terminal_observation"])
                    terminal_obs[n_steps - 1, i] = deepcopy(found)
        if has_callback and not actor.is_current(model.policy):
            write_log_probs(rollout_buffer, actor, first_row)
            policy = model.policy
            actor = actor_of(calls(policy, "forward", with_critic), has_callback)
            # The values of the rows so far came from another policy: they are computed in one batch instead
            has_values = False
            first_row = n_steps
    resize(rollout_buffer, n_steps)
    rollout_buffer.full = True
    rollout_buffer.episode_starts[:] = starts[:-1]
    if has_callback:
        write_log_probs(rollout_buffer, actor, first_row)
    return Columns(np.array(starts[1:]), terminal_obs, model._last_obs, extent.quota, has_values=has_values)


def is_attached(callback: BaseCallback) -> bool:
    """Whether a callback must be called: for ``callback=None`` Stable-Baselines3 installs a no-op."""
    return not (type(callback) is ConvertCallback and callback.callback is None)


def goes_on(callback: BaseCallback) -> bool:
    """Call a callback at a step; None stops training as False does, usually by mistake."""
    answer: bool | None = callback.on_step()
    if answer is None:
        warnings.warn("A callback returned None, which stops training: return True to go on", stacklevel=3)
    return bool(answer)


def keep_fractions(buffer: RolloutBuffer, obs: Any, action_space: spaces.Space[Any]) -> None:
    """Make arrays float32 where a Box is of integers or float16: VecNormalize and Gaussian policies return float32."""

    def fitted(rows: np.ndarray, given: Any) -> np.ndarray:
        dtype = np.asarray(given).dtype
        is_too_coarse = rows.dtype.kind != "f" or rows.dtype.itemsize < min(4, dtype.itemsize)
        return rows.astype(np.float32) if dtype.kind == "f" and is_too_coarse else rows

    buffer.observations = map_parts(fitted, buffer.observations, obs)
    if isinstance(action_space, spaces.Box):
        buffer.actions = fitted(buffer.actions, 0.0)


def write_row(rows: Any, step: int, values: Any) -> None:
    """``rows[step] = values``, for an array of shape ``(n_steps, n_envs, ...)`` or a dict of them; None is left out."""
    if isinstance(rows, dict):
        for key, part in rows.items():
            write_row(part, step, values[key])
    elif values is not None:
        # Actions and observations of one number lack the last dimension
        rows[step] = values if values.ndim == rows.ndim - 1 else values.reshape(rows.shape[1:])


def write_log_probs(buffer: RolloutBuffer, actor: Actor, first_row: int) -> None:
    """Write log π from ``first_row`` on, which a NumpyActor does not return with the actions."""
    if first_row < buffer.pos and isinstance(actor, NumpyActor):
        rows = slice(first_row, buffer.pos)
        buffer.log_probs[rows] = actor.log_prob(buffer.actions[rows]).reshape(-1, buffer.n_envs)


def resize(buffer: RolloutBuffer, n_steps: int) -> None:
    """Cut a rollout buffer to ``n_steps`` rows, or double it to that number."""

    def resized(rows: np.ndarray) -> np.ndarray:
        return rows[:n_steps] if n_steps <= len(rows) else np.concatenate([rows, np.zeros_like(rows)])

    for name in ROWS:
        setattr(buffer, name, map_parts(resized, getattr(buffer, name)))
    buffer.buffer_size = n_steps


def warn_of_own_methods(buffer: RolloutBuffer) -> None:
    """Warn if a user's rollout buffer overrides a method that is not called."""
    for name in ("add", "get", "compute_returns_and_advantage"):
        if getattr(type(buffer), name) not in (getattr(RolloutBuffer, name), getattr(DictRolloutBuffer, name)):
            warnings.warn(
                f"rollout_buffer_class={type(buffer).__name__} overrides {name}, which is not called: the buffer's "
                "arrays are written in place. For other weights use your own baseline, or a callback's on_rollout_end",
                stacklevel=2,
            )


def check_rollout_data(buffer: RolloutBuffer, last_obs: Any, terminal_obs: TerminalObs) -> None:
    """Raise a ValueError that names the step and environment if a reward or an observation is not finite."""
    check_finite("The reward", buffer.rewards)
    check_finite("The observation", buffer.observations)
    check_finite("The observation", last_obs, (buffer.pos,))
    for where, obs in terminal_obs.items():
        check_finite("The terminal observation", obs, where)
