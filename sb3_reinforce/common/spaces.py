"""Spaces: which ones are supported, and how actions are stored, evaluated and sent to environments."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

SUPPORTED = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def check_env(env: Any, verbose: int, n_envs: int | None = None) -> GymEnv:
    """Make the environment if it is an id, and check its spaces and its number of copies."""
    if not isinstance(env, (str, gym.Env, VecEnv)):
        hint = ": wrap it in sb3_reinforce.GymnasiumVecEnv" if isinstance(env, gym.vector.VectorEnv) else ""
        if any(each.__module__.split(".")[0] == "gym" for each in type(env).__mro__):
            hint = ": wrap it in DummyVecEnv([lambda: env]), which converts environments of OpenAI Gym"
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
    """Check that a policy of Stable-Baselines3 can act in these spaces."""
    check_space("action_space", action_space, "Box, Discrete, MultiDiscrete or MultiBinary")
    if isinstance(action_space, spaces.Box) and not action_space.is_bounded():
        raise ValueError(f"action_space must have finite bounds, got {action_space}")
    if isinstance(action_space, spaces.MultiBinary) and not isinstance(action_space.n, int):
        raise ValueError(f"action_space must have one dimension, got {action_space}: flatten it")
    parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
    if not parts:
        raise ValueError(f"observation_space must not be empty, got {observation_space}")
    for key, space in parts.items():
        name = f"observation_space[{key!r}]" if key else "observation_space"
        supported = "Box, Discrete, MultiDiscrete or MultiBinary"
        check_space(name, space, supported if key else "Box, Discrete, MultiDiscrete, MultiBinary or a Dict of these")
        if isinstance(space, spaces.Box) and not space.shape:
            raise ValueError(f"{name} must have a dimension, got {space}: make its shape (1,)")
        if np.any(getattr(space, "start", 0)):
            raise ValueError(f"{name} must start at 0, got {space}: subtract its start")


def check_dicts(policy: str | type, space: spaces.Space[Any]) -> None:
    """Refuse policies that need flat observations: the error of Stable-Baselines3 does not name MaskedPolicy."""
    if isinstance(space, spaces.Dict) and policy in ("MlpPolicy", "CnnPolicy"):
        allowed = "MultiInputPolicy, or MaskedPolicy for action masks,"
        raise ValueError(f"policy must be {allowed} for observations in {space}, got {policy}")


def check_space(name: str, space: spaces.Space[Any], supported: str) -> None:
    """Check what action and observation spaces have in common."""
    if not isinstance(space, SUPPORTED):
        raise ValueError(f"{name} must be {supported}, got {space}")
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) != 1:
        raise ValueError(f"{name} must have one dimension, got {space}: flatten it")
    if 0 in (space.shape or ()):
        raise ValueError(f"{name} must not be empty, got {space}")


def env_actions_of(policy: ActorCriticPolicy) -> Callable[[np.ndarray], np.ndarray]:
    """Return the map from the policy's actions to the environment's, both ``(n_envs, *action_space.shape)``."""
    space = policy.action_space
    if isinstance(space, spaces.Box):
        return policy.unscale_action if policy.squash_output else lambda actions: actions.clip(space.low, space.high)
    # Asked once: np.any takes longer than the forward pass of a small network
    return partial(shift_to_start, space) if np.any(getattr(space, "start", 0)) else lambda actions: actions


def shift_to_start(space: spaces.Space[Any], actions: np.ndarray) -> np.ndarray:
    """Turn actions ``(..., *space.shape)`` counted from 0, as policies count, into actions of the space."""
    start = getattr(space, "start", 0)
    return actions + start if np.any(start) else actions


def as_policy_actions(actions: th.Tensor, action_space: spaces.Space[Any]) -> th.Tensor:
    """Turn stored actions ``(n, action_dim)`` into what ``evaluate_actions`` takes: int64 ``(n,)`` for Discrete."""
    return actions.long().flatten() if isinstance(action_space, spaces.Discrete) else actions.float()


def check_noise(use_sde: bool, action_space: spaces.Space[Any]) -> None:
    """Check that gSDE, the noise of a Gaussian policy, goes with the actions."""
    if use_sde and not isinstance(action_space, spaces.Box):
        raise ValueError(f"use_sde=True is for Box action spaces, not for {action_space}")
