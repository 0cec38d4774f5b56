"""Ctrl-C and SIGTERM during training: both end it with a ``KeyboardInterrupt``, and neither cuts an update in two."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ContextDecorator, ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import Any


class Uninterrupted(ContextDecorator, threading.local):
    """A block, or a short function, that is finished before Ctrl-C or SIGTERM are handled."""

    # Signals arrive in the main thread, and blocks of other threads must not delay them: each thread has its own depth
    depth = 0

    def __init__(self) -> None:
        # An exit stack calls all of its functions, even if one raises
        self.pending = ExitStack()

    def __enter__(self) -> None:
        self.depth += 1

    def __exit__(self, *error: object) -> None:
        self.depth -= 1
        if not self.depth:
            self.pending.close()

    def handle_signal(self, handler: Callable[..., Any], number: int, frame: FrameType | None) -> None:
        """Call a handler now or at the end of the block."""
        if self.depth:
            self.pending.callback(handler, number, frame)
        else:
            handler(number, frame)


uninterrupted = Uninterrupted()


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise ``KeyboardInterrupt`` on SIGTERM too, unless the user handles it; neither it nor Ctrl-C cuts an update."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    with ExitStack() as replaced:
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.getsignal(number)
            is_default_end = number == signal.SIGTERM and before is signal.SIG_DFL
            handler = signal.default_int_handler if is_default_end else before
            if in_main_thread and callable(handler):
                replaced.callback(signal.signal, number, before)
                signal.signal(number, partial(uninterrupted.handle_signal, handler))
        yield
