"""Shuts programs down cleanly when they receive a termination signal."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from queue import Empty
from types import FrameType

from skinnode.process import clock


class SignalEvent(threading.Event):
    """Event that can be set in a signal handler.

    ``threading.Event`` cannot: if the signal interrupts ``wait`` while it holds the event's lock, ``set``
    blocks forever. This class is based on ``SimpleQueue.put``, which is reentrant. In virtual time, ``wait``
    takes virtual time.
    """

    def __init__(self) -> None:
        super().__init__()
        self._is_set = False
        self._wake = clock.simple_queue()

    def is_set(self) -> bool:
        """Return whether the event has been set."""
        return self._is_set

    def set(self) -> None:
        """Set the event permanently."""
        self._is_set = True
        self._wake.put(None)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait up to ``timeout`` seconds for the event to be set; return whether it is set."""
        if not self._is_set:
            with suppress(Empty):
                self._wake.get(timeout=None if timeout is None else max(0.0, timeout))
                self._wake.put(None)  # wakes the next waiting thread
        return self._is_set


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Yield an event that is set by SIGINT (Ctrl-C), SIGTERM or SIGHUP (terminal closed).

    If SIGHUP is ignored on entry, as under nohup, it stays ignored. The previous signal handlers are restored
    on exit.

    Raises:
        ValueError: If the function is not called on the main thread.
    """
    stop = SignalEvent()

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
