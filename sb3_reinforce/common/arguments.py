"""Checks of what a user passes in: each error names the argument, its value and what is allowed."""

import math
import sys
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np
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


def check_integer(name: str, value: Any, low: int, high: int = sys.maxsize) -> int:
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
        at_most = f" and at most {high}" * (high < sys.maxsize or number > high)
        raise ValueError(f"{name} must be at least {low}{at_most}, got {value!r}")
    return number


def as_integers(model: Any, lows: Mapping[str, int]) -> None:
    """
    Check attributes of a model that are integers, and make Python's own integers of NumPy's, which not all take.

    :param model: An algorithm with its arguments as attributes
    :param lows: The smallest allowed value of each
    :raises TypeError: If one is not an integer
    :raises ValueError: If one is not in its range
    """
    for name, low in lows.items():
        setattr(model, name, check_integer(name, getattr(model, name), low))


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
