"""Checks of what environments return. Each error names the environment; ``learn`` adds ``num_timesteps``."""

from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces


class BadData(ValueError):
    """What an environment returned at this step cannot be learned from."""


def check_finite(name: str, values: Any, where: tuple[int | None, ...] = ()) -> None:
    """
    Check that numbers are finite. ``where`` and then an element's indices name its place.

    The first two are its step, or None for the present one, and its environment.
    """
    if isinstance(values, dict):
        for key, part in values.items():
            check_finite(f"{name} {key!r}", part, where)
        return
    values = np.asarray(values)
    # One cheap product: below 1e76, all numbers are finite in float32
    if values.dtype.kind != "f" or float(np.vdot(values, values)) < 1e76:
        return
    # Numbers are learned from in float32
    with np.errstate(over="ignore"):
        bad = np.argwhere(~np.isfinite(values.astype(np.float32)))
    if not len(bad):
        return
    first = tuple(bad[0].tolist())
    step, env = (*where, *first)[:2]
    number = values[first]
    reason = f"is not finite: {number}{' (float32 ends at 3.4e38)' if np.isfinite(number) else ''}"
    if step is None:
        raise BadData(f"{name} of environment {env} {reason}")
    raise ValueError(
        f"{name} of environment {env} at step {step} of the rollout {reason}. The policy has not been updated with it."
    )


def check_length(n_steps: int, max_episode_steps: float, alternative: str = "") -> None:
    """Refuse an episode that has lasted ``n_steps`` and may not be longer."""
    if n_steps == max_episode_steps:
        raise ValueError(
            f"An episode has not ended after max_episode_steps={max_episode_steps} steps: give the environment a time "
            f"limit, or raise max_episode_steps{alternative}. If an EvalCallback uses the same environments, give it "
            "separate ones. The parameters have not changed."
        )


def as_reset(returned: Any, env: int) -> tuple[Any, dict[str, Any]]:
    """The observation and info that an environment's reset must return; OpenAI Gym's returned the observation alone."""
    if not (isinstance(returned, (tuple, list)) and len(returned) == 2):
        raise BadData(f"reset of environment {env} must return (observation, info), got {returned!r}")
    obs, info = returned
    return obs, info


def as_reward(reward: Any, env: int) -> float:
    """Convert the reward of an environment, which must be one number, to a float."""
    values = np.asarray(reward.detach().cpu() if isinstance(reward, th.Tensor) else reward)
    if values.size != 1 or not isinstance(values.item(), Real):
        raise BadData(f"The reward of environment {env} must be a number, got {reward!r}")
    return float(values.item())


def check_observation(space: spaces.Space[Any], obs: Any, env: object) -> None:
    """Check the form of one observation, which a VecEnv would silently broadcast, cut or round to its space."""
    if isinstance(space, spaces.Dict):
        if not isinstance(obs, Mapping) or not obs.keys() >= space.spaces.keys():
            got = list(obs) if isinstance(obs, Mapping) else repr(obs)
            raise BadData(
                f"The observation of environment {env} must be a dict with keys {list(space.spaces)}, got {got}"
            )
        for key, part in space.spaces.items():
            check_observation(part, obs[key], env)
        return
    try:
        values = np.asarray(obs)
    except ValueError as error:
        raise BadData(f"The observation of environment {env} must be an array, got {obs!r}: {error}") from error
    fits = values.shape == space.shape and values.dtype.kind in "biuf"
    if fits and values.dtype != space.dtype and np.dtype(space.dtype).kind != "f":
        # Integers may stand for real numbers, and other numbers for integers that the dtype can hold
        with np.errstate(invalid="ignore"):
            fits = np.array_equal(values.astype(space.dtype), values)
    if not fits:
        raise BadData(
            f"The observation of environment {env} must have shape {space.shape} and a dtype that fits {space.dtype}, "
            f"as its space has, got shape {values.shape} and dtype {values.dtype}: {obs!r}"
        )
    if not isinstance(space, spaces.Box) and not space.contains(values.astype(space.dtype)):
        raise BadData(f"The observation of environment {env} must be in {space}, got {obs!r}")


def checked_batch(space: spaces.Space[Any], obs: Any, n_envs: int) -> Any:
    """A copy of observations ``(n_envs, ...)``, or of a dict of them, whose form is right; see ``copied``."""
    if isinstance(space, spaces.Dict) and isinstance(obs, dict) and obs.keys() >= space.spaces.keys():
        return {key: checked_batch(part, obs[key], n_envs) for key, part in space.spaces.items()}
    rows = np.array(obs)
    if rows.shape[:1] != (n_envs,):
        raise BadData(f"There must be observations of {n_envs} environments, got shape {rows.shape}")
    # Rows of one array share their form, but only some of their numbers may fit integers
    share_form = isinstance(space, spaces.Box) and (rows.dtype == space.dtype or np.dtype(space.dtype).kind == "f")
    for i in range(1 if share_form else n_envs):
        check_observation(space, rows[i], i)
    return rows


def copied(space: spaces.Space[Any], obs: Any) -> Any:
    """A copy without keys that the space lacks: environments may write the next observations into the same arrays."""
    if isinstance(space, spaces.Dict):
        return {key: copied(part, obs[key]) for key, part in space.spaces.items()}
    return np.array(obs)
