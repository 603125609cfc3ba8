"""Lets a program that runs until Ctrl-C end the ordinary way."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Yield an event that a signal to stop sets; handle the signals as before after the block.

    The signals are SIGINT (Ctrl-C), SIGTERM and SIGHUP (the terminal has closed). SIGHUP is left alone if it
    is ignored, as under nohup.

    Raises:
        ValueError: The caller is not the main thread, the only one that Python lets handle signals.
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
