"""Ctrl-C and SIGTERM during training: both end it with a ``KeyboardInterrupt``, and neither cuts an update in two."""

import signal
import threading
from collections.abc import Callable
from functools import wraps
from types import FrameType
from typing import Any, ParamSpec, TypeAlias, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Signaled: TypeAlias = tuple[int, FrameType | None]


def interruptible(learn: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """
    While a function runs, SIGTERM raises a ``KeyboardInterrupt``, so that the model can still be saved.

    Only in the main thread, where alone Python handles signals, and only where nobody has set a handler: by default the
    signal would end the process at once. The default is restored afterwards.

    :param learn: A function
    :return: The same function
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    @wraps(learn)
    def interrupted(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if not _in_main_thread() or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
            return learn(*args, **kwargs)
        signal.signal(signal.SIGTERM, interrupt)
        try:
            return learn(*args, **kwargs)
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)

    return interrupted


def uninterrupted(update: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """
    Let a function finish before Ctrl-C or SIGTERM are handled, so that the parameters, the optimizers and the count of
    updates belong together.

    :param update: A function that takes little time
    :return: The same function
    """

    @wraps(update)
    def finish(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if not _in_main_thread():
            return update(*args, **kwargs)
        # A handler that is no function is the system's own, or one of a program in C
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        own: dict[int, Callable[..., Any]] = {number: each for number, each in handlers.items() if callable(each)}
        pending: list[Signaled] = []
        try:
            for number in own:
                signal.signal(number, lambda *signaled: pending.append(signaled))
            return update(*args, **kwargs)
        finally:
            for number, handler in own.items():
                signal.signal(number, handler)
            for number, frame in pending[:1]:
                own[number](number, frame)

    return finish


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
