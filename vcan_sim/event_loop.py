""":mod:`asyncio` event loop that runs in virtual time."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from contextvars import Context
from typing import Any, TypeVar, TypeVarTuple

from skinnode.process import clock

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine like :func:`asyncio.run`, in real or virtual time, depending on the thread's clock.

    In virtual time, the event loop waits only for timers and for callbacks from other threads. In each
    iteration, it polls sockets and pipes without waiting for them.

    Args:
        main: Coroutine to run.

    Returns:
        Result of the coroutine.
    """
    virtual = not isinstance(clock.current(), clock.SystemClock)
    with asyncio.Runner(loop_factory=VirtualEventLoop if virtual else None) as runner:
        return runner.run(main)


class VirtualEventLoop(asyncio.SelectorEventLoop):
    """Event loop of a thread in virtual time."""

    def __init__(self) -> None:
        self._woken = clock.event()
        super().__init__(_Selector(self._woken.wait, self._woken.clear))

    def time(self) -> float:
        """Return the monotonic time of the thread, in s."""
        return clock.monotonic()

    def call_soon_threadsafe(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        """Schedule a callback from any thread, and wake the event loop."""
        handle = super().call_soon_threadsafe(callback, *args, context=context)
        self._woken.set()
        return handle


class _Selector(selectors.DefaultSelector):
    """Selector that waits for an event instead of file descriptors."""

    def __init__(self, wait: Callable[[float | None], bool], clear: Callable[[], None]) -> None:
        super().__init__()
        self._wait, self._clear = wait, clear

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None or timeout > 0:
            self._wait(timeout)
        self._clear()
        return super().select(0)
