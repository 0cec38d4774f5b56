"""Spaces: which ones are supported, and how actions are stored, evaluated and sent to environments."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv


def check_env(env: Any, verbose: int, n_envs: int | None = None) -> GymEnv:
    """
    Check what a user gives a model to learn from.

    :param env: What the user passed; an id that is registered in Gymnasium is made
    :param verbose: The argument of this name
    :param n_envs: The number of environments that there must be; None for any
    :return: The environment
    :raises TypeError: If it is no environment
    :raises ValueError: If no policy can act in its spaces, or the number is another
    """
    vectorized = isinstance(env, gym.vector.VectorEnv)
    if vectorized or not (isinstance(env, str) or hasattr(env, "observation_space")):
        hint = ": wrap it in GymnasiumVecEnv" if vectorized else ""
        raise TypeError(f"env must be a gymnasium.Env, a VecEnv or a registered id, got {env!r}{hint}")
    made: GymEnv = maybe_make_env(env, verbose)
    check_spaces(made.observation_space, made.action_space)
    found = getattr(made, "num_envs", 1)
    if n_envs not in (None, found):
        raise ValueError(
            f"env must have num_envs={n_envs}, as the model has, got {found}: for another number save the model and "
            "load it with that env"
        )
    return made


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """
    Check that a policy of Stable-Baselines3 can act in these spaces.

    :param observation_space: The environment's observation space
    :param action_space: The environment's action space
    :raises ValueError: If it cannot
    """
    if not isinstance(action_space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        raise ValueError(f"The action space must be Box, Discrete, MultiDiscrete or MultiBinary, got {action_space}")
    if isinstance(action_space, spaces.Box) and not action_space.is_bounded():
        raise ValueError(f"A Box action space must have finite bounds, got {action_space}")
    if isinstance(action_space, spaces.MultiBinary) and not isinstance(action_space.n, int):
        raise ValueError(f"A MultiBinary action space must have one dimension, got {action_space}: flatten it")
    if isinstance(action_space, spaces.MultiDiscrete) and len(action_space.shape) != 1:
        raise ValueError(f"A MultiDiscrete action space must have one dimension, got {action_space}: flatten it")
    if 0 in (action_space.shape or ()):
        raise ValueError(f"The action space must not be empty, got {action_space}")
    parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
    if not parts:
        raise ValueError(f"The observation space must not be empty, got {observation_space}")
    for key, space in parts.items():
        where = f" under {key!r}" if key else ""
        if not isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            raise ValueError(
                f"The observation space{where} must be Box, Discrete, MultiDiscrete, MultiBinary or a Dict of these, "
                f"got {space}"
            )
        if isinstance(space, spaces.Box) and not space.shape:
            raise ValueError(f"The observation space{where} must have a dimension, got {space}: make its shape (1,)")
        if isinstance(space, spaces.MultiDiscrete) and len(space.shape) != 1:
            raise ValueError(f"The observation space{where} must have one dimension, got {space}: flatten it")
        if 0 in (space.shape or ()):
            raise ValueError(f"The observation space{where} must not be empty, got {space}")
        if np.any(getattr(space, "start", 0)):
            raise ValueError(f"The observation space{where} must start at 0, got {space}: subtract its start")


def env_actions_of(policy: ActorCriticPolicy, n_envs: int) -> Callable[[np.ndarray], np.ndarray]:
    """
    How the policy's actions become those of the environment: clipped or unscaled to a Box, shifted to a discrete start.

    :param policy: The policy
    :param n_envs: Number of environments
    :return: A function of actions of shape ``(n_envs, *action_space.shape)``
    """
    space = policy.action_space
    if isinstance(space, spaces.Box):
        # Bounds for each environment: to broadcast them at each step takes longer than to clip
        low, high = (np.repeat(bound[None], n_envs, axis=0) for bound in (space.low, space.high))
        return policy.unscale_action if policy.squash_output else lambda actions: actions.clip(low, high)
    if np.any(getattr(space, "start", 0)):
        return lambda actions: shift_to_start(space, actions)
    return lambda actions: actions


def shift_to_start(space: spaces.Space[Any], actions: np.ndarray) -> np.ndarray:
    """
    Actions counted from 0, as policies count, to actions of the space.

    :param space: An action space; Discrete and MultiDiscrete may have a start
    :param actions: Shape ``(..., *space.shape)``
    :return: The same shape
    """
    start = getattr(space, "start", 0)
    return actions + start if np.any(start) else actions


def as_policy_actions(actions: th.Tensor, action_space: spaces.Space[Any]) -> th.Tensor:
    """
    Stored actions in the form that ``evaluate_actions`` takes.

    :param actions: Shape ``(n, action_dim)``
    :param action_space: The action space
    :return: Shape ``(n,)``, int64 for Discrete, else ``(n, action_dim)``, float32
    """
    return actions.long().flatten() if isinstance(action_space, spaces.Discrete) else actions.float()


def zeros(space: spaces.Space[Any]) -> Any:
    """
    A batch of one element of a space, all zeros.

    :param space: A Box, a discrete space, or a Dict of them
    """
    if isinstance(space, spaces.Dict):
        return {key: zeros(part) for key, part in space.spaces.items()}
    return np.zeros((1, *(space.shape or ())), dtype=space.dtype)
