"""What a vector environment of Gymnasium returns for all its copies: checked, copied, and taken apart."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_reinforce.envs.checks import BadData, check_observation, has_form


def check_batch(space: spaces.Space[Any], obs: Any, rewards: Any, n_envs: int) -> None:
    """
    Check the form of what a step returned.

    :param space: The observation space of one copy
    :param obs: The observations of all copies, an array or a dict of arrays
    :param rewards: Their rewards
    :param n_envs: Number of copies
    :raises BadData: If they are not of so many copies, or an observation is of another form than its space has
    """
    rewards = np.asarray(rewards)
    if rewards.shape != (n_envs,) or rewards.dtype.kind not in "biuf":
        got = f"shape {rewards.shape} and dtype {rewards.dtype}"
        raise BadData(f"The rewards must be {n_envs} numbers, one for each environment, got {got}")
    parts = obs if isinstance(obs, dict) else {"": obs}
    spaces_of = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    for part in parts.values():
        if np.shape(part)[:1] != (n_envs,):
            raise BadData(f"The observations must be those of {n_envs} environments, got shape {np.shape(part)}")
    # Copy by copy only what is not seen from the batch
    if not parts.keys() >= spaces_of.keys() or not all(fits(part, parts[key]) for key, part in spaces_of.items()):
        for i in range(n_envs):
            check_observation(space, one_of(obs, i), i)


def fits(space: spaces.Space[Any], batch: Any) -> bool:
    """
    Whether observations are of a form that a Box has.

    :param space: The space of one
    :param batch: The observations of all copies
    """
    values = np.asarray(batch)
    return type(space) is spaces.Box and has_form(space, values.shape[1:], values.dtype)


def one_of(obs: Any, i: int) -> Any:
    """
    The observation of one copy.

    :param obs: Observations of all copies, an array or a dict of arrays
    :param i: Which copy
    """
    return {key: part[i] for key, part in obs.items()} if isinstance(obs, dict) else obs[i]


def copy(obs: Any) -> Any:
    """
    Observations that the environment does not write into later.

    :param obs: An array or a dict of arrays
    """
    return {key: np.array(part) for key, part in obs.items()} if isinstance(obs, dict) else np.array(obs)


def info_of(env_infos: dict[str, Any], i: int) -> dict[str, Any]:
    """
    The info of one copy from Gymnasium's dict of arrays, in which ``_key`` masks ``key``.

    :param env_infos: The infos of a vector environment
    :param i: Which copy
    """
    info = {}
    for key, values in env_infos.items():
        is_mask = key.startswith("_") and key[1:] in env_infos
        if not is_mask and (f"_{key}" not in env_infos or env_infos[f"_{key}"][i]):
            info[key] = info_of(values, i) if isinstance(values, dict) else values[i]
    return info
