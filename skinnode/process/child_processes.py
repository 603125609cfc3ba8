"""Starts child processes that survive signals from the command's terminal.

A terminal sends SIGINT (Ctrl-C) and SIGHUP not only to a command but also to its children. On SIGINT, a child
that is still importing modules would print a traceback, and SIGHUP would end the resource tracker of
``multiprocessing`` before it has cleaned up. Children therefore start with both signals blocked and keep them
blocked; the command itself ends the children.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType
from typing import Final

_TERMINAL_SIGNALS: Final = (signal.SIGINT, signal.SIGHUP)


@contextmanager
def starting_children() -> Iterator[None]:
    """Block the terminal's signals for child processes started in this ``with`` block.

    A signal that arrives during the block is handled at the end of the block, because a child interrupted
    during its start would print a traceback.
    """
    with _signals_deferred():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
        try:
            resource_tracker.ensure_running()  # starting the tracker unblocks SIGINT in this thread
            signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Defer the handling of signals to the end of the ``with`` block.

    A signal mask is not enough: another thread can receive the signal, and Python still calls the handler on
    the main thread. Other threads are never interrupted, so they need no deferral.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        arrived.append(number)

    numbers = (*_TERMINAL_SIGNALS, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}
    handled = {number: handler for number, handler in before.items() if callable(handler)}
    for number in handled:
        signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)
        if arrived:
            signal.raise_signal(arrived[0])
