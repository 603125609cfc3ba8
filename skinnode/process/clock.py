"""Provides time, waiting and threads on the system clock or on a virtual clock.

All code that reads the time, waits or starts threads must use this module, so that it can run in virtual
time. :func:`use` sets the clock of the current thread, and a new thread inherits the clock of the thread that
creates it. By default, the functions call their counterparts in the standard library.
"""

from __future__ import annotations

import queue as queues
import threading
import time as system_time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol


class Clock(Protocol):
    """Source of time, threads and synchronisation objects."""

    def monotonic_ns(self) -> int:
        """Return the monotonic time in ns."""

    def time_ns(self) -> int:
        """Return the Unix time in ns."""

    def sleep(self, seconds: float, /) -> None:
        """Suspend the current thread for ``seconds``."""

    def event(self) -> threading.Event:
        """Create an event that is not set."""

    def queue(self) -> queues.Queue[Any]:
        """Create an empty queue of unlimited size."""

    def simple_queue(self) -> queues.SimpleQueue[Any]:
        """Create an empty queue of unlimited size."""

    def lock(self) -> AbstractContextManager[Any]:
        """Create a lock."""

    def thread(self, target: Callable[..., object], name: str, args: tuple[Any, ...]) -> threading.Thread:
        """Create a daemon thread without starting it."""

    def pool(self, threads: int, name: str) -> Executor:
        """Create a pool of threads."""


class SystemClock:
    """Clock and threads of the operating system."""

    monotonic_ns = staticmethod(system_time.monotonic_ns)
    time_ns = staticmethod(system_time.time_ns)
    sleep = staticmethod(system_time.sleep)
    event = staticmethod(threading.Event)
    lock = staticmethod(threading.Lock)

    def queue(self) -> queues.Queue[Any]:
        """Create an empty queue of unlimited size."""
        return queues.Queue()

    def simple_queue(self) -> queues.SimpleQueue[Any]:
        """Create an empty queue of unlimited size."""
        return queues.SimpleQueue()

    def thread(self, target: Callable[..., object], name: str, args: tuple[Any, ...]) -> threading.Thread:
        """Create a daemon thread without starting it."""
        return threading.Thread(target=target, name=name, args=args, daemon=True)

    def pool(self, threads: int, name: str) -> Executor:
        """Create a pool of threads."""
        return ThreadPoolExecutor(threads, thread_name_prefix=name)


class _Here(threading.local):
    clock: Clock = SystemClock()


_here = _Here()


@contextmanager
def use(clock: Clock) -> Iterator[None]:
    """Use ``clock`` on the current thread, and on the threads it creates, during the ``with`` block."""
    before, _here.clock = _here.clock, clock
    try:
        yield
    finally:
        _here.clock = before


def current() -> Clock:
    """Return the clock of the current thread."""
    return _here.clock


def monotonic_ns() -> int:
    """Return the monotonic time in ns."""
    return _here.clock.monotonic_ns()


def monotonic() -> float:
    """Return the monotonic time in seconds."""
    return _here.clock.monotonic_ns() * 1e-9


def perf_counter() -> float:
    """Return the performance counter in seconds. A virtual clock does not advance during computations."""
    clock = _here.clock
    return system_time.perf_counter() if clock is _SYSTEM else clock.monotonic_ns() * 1e-9


def time_ns() -> int:
    """Return the Unix time in ns."""
    return _here.clock.time_ns()


def time() -> float:
    """Return the Unix time in seconds."""
    return _here.clock.time_ns() * 1e-9


def sleep(seconds: float) -> None:
    """Suspend the current thread for ``seconds``."""
    _here.clock.sleep(seconds)


def event() -> threading.Event:
    """Create a :class:`threading.Event` that is not set."""
    return _here.clock.event()


def queue() -> queues.Queue[Any]:
    """Create an empty :class:`queue.Queue` of unlimited size."""
    return _here.clock.queue()


def simple_queue() -> queues.SimpleQueue[Any]:
    """Create an empty :class:`queue.SimpleQueue`."""
    return _here.clock.simple_queue()


def lock() -> AbstractContextManager[Any]:
    """Create a :class:`threading.Lock`."""
    return _here.clock.lock()


def thread(target: Callable[..., object], name: str, args: tuple[Any, ...] = ()) -> threading.Thread:
    """Create a daemon :class:`threading.Thread` without starting it."""
    return _here.clock.thread(target, name, args)


def pool(threads: int, name: str) -> Executor:
    """Create a :class:`concurrent.futures.ThreadPoolExecutor`.

    To wait for a job, use :meth:`concurrent.futures.Future.add_done_callback`; other ways of waiting do not
    work with a virtual clock.
    """
    return _here.clock.pool(threads, name)


_SYSTEM = _here.clock
