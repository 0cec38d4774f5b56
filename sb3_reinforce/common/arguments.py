"""Checks of what a user passes in: each error names the argument, its value and what is allowed."""

import difflib
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from numbers import Integral, Real
from typing import Any, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

# (name, value) -> value, or an error that names the argument
Check: TypeAlias = Callable[[str, Any], Any]

# A larger step can take a parameter out of the range of float32
MAX_LEARNING_RATE = 1e6


def wrong_type(name: str, allowed: str, value: Any) -> TypeError:
    """Make the error for a value of the wrong type."""
    return TypeError(f"{name} must be {allowed}, got {value!r} of type {type(value).__name__}")


def unknown_name(name: str, allowed: str, names: Iterable[str], value: Any) -> ValueError:
    """Make the error for a name that is none of some, with the nearest one."""
    known = {each.lower(): each for each in names}
    near = difflib.get_close_matches(str(value).lower(), known, n=1, cutoff=0.7)
    hint = f": did you mean {known[near[0]]!r}?" if near else ""
    return ValueError(f"{name} must be {allowed} {', '.join(map(repr, known.values()))}, got {value!r}{hint}")


def check_number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    above: bool = False,
    finite: bool = True,
) -> float:
    """Return a number in the range as a float; with ``above``, ``low`` itself is excluded."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise wrong_type(name, "a number", value)
    number = float(value)
    if (finite and math.isinf(number)) or not low <= number <= high or (above and number == low):
        allowed = "finite"
        if high < math.inf:
            allowed = f"in {'(' if above else '['}{low:g}, {high:g}]"
        elif low > -math.inf:
            allowed = f"{'finite and ' if finite else ''}{'>' if above else '>='} {low:g}"
        raise ValueError(f"{name} must be {allowed}, got {value!r}")
    return number


def check_integer(name: str, value: Any, low: int, high: int = sys.maxsize) -> int:
    """Return an integer in the range as Python's own, since not all libraries take NumPy's."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral):
        raise wrong_type(name, "an integer", value)
    number = int(value)
    if not low <= number <= high:
        allowed = f"at least {low}"
        if high < sys.maxsize or number > high:
            allowed = f"at least {low} and at most {high}"
        raise ValueError(f"{name} must be {allowed}, got {value!r}")
    return number


def check_flag(name: str, value: Any) -> bool:
    """Return True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise wrong_type(name, "True or False", value)
    return bool(value)


def check_choice(name: str, value: Any, choices: tuple[str, ...]) -> str:
    """Return one of some names; the error lists them."""
    if not isinstance(value, str) or value not in choices:
        raise unknown_name(name, "one of", choices, value)
    return value


def check_function(name: str, value: Any, functions: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    """Return the user's own function, or one of ours by its name; the error lists the names."""
    function: Callable[..., Any] | None = value if callable(value) else functions.get(check_name(name, value))
    if function is None:
        raise unknown_name(name, "a callable or one of", functions, value)
    return function


def check_name(name: str, value: Any) -> Any:
    """Return a name or a callable."""
    if not (isinstance(value, str) or callable(value)):
        raise wrong_type(name, "a name or a callable", value)
    return value


def check_kind(name: str, value: Any, kinds: tuple[type, ...]) -> Any:
    """Return an instance of one of some types."""
    if not isinstance(value, kinds):
        raise wrong_type(name, " or ".join(each.__name__ for each in kinds), value)
    return value


def check_subclass(name: str, value: Any, base: type) -> Any:
    """Return a subclass of ``base``."""
    if not (isinstance(value, type) and issubclass(value, base)):
        raise TypeError(f"{name} must be a subclass of {base.__name__}, got {value!r}")
    return value


def check_device(name: str, value: Any) -> Any:
    """Return a device that PyTorch knows, or "auto"."""
    check_kind(name, value, (str, th.device))
    if value != "auto":
        try:
            th.device(value)
        except RuntimeError as error:
            raise ValueError(f"{name} must be 'auto' or a device that PyTorch knows, got {value!r}: {error}") from error
    return value


class CheckedSchedule(FloatSchedule):
    """A number, or a function of the remaining progress (from 1 to 0), whose every value is checked."""

    def __init__(
        self, name: str, schedule: float | Schedule, low: float = 0.0, above: bool = False, high: float = math.inf
    ):
        if not (callable(schedule) or isinstance(schedule, Real)):
            raise wrong_type(name, "a number or a schedule", schedule)
        super().__init__(schedule if callable(schedule) else check_number(name, schedule, low, high, above))
        self.given = schedule
        self.check = partial(check_number, low=low, high=high)
        self.name = name
        self.above = above
        for progress_remaining in (1.0, 0.0):
            self(progress_remaining)

    def __call__(self, progress_remaining: float) -> float:
        value: Any = self.value_schedule(progress_remaining)
        value = value.item() if getattr(value, "shape", None) in ((), (1,)) else value
        # At the end of training nothing is drawn any more, so that a schedule may fall to an excluded bound
        above = self.above and progress_remaining > 0
        return self.check(f"{self.name} (at progress {progress_remaining:g})", value, above=above)


def number(low: float = -math.inf, high: float = math.inf, above: bool = False, finite: bool = True) -> Check:
    """Make a check for a number."""
    return partial(check_number, low=low, high=high, above=above, finite=finite)


def integer(low: int, high: int = sys.maxsize) -> Check:
    """Make a check for an integer."""
    return partial(check_integer, low=low, high=high)


def choice(*names: str) -> Check:
    """Make a check for one of some names."""
    return partial(check_choice, choices=names)


def kind(*kinds: type) -> Check:
    """Make a check for an instance of some types."""
    return partial(check_kind, kinds=kinds)


def schedule(low: float = 0.0, high: float = math.inf, above: bool = False) -> Check:
    """Make a check for a number or a schedule, which returns a ``CheckedSchedule``."""
    return partial(CheckedSchedule, low=low, high=high, above=above)


def optional(check: Check) -> Check:
    """Let a check pass None."""
    return partial(check_unless_none, check=check)


def check_unless_none(name: str, value: Any, check: Check) -> Any:
    """Check a value that may also be None."""
    return None if value is None else check(name, value)
