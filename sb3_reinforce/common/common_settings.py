"""What the arguments must satisfy that both algorithms have from Stable-Baselines3, and those of ``learn``."""

import os
from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import MultiInputActorCriticPolicy

from sb3_reinforce.common.arguments import as_integers, check_flag, check_integer, check_kind, check_number

# What NumPy takes
MAX_SEED = 2**32 - 1


def check_basics(
    policy: Any, policy_kwargs: Any, stats_window_size: Any, tensorboard_log: Any, verbose: Any, seed: Any, device: Any
) -> None:
    """
    Check arguments that Stable-Baselines3 uses as soon as it has them.

    :param policy: The argument of this name, as are all others
    :param policy_kwargs: None or a dict
    :param stats_window_size: 1 or more
    :param tensorboard_log: None or a path
    :param verbose: 0 or more
    :param seed: None, or from 0 to 2**32 - 1
    :param device: A device, or "auto"
    :raises TypeError: If one is of the wrong kind
    :raises ValueError: If one is out of its range
    """
    if not isinstance(policy, (str, type)):
        raise TypeError(f"policy must be a name or a class, got {policy!r} of type {type(policy).__name__}")
    check_kind("policy_kwargs", policy_kwargs, (Mapping,))
    check_kind("tensorboard_log", tensorboard_log, (str, os.PathLike))
    check_integer("stats_window_size", stats_window_size, 1)
    check_integer("verbose", verbose, 0)
    if seed is not None:
        check_integer("seed", seed, 0, MAX_SEED)
    check_kind("device", device, (str, th.device), optional=False)
    if device != "auto":
        try:
            th.device(device)
        except RuntimeError as error:
            raise ValueError(
                f"device must be 'auto' or a device that PyTorch knows, got {device!r}: {error}"
            ) from error


def check_basics_of(model: Any) -> None:
    """
    Check the basic arguments of a model, which ``load`` may have replaced.

    :param model: An algorithm with its arguments as attributes
    :raises TypeError: If one is of the wrong kind
    :raises ValueError: If one is out of its range
    """
    space = model.observation_space
    if model.policy_class is MultiInputActorCriticPolicy and not isinstance(space, spaces.Dict):
        raise ValueError(f"policy must be MlpPolicy or CnnPolicy for observations in {space}, got MultiInputPolicy")
    window, log = model._stats_window_size, model.tensorboard_log
    check_basics(model.policy_class, model.policy_kwargs, window, log, model.verbose, model.seed, model.device)
    as_integers(model, {"_stats_window_size": 1} | ({} if model.seed is None else {"seed": 0}))


def check_learn(
    env: Any,
    total_timesteps: Any,
    callback: Any,
    log_interval: Any,
    tb_log_name: Any,
    reset_num_timesteps: Any,
    progress_bar: Any,
) -> None:
    """
    Check the arguments of ``learn``.

    :param env: The model's environments
    :param total_timesteps: The argument of this name, as are all others
    :param callback: None, a callback, a function or a list of callbacks
    :param log_interval: 1 or more, or None
    :param tb_log_name: A name
    :param reset_num_timesteps: True or False
    :param progress_bar: True or False
    :raises TypeError: If one is of the wrong kind
    :raises ValueError: If one is out of its range, or the model has no environment
    """
    if env is None:
        raise ValueError("env is None, and learning needs an environment: give load one, or call set_env")
    check_number("total_timesteps", total_timesteps, 0)
    if log_interval is not None:
        check_integer("log_interval", log_interval, 1)
    check_kind("tb_log_name", tb_log_name, (str,), optional=False)
    check_flag("reset_num_timesteps", reset_num_timesteps)
    check_flag("progress_bar", progress_bar)
    for each in callback if isinstance(callback, list) else [callback]:
        is_one = isinstance(each, BaseCallback) or (callable(each) and not isinstance(each, type) and each is callback)
        if not (is_one or callback is None):
            raise TypeError(f"callback must be a callback, a list of callbacks, a function or None, got {each!r}")
