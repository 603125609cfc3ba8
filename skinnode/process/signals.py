"""Orderly termination of programs that run until Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Yield an event that is set by a stop signal, and restore the previous handlers after the block.

    The stop signals are SIGINT (Ctrl-C), SIGTERM and SIGHUP (terminal closed). SIGHUP stays ignored if it was
    ignored before, as under nohup.

    Raises:
        ValueError: if not called from the main thread, because no other thread can set signal handlers.
    """
    stop = threading.Event()

    def set_stop(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    kept = {number: signal.signal(number, set_stop) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
