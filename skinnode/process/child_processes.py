"""Starts child processes that are protected from the terminal's signals.

A terminal sends SIGINT (Ctrl-C) and SIGHUP both to a command and to the command's child processes. A child
that receives SIGINT while importing modules would print a traceback. SIGHUP would terminate the resource
tracker of ``multiprocessing`` before the tracker has cleaned up. Child processes therefore run with both
signals blocked, and the command itself terminates them.
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

    A signal that arrives during the block is handled at the end of the block. A child process interrupted
    during its start would print a traceback.
    """
    with _signals_deferred():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
        try:
            resource_tracker.ensure_running()  # this call unblocks SIGINT
            signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Defer the handling of signals to the end of the ``with`` block.

    Blocking the signals in the main thread is not sufficient: another thread can receive a signal, and Python
    then calls the handler on the main thread. Python handles signals only on the main thread, so this
    function does nothing on any other thread.
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
