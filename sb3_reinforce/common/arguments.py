"""Checks of what a user passes in: each error names the argument, its value and what is allowed."""

import difflib
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from inspect import Parameter, signature
from numbers import Integral, Real
from typing import Any, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.utils import FloatSchedule

# (name, value) -> value, or an error that names the argument
Check: TypeAlias = Callable[[str, Any], Any]

# A bound that leaves out infinity
MAX = sys.float_info.max
# Larger than the rounding errors of schedules
SCHEDULE_ROUNDING = 1e-12


def check_kind(name: str, value: Any, kinds: tuple[Any, ...], allowed: str = "") -> Any:
    """Return a value of one of the ``kinds``; the error says what is ``allowed``, or names the kinds."""
    # To Python True is a number
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        allowed = allowed or " or ".join(each.__name__ for each in kinds)
        raise TypeError(f"{name} must be {allowed}, got {value!r} of type {type(value).__name__}")
    return value


def unknown_name(name: str, allowed: str, names: Iterable[str], value: Any) -> ValueError:
    """The error for an unknown name, with the known ones and the nearest of them."""
    known = {each.lower(): each for each in names}
    near = difflib.get_close_matches(str(value).lower(), known, n=1, cutoff=0.7)
    hint = f": did you mean {known[near[0]]!r}?" if near else ""
    return ValueError(f"{name} must be {allowed} {', '.join(map(repr, known.values()))}, got {value!r}{hint}")


def check_number(name: str, value: Any, low: float, high: float = MAX, above: bool = False) -> float:
    """Return a number in the range as a float; with ``above``, ``low`` itself is excluded."""
    number = float(check_kind(name, value, (Real,), "a number"))
    if not low <= number <= high or (above and number == low):
        bracket = "(" if above else "["
        sign = ">" if above else ">="
        allowed = f"in {bracket}{low:g}, {high:g}]" if high < MAX else f"finite and {sign} {low:g}"
        if high == math.inf:
            allowed = f"{sign} {low:g} (inf or None for no bound)"
        raise ValueError(f"{name} must be {allowed}, got {value!r}")
    return number


def check_integer(name: str, value: Any, low: int, high: int = sys.maxsize) -> int:
    """Return an integer in the range as Python's own, since not all libraries take NumPy's."""
    number = int(check_kind(name, value, (Integral,), "an integer"))
    if not low <= number <= high:
        allowed = f"at least {low}"
        if high < sys.maxsize or number > high:
            allowed = f"at least {low} and at most {high}"
        raise ValueError(f"{name} must be {allowed}, got {value!r}")
    return number


def check_flag(name: str, value: Any) -> bool:
    """Return True or False."""
    return bool(check_kind(name, value, (bool, np.bool_), "True or False"))


def check_choice(name: str, value: Any, choices: tuple[str, ...]) -> str:
    """Return a name that is one of the choices; the error lists them."""
    if not isinstance(value, str) or value not in choices:
        raise unknown_name(name, "one of", choices, value)
    return value


def check_function(name: str, value: Any, functions: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    """Return the user's own function, or one of ours by its name; the error lists the names."""
    check_kind(name, value, (str, Callable), "a name or a callable")
    function: Callable[..., Any] | None = value if callable(value) else functions.get(value)
    if function is None:
        raise unknown_name(name, "a callable or one of", functions, value)
    return function


def check_subclass(name: str, value: Any, base: type) -> Any:
    """Return a subclass of ``base``."""
    if not (isinstance(value, type) and issubclass(value, base)):
        raise TypeError(f"{name} must be a subclass of {base.__name__}, got {value!r}")
    return value


def check_device(name: str, value: Any) -> Any:
    """Return a device that PyTorch knows, or "auto"."""
    check_kind(name, value, (str, th.device), "'auto', a name such as 'cuda', or a torch.device")
    try:
        return value if value == "auto" else th.device(value)
    except RuntimeError as error:
        raise ValueError(f"{name} must be 'auto' or a device that PyTorch knows, got {value!r}: {error}") from error


class CheckedSchedule(FloatSchedule):
    """
    A number ≥ 0, or a function of the remaining progress (from 1 to 0), whose every value is checked.

    With ``above`` a value may be 0 only at the end of training, or, with ``may_reach_zero``, anywhere after the start.
    """

    def __init__(self, name: str, schedule: Any, high: float = MAX, above: bool = False, may_reach_zero: bool = False):
        check_kind(name, schedule, (Real, Callable), "a number or a schedule")
        super().__init__(schedule if callable(schedule) else check_number(name, schedule, 0, high, above))
        self.given = schedule
        self.name = name
        self.high = high
        self.above = above
        self.may_reach_zero = may_reach_zero
        for progress_remaining in (1.0, 0.0):
            self(progress_remaining)

    def __call__(self, progress_remaining: float) -> float:
        where = f"{self.name} (at progress_remaining={progress_remaining:g})"
        try:
            value: Any = self.value_schedule(progress_remaining)
        except Exception as error:
            raise ValueError(
                f"{where} must be a number or a function of the remaining progress, but calling {self.given!r} raised "
                f"{error!r}"
            ) from error
        value = value.item() if getattr(value, "shape", None) in ((), (1,)) else value
        if isinstance(value, float) and -SCHEDULE_ROUNDING < value < 0:
            # A LinearSchedule that ends at 0 may end below it by rounding
            value = 0.0
        # At the end of training nothing is drawn any more
        is_excluded = progress_remaining == 1 if self.may_reach_zero else progress_remaining > 0
        return check_number(where, value, 0, self.high, self.above and is_excluded)


def optional(check: Check) -> Check:
    """Let a check pass None."""
    return partial(check_unless_none, check=check)


def check_unless_none(name: str, value: Any, check: Check) -> Any:
    """Check a value that may also be None."""
    return None if value is None else check(name, value)


def own_arguments(cls: type, base: type) -> dict[str, Parameter]:
    """The arguments of the constructors from ``cls`` up to but not including ``base``, without env and private ones."""
    classes = reversed(cls.__mro__[: cls.__mro__.index(base)])
    arguments = [each for one in classes for each in signature(one.__init__).parameters.values()]  # type: ignore[misc]
    variadic = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
    named = [each for each in arguments if each.kind not in variadic and not each.name.startswith("_")]
    return {each.name: each for each in named if each.name not in ("self", "env")}
