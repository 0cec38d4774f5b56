"""Ctrl-C and SIGTERM during training: both end it with a ``KeyboardInterrupt``, and neither cuts an update in two."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ContextDecorator, ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import Any


class Uninterrupted(ContextDecorator):
    """A block, or a function that takes little time, which is finished before Ctrl-C or SIGTERM are handled."""

    depth = 0

    def __init__(self) -> None:
        self.pending: list[Callable[[], Any]] = []

    def __enter__(self) -> None:
        if in_main_thread():
            self.depth += 1

    def __exit__(self, *error: object) -> None:
        if not in_main_thread():
            return
        self.depth -= 1
        if self.pending and not self.depth:
            pending, self.pending = self.pending, []
            with ExitStack() as stack:
                # All of them, also where one raises
                for handle in reversed(pending):
                    stack.callback(handle)

    def handle(self, handler: Callable[..., Any], number: int, frame: FrameType | None) -> None:
        """
        Handle a signal, now or at the end of the block.

        :param handler: What handles it
        :param number: The signal
        :param frame: Where it came
        """
        if self.depth:
            self.pending.append(partial(handler, number, frame))
        else:
            handler(number, frame)


# Python handles signals in the main thread alone, so that one is enough
uninterrupted = Uninterrupted()


@contextmanager
def interruptible() -> Iterator[None]:
    """
    Within the block, SIGTERM raises a ``KeyboardInterrupt``, so that the model can still be saved; by default it would
    end the process at once. Where somebody handles it otherwise, that is left so.
    """
    own: dict[int, tuple[Any, Any]] = {}
    for number in (signal.SIGINT, signal.SIGTERM) if in_main_thread() else ():
        handler = before = signal.getsignal(number)
        if number == signal.SIGTERM and before is signal.SIG_DFL:
            handler = signal.default_int_handler
        if callable(handler):
            own[number] = before, partial(uninterrupted.handle, handler)
            signal.signal(number, own[number][1])
    try:
        yield
    finally:
        for changed, (before, during) in own.items():
            # A callback may have set another handler, for good
            if signal.getsignal(changed) is during:
                signal.signal(changed, before)


def in_main_thread() -> bool:
    """Whether this is the thread that handles signals."""
    return threading.current_thread() is threading.main_thread()
