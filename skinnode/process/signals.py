"""Orderly shutdown of programs that run until Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from types import FrameType


class SignalEvent(threading.Event):
    """Event that a signal handler can safely set.

    Both ``wait`` and ``set`` of ``threading.Event`` acquire the event's lock. If a signal interrupts ``wait``
    while the lock is held, a signal handler that calls ``set`` blocks forever. This class uses
    ``SimpleQueue.put`` instead, which is reentrant.
    """

    def __init__(self) -> None:
        super().__init__()
        self._is_set = False
        self._wake: SimpleQueue[None] = SimpleQueue()

    def is_set(self) -> bool:
        """Return whether the event has been set."""
        return self._is_set

    def set(self) -> None:
        """Set the event permanently."""
        self._is_set = True
        self._wake.put(None)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the event for at most ``timeout`` seconds; return whether the event is set."""
        if not self._is_set:
            with suppress(Empty):
                self._wake.get(timeout=None if timeout is None else max(0.0, timeout))
                self._wake.put(None)  # wake up the next waiting thread
        return self._is_set


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Yield an event that is set by any stop signal; restore the previous signal handlers on exit.

    The stop signals are SIGINT (Ctrl-C), SIGTERM and SIGHUP (terminal closed). SIGHUP remains ignored if it
    was already ignored on entry, as under nohup.

    Raises:
        ValueError: The caller is not in the main thread; only the main thread can set signal handlers.
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
