"""
How a rollout is collected: a number of steps per environment, or a quota of whole episodes per environment.

It stands apart from ``rollouts``, which holds what was collected and the pure functions on it.
"""

import warnings
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.spaces import env_actions_of
from sb3_reinforce.envs.checks import check_finite
from sb3_reinforce.estimation.returns import Bools
from sb3_reinforce.estimation.rollout import Extent
from sb3_reinforce.sampling.actors import make_actor

# The arrays of a RolloutBuffer that have one row per step
ROWS = ("observations", "actions", "rewards", "returns", "episode_starts", "values", "log_probs", "advantages")


@dataclass(frozen=True)
class Ends:
    """
    How the episodes of a rollout end.

    :param dones: Whether a step is the last of its episode, shape ``(n_steps, n_envs)``
    :param terminal_obs: The terminal observation at each (step, environment) where a time limit ended the episode
    """

    dones: Bools
    terminal_obs: dict[tuple[int, int], Any]


def collect(
    model: OnPolicyAlgorithm,
    env: VecEnv,
    callback: BaseCallback,
    rollout_buffer: RolloutBuffer,
    extent: Extent,
    with_critic: bool,
) -> Ends | None:
    """
    Step the environments and write what happens into a rollout buffer, with one actor pass a step.

    :param model: The algorithm; its ``_last_obs`` and ``num_timesteps`` are kept up to date
    :param env: The environments
    :param callback: Called at each step, with the locals that the callbacks of Stable-Baselines3 read
    :param rollout_buffer: The rollout buffer; it grows where it is too small and keeps one row per step. Its
        ``log_probs`` are computed where a callback can read them, and 0 otherwise: training does not need them
    :param extent: When the rollout is complete; what an environment does after its quota of episodes is not used
    :param with_critic: Whether V(s) will be needed
    :return: How the episodes ended; None if the callback stopped the collection
    :raises ValueError: If an episode that is waited for does not end
    :raises ConnectionError: If a worker of a ``SubprocVecEnv`` died
    """
    policy, actor, n_steps = model.policy, make_actor(model.policy, env.num_envs, with_critic), 0
    as_env_actions, is_heard = env_actions_of(policy, env.num_envs), hears(callback)
    # A copy: some VecEnvs reuse the array of the dones
    first, all_dones = np.array(model._last_episode_starts, dtype=bool), list[Bools]()
    terminal_obs: dict[tuple[int, int], Any] = {}
    owed, begun = extent.quota.copy(), np.zeros(env.num_envs, dtype=int)
    deadline, waiting = extent.max_episode_steps, True
    while n_steps < extent.n_steps and waiting:
        if n_steps == deadline:
            raise ValueError(
                f"An episode has not ended after max_episode_steps={extent.max_episode_steps} steps, and whole "
                "episodes are waited for: give the environment a time limit, raise max_episode_steps, or set n_steps"
            )
        if n_steps == rollout_buffer.buffer_size:
            resize(rollout_buffer, 2 * n_steps)
        if model.use_sde and model.sde_sample_freq > 0 and n_steps % model.sde_sample_freq == 0:
            policy.reset_noise(env.num_envs)
        actions, values, log_probs = actor.act(model._last_obs)
        write(rollout_buffer.observations, n_steps, model._last_obs)
        write(rollout_buffer.actions, n_steps, actions)
        if values is not None and log_probs is not None:
            write(rollout_buffer.values, n_steps, values)
            write(rollout_buffer.log_probs, n_steps, log_probs)

        if model.use_sde:
            # Its standard deviation may overflow, and the environment would be blamed
            check_finite("The action", actions, (None,))
        clipped_actions = as_env_actions(actions)
        new_obs, rewards, dones, infos = env.step(clipped_actions)
        model.num_timesteps += env.num_envs
        model._last_obs, model._last_episode_starts = new_obs, dones  # type: ignore[assignment]

        if is_heard:
            callback.update_locals(locals())
            if not callback.on_step():
                return None
        # After the callback, which may have changed the rewards in place
        rollout_buffer.rewards[n_steps] = rewards
        all_dones.append(dones.astype(bool))
        if np.count_nonzero(dones):
            wanted = np.flatnonzero(all_dones[-1] & (owed > 0))
            model._update_info_buffer([infos[i] for i in wanted], dones[wanted])
            for i in wanted.tolist():
                if infos[i].get("TimeLimit.truncated") and infos[i].get("terminal_observation") is not None:
                    terminal_obs[n_steps, i] = deepcopy(infos[i]["terminal_observation"])
            owed[wanted] -= 1
            begun[wanted] = n_steps + 1
            if extent.n_steps == np.inf:
                waiting = bool(owed.any())
                deadline = extent.max_episode_steps + begun[owed > 0].min(initial=n_steps + 1)
        rollout_buffer.pos = n_steps = n_steps + 1
    resize(rollout_buffer, n_steps)
    rollout_buffer.full, ends = True, np.array(all_dones)
    rollout_buffer.episode_starts[:] = np.vstack([first, ends[:-1]])
    if log_probs is None and is_heard:
        shape = rollout_buffer.rewards.shape
        rollout_buffer.log_probs = actor.log_prob(rollout_buffer.observations, rollout_buffer.actions).reshape(shape)
    return Ends(ends, terminal_obs)


def hears(callback: BaseCallback) -> bool:
    """
    Whether anybody is told of the steps: of no callback at all, Stable-Baselines3 makes one that does nothing.

    :param callback: What ``learn`` was given, as a callback
    """
    return not (type(callback) is ConvertCallback and callback.callback is None)


def write(rows: Any, step: int, values: Any) -> None:
    """
    Write one step into the rows of a rollout buffer.

    :param rows: An array of shape ``(n_steps, n_envs, ...)``, or a dict of them
    :param step: The row
    :param values: As many elements as a row has, or a dict
    """
    if isinstance(rows, dict):
        for key, part in rows.items():
            write(part, step, values[key])
    else:
        # Actions and observations of one number lack the last dimension
        rows[step] = values if values.ndim == rows.ndim - 1 else values.reshape(rows.shape[1:])


def resize(buffer: RolloutBuffer, n_steps: int) -> None:
    """
    Give a rollout buffer another number of rows, keeping the rows that it has.

    :param buffer: The rollout buffer
    :param n_steps: Its new number of rows
    """

    def resized(rows: Any) -> Any:
        if isinstance(rows, dict):
            return {key: resized(part) for key, part in rows.items()}
        if n_steps <= len(rows):
            return rows[:n_steps]
        return np.concatenate([rows, np.zeros((n_steps - len(rows), *rows.shape[1:]), dtype=rows.dtype)])

    if n_steps != buffer.buffer_size:
        for name in ROWS:
            setattr(buffer, name, resized(getattr(buffer, name)))
        buffer.buffer_size = n_steps


def by_step(buffer: RolloutBuffer, rows: np.ndarray) -> np.ndarray:
    """
    Rows of a rollout buffer step by step, also after ``get`` has put those of each environment one after the other.

    :param buffer: The rollout buffer
    :param rows: Its ``advantages`` or ``returns``
    :return: Shape ``(n_steps, n_envs)``
    """
    return np.ascontiguousarray(rows.reshape(buffer.n_envs, -1).T) if buffer.generator_ready else rows


def warn_of_own_methods(buffer: RolloutBuffer) -> None:
    """
    Warn where a user's rollout buffer would not be asked.

    :param buffer: The rollout buffer
    """
    for name in ("add", "compute_returns_and_advantage"):
        if getattr(type(buffer), name) not in (getattr(RolloutBuffer, name), getattr(DictRolloutBuffer, name)):
            warnings.warn(
                f"rollout_buffer_class={type(buffer).__name__} overrides {name}, which is not called: the buffer's "
                "arrays are written in place. For other weights use your own baseline, or a callback's on_rollout_end",
                stacklevel=2,
            )


def check_data(buffer: RolloutBuffer, last_obs: Any, terminal_obs: dict[tuple[int, int], Any]) -> None:
    """
    Check what the environments returned.

    :param buffer: The rollout buffer, full or not
    :param last_obs: The observations after the last step
    :param terminal_obs: The terminal observations at time limits
    :raises ValueError: Naming what is not finite, and the step and environment
    """
    check_finite("The reward", buffer.rewards)
    check_finite("The observation", buffer.observations)
    check_finite("The observation", last_obs, (buffer.pos,))
    for where, obs in terminal_obs.items():
        check_finite("The terminal observation", obs, where)
