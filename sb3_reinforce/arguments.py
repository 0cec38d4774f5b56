"""Checks of what a user passes in: each error names the argument, its value and what is allowed."""

import math
import os
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule


def check_number(name: str, value: Any, low: float = -math.inf, high: float = math.inf, above: bool = False) -> float:
    """
    Return ``value`` as a float if it is a finite number in the range.

    :param name: Name of the argument, for the message
    :param value: What the user passed
    :param low: Smallest allowed value
    :param high: Largest allowed value
    :param above: Exclude ``low`` itself
    :return: The value
    :raises TypeError: If ``value`` is not a real number
    :raises ValueError: If ``value`` is not finite or not in the range
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r} of type {type(value).__name__}")
    number = float(value)
    if not math.isfinite(number) or not low <= number <= high or (above and number == low):
        bounds = [f"{'>' if above else '>='} {low:g}"] * (low > -math.inf) + [f"<= {high:g}"] * (high < math.inf)
        raise ValueError(f"{name} must be finite{''.join(' and ' + bound for bound in bounds)}, got {value!r}")
    return number


def check_integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """
    Return ``value`` as an int if it is an integer in the range.

    :param name: Name of the argument, for the message
    :param value: What the user passed
    :param low: Smallest allowed value
    :param high: Largest allowed value
    :return: The value
    :raises TypeError: If ``value`` is not an integer
    :raises ValueError: If ``value`` is not in the range
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be an integer, got {value!r} of type {type(value).__name__}")
    number = int(value)
    if not low <= number <= high:
        at_most = f" and at most {high}" * (high < math.inf)
        raise ValueError(f"{name} must be at least {low}{at_most}, got {value!r}")
    return number


def check_flag(name: str, value: Any) -> None:
    """
    Check that ``value`` is True or False.

    :param name: Name of the argument, for the message
    :param value: What the user passed
    :raises TypeError: If it is neither
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, got {value!r} of type {type(value).__name__}")


def check_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    """
    Check that ``value`` is one of some names.

    :param name: Name of the argument, for the message
    :param value: What the user passed
    :param choices: The names allowed
    :raises ValueError: If it is not; the message lists the names
    """
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


def check_function(name: str, value: Any, functions: dict[str, Callable[..., Any]]) -> Callable[..., Any]:
    """
    Look a function up by name, or take the user's own.

    :param name: Name of the argument, for the message
    :param value: A name in ``functions``, or a callable
    :param functions: The functions that have a name
    :return: The function
    :raises TypeError: If ``value`` is neither a string nor callable
    :raises ValueError: If no function has that name; the message lists the names
    """
    if callable(value):
        function: Callable[..., Any] = value
        return function
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a name or a callable, got {value!r} of type {type(value).__name__}")
    if value not in functions:
        raise ValueError(f"{name} must be a callable or one of {', '.join(map(repr, functions))}, got {value!r}")
    return functions[value]


# A larger step can take a parameter out of the range of float32
MAX_LEARNING_RATE = 1e6
# What NumPy takes
MAX_SEED = 2**32 - 1


class CheckedSchedule(FloatSchedule):
    """
    A schedule whose every value is checked, so that a wrong one is named and not trained with.

    :param name: Name of the argument, for the message
    :param schedule: A number, or a function of the progress that remains (from 1 to 0)
    :param low: Smallest allowed value
    :param above: Exclude ``low`` itself, but not at the end of training (progress 0), when nothing is drawn any more:
        a schedule may fall to it
    :param high: Largest allowed value
    :raises TypeError: If ``schedule`` is neither a number nor callable
    :raises ValueError: If its value at the start or at the end of training is not finite or not in the range
    """

    def __init__(
        self, name: str, schedule: float | Schedule, low: float = 0.0, above: bool = False, high: float = math.inf
    ):
        super().__init__(schedule if callable(schedule) else check_number(name, schedule, low, high, above))
        self.name, self.low, self.above, self.high = name, low, above, high
        for progress_remaining in (1.0, 0.0):
            self(progress_remaining)

    def __call__(self, progress_remaining: float) -> float:
        value: Any = self.value_schedule(progress_remaining)
        value = value.item() if getattr(value, "shape", None) in ((), (1,)) else value
        above = self.above and progress_remaining > 0
        return check_number(f"{self.name} (at progress {progress_remaining:g})", value, self.low, self.high, above)


def check_basics(
    policy: Any, policy_kwargs: Any, stats_window_size: Any, tensorboard_log: Any, verbose: Any, seed: Any, device: Any
) -> None:
    """
    Check arguments that Stable-Baselines3 uses as soon as it has them. Called at construction and again by ``load``.

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


def check_kind(name: str, value: Any, kinds: tuple[type, ...], optional: bool = True) -> None:
    """
    Check the type of an argument.

    :param name: Name of the argument, for the message
    :param value: What the user passed
    :param kinds: The types allowed
    :param optional: Whether None is allowed too
    :raises TypeError: If it is of another type
    """
    if not (isinstance(value, kinds) or (optional and value is None)):
        allowed = [*(kind.__name__ for kind in kinds), *["None"] * optional]
        raise TypeError(f"{name} must be {' or '.join(allowed)}, got {value!r} of type {type(value).__name__}")


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
