"""Checks of environments and of what they return. Each error names the environment; ``learn`` adds the step."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv


class BadData(ValueError):
    """What an environment returned at this step cannot be learned from."""


def is_finite(values: np.ndarray) -> np.ndarray:
    """
    Which numbers are finite, also in float32, in which they are learned from.

    :param values: Any shape
    :return: The same shape
    """
    with np.errstate(over="ignore"):
        return np.isfinite(values.astype(np.float32))


def told(value: Any) -> str:
    """
    A number that is not finite, for a message.

    :param value: It, or an array with it
    """
    return f"{value}{' (float32 ends at 3.4e38)' * bool(np.isfinite(value).all())}"


def all_finite(values: np.ndarray) -> bool:
    """
    Whether all numbers are finite.

    :param values: Any shape
    """
    # One product costs less than isfinite and all; where it is large, they decide
    return values.dtype.kind != "f" or float(np.vdot(values, values)) < 1e76 or bool(is_finite(values).all())


def check_finite(name: str, values: Any, where: tuple[int | None, ...] = ()) -> None:
    """
    Check numbers that came from environments.

    :param name: What they are, for the message
    :param values: An array of shape ``(n_steps, n_envs, ...)`` less the dimensions in ``where``, or a dict of them
    :param where: The step of the rollout, or the step and the environment, that ``values`` belong to; None for the
        present step
    :raises ValueError: Naming the first step and environment where a number is not finite
    """
    if isinstance(values, dict):
        for key, part in values.items():
            check_finite(f"{name} {key!r}", part, where)
        return
    values = np.asarray(values)
    if all_finite(values):
        return
    first = tuple(int(i) for i in np.argwhere(~is_finite(values))[0])
    step, env = (*where, *first)[:2]
    if step is None:
        raise BadData(f"{name} of environment {env} is not finite: {told(values[first])}")
    raise ValueError(
        f"{name} of environment {env} at step {step} of the rollout is not finite: {told(values[first])}. "
        "The policy has not been updated with this rollout."
    )


def as_reward(reward: Any, env: int) -> float:
    """
    Check a reward.

    :param reward: What an environment returned
    :param env: Which environment
    :return: The reward
    :raises BadData: If it is no number
    """
    values = np.asarray(reward)
    if values.size != 1 or values.dtype.kind not in "biuf":
        raise BadData(f"The reward of environment {env} must be a number, got {reward!r}")
    return float(values.item())


def has_form(space: spaces.Space[Any], shape: tuple[int, ...], dtype: np.dtype[Any]) -> bool:
    """
    Whether an array may stand for an observation: integers for real numbers, but no fractions for integers.

    :param space: The observation space
    :param shape: The array's shape
    :param dtype: Its dtype
    """
    return shape == space.shape and dtype.kind in ("biuf" if np.dtype(space.dtype).kind == "f" else "biu")


def check_observation(space: spaces.Space[Any], obs: Any, env: int) -> None:
    """
    Check the form of an observation, which a VecEnv would stretch, cut or round to that of the space without a word.

    :param space: The observation space
    :param obs: What an environment returned
    :param env: Which environment
    :raises BadData: If it is of another shape or kind, or a category that the space does not have
    """
    if type(obs) is np.ndarray and obs.dtype == space.dtype and obs.shape == space.shape and type(space) is spaces.Box:
        return
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
    if not has_form(space, values.shape, values.dtype):
        raise BadData(
            f"The observation of environment {env} must have shape {space.shape} and a dtype that fits {space.dtype}, "
            f"as its space has, got shape {values.shape} and dtype {values.dtype}: {obs!r}"
        )
    if not isinstance(space, spaces.Box) and not space.contains(values.astype(space.dtype)):
        raise BadData(f"The observation of environment {env} must be in {space}, got {obs!r}")


def save_obs(env: DummyVecEnv, i: int, obs: Any) -> None:
    """
    What ``env._save_obs(i, obs)`` does, with a check.

    :param env: The environments
    :param i: Which one
    :param obs: Its observation
    :raises BadData: As ``check_observation``
    """
    check_observation(env.observation_space, obs, i)
    DummyVecEnv._save_obs(env, i, obs)
