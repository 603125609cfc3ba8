"""Orderly termination of programs that run until Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from types import FrameType


class SignalEvent(threading.Event):
    """Event that a signal handler may set.

    ``threading.Event.set`` takes a lock. If the interrupted thread holds that lock, in ``wait``, a handler
    that sets the event waits forever. ``SimpleQueue.put`` is made for handlers.
    """

    def __init__(self) -> None:
        super().__init__()
        self._is_set = False
        self._wake: SimpleQueue[None] = SimpleQueue()

    def is_set(self) -> bool:
        """Return whether the event was set."""
        return self._is_set

    def set(self) -> None:
        """Set the event for good."""
        self._is_set = True
        self._wake.put(None)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the event is set, or ``timeout`` seconds; return whether it is set."""
        if not self._is_set:
            with suppress(Empty):
                self._wake.get(timeout=None if timeout is None else max(0.0, timeout))
                self._wake.put(None)  # for other threads that wait
        return self._is_set


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Yield an event that is set by a stop signal, and restore the previous handlers after the block.

    The stop signals are SIGINT (Ctrl-C), SIGTERM and SIGHUP (terminal closed). SIGHUP stays ignored if it was
    ignored before, as under nohup.

    Raises:
        ValueError: if not called from the main thread, because no other thread can set signal handlers.
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
