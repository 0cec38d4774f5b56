"""Checks of what a user passes in: each error names the argument, its value and what is allowed."""

import math
from collections.abc import Callable
from numbers import Integral, Real
from typing import Any

import numpy as np
from gymnasium import spaces
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


def check_integer(name: str, value: Any, low: int) -> int:
    """
    Return ``value`` as an int if it is an integer of at least ``low``.

    :param name: Name of the argument, for the message
    :param value: What the user passed
    :param low: Smallest allowed value
    :return: The value
    :raises TypeError: If ``value`` is not an integer
    :raises ValueError: If ``value`` is smaller than ``low``
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be an integer, got {value!r} of type {type(value).__name__}")
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value!r}")
    return int(value)


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


class CheckedSchedule(FloatSchedule):
    """
    A schedule whose every value is checked, so that a wrong one is named and not trained with.

    :param name: Name of the argument, for the message
    :param schedule: A number, or a function of the progress that remains (from 1 to 0)
    :param low: Smallest allowed value
    :param above: Exclude ``low`` itself, but not at the end of training (progress 0), when nothing is drawn any more:
        a schedule may fall to it
    :raises TypeError: If ``schedule`` is neither a number nor callable
    :raises ValueError: If its value at the start or at the end of training is not finite or not in the range
    """

    def __init__(self, name: str, schedule: float | Schedule, low: float = 0.0, above: bool = False):
        super().__init__(schedule if callable(schedule) else check_number(name, schedule, low, above=above))
        self.name, self.low, self.above = name, low, above
        for progress_remaining in (1.0, 0.0):
            self(progress_remaining)

    def __call__(self, progress_remaining: float) -> float:
        value = self.value_schedule(progress_remaining)
        value = value.item() if hasattr(value, "item") else value
        above = self.above and progress_remaining > 0
        return check_number(f"{self.name} (at progress {progress_remaining:g})", value, self.low, above=above)


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
    parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
    for key, space in parts.items():
        where = f" under {key!r}" if key else ""
        if not isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            raise ValueError(
                f"The observation space{where} must be Box, Discrete, MultiDiscrete, MultiBinary or a Dict of these, "
                f"got {space}"
            )
        if np.any(getattr(space, "start", 0)):
            raise ValueError(f"The observation space{where} must start at 0, got {space}: subtract its start")


def check_finite(name: str, values: Any, where: tuple[int, ...] = ()) -> None:
    """
    Check numbers that came from an environment.

    :param name: What they are, for the message
    :param values: An array of shape ``(n_steps, n_envs, ...)`` less the dimensions in ``where``, or a dict of them
    :param where: The step, or the step and the environment, that ``values`` belong to
    :raises ValueError: Naming the first step and environment where a number is not finite
    """
    if isinstance(values, dict):
        for key, part in values.items():
            check_finite(f"{name} {key!r}", part, where)
        return
    values = np.asarray(values)
    if values.dtype.kind != "f" or np.isfinite(values).all():
        return
    first = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
    step, env = (*where, *first)[:2]
    raise ValueError(
        f"{name} of environment {env} at step {step} of the rollout is not finite: {values[first]}. "
        "The policy has not been updated with this rollout."
    )


def check_learn(total_timesteps: Any, log_interval: Any) -> None:
    """
    Check the arguments of ``learn`` that both algorithms have.

    :param total_timesteps: Environment steps
    :param log_interval: Updates between two entries of the log; None for no log
    :raises TypeError: If one is not a number
    :raises ValueError: If one is out of its range
    """
    check_number("total_timesteps", total_timesteps, 0)
    if log_interval is not None:
        check_integer("log_interval", log_interval, 1)
