"""Child processes of a command, and the signals of its terminal.

A terminal sends Ctrl-C (SIGINT) and SIGHUP to the children of a command as well. Python would print a
traceback in a child that still imports, and SIGHUP would end the resource tracker of ``multiprocessing``
before it has cleaned up. So children start with both signals blocked and keep them blocked; the command ends
them.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType
from typing import Final

_OF_A_TERMINAL: Final = (signal.SIGINT, signal.SIGHUP)


@contextmanager
def starting_children() -> Iterator[None]:
    """Start child processes in this ``with`` block. A signal that arrives in it is handled at its end: a
    child that is left half started prints a traceback."""
    with _signals_deferred():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_A_TERMINAL)
        try:
            resource_tracker.ensure_running()  # unblocks SIGINT in this thread if it starts the tracker
            signal.pthread_sigmask(signal.SIG_BLOCK, _OF_A_TERMINAL)
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Handle signals at the end of the ``with`` block. A mask is not enough: another thread can take the
    signal, and Python calls the handler on the main thread then too. Other threads are never interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        arrived.append(number)

    numbers = (*_OF_A_TERMINAL, signal.SIGTERM)
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
