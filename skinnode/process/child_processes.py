"""Starts child processes that do not receive signals from the terminal.

A terminal sends SIGINT (Ctrl-C) and SIGHUP to a command and to all of its child processes. SIGINT would make
a child print a traceback if it is still importing modules, and SIGHUP would kill the ``multiprocessing``
resource tracker before it has cleaned up. Child processes therefore run with both signals blocked, and the
command terminates them itself.
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
    """Block signals from the terminal for all child processes started in this ``with`` block.

    In this process, a signal that arrives during the block is handled at the end of the block.
    """
    with _signals_deferred():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
        try:
            resource_tracker.ensure_running()  # unblocks SIGINT
            signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Defer signal handling to the end of the ``with`` block.

    Blocking signals in the main thread would not be sufficient: another thread could receive the signal, and
    Python would then call its handler on the main thread. On other threads, this function does nothing,
    because Python never handles signals there.
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
