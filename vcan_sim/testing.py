"""Waiting in tests, by the clock of the test: virtual or the system's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from skinnode.process import clock


def eventually(
    condition: Callable[[], object], within_s: float = 10.0, *, every_s: float = 0.01, what: str = ""
) -> None:
    """Wait until a condition holds.

    Args:
        condition: Function without arguments; its result counts as true or false.
        within_s: Maximum wait, s.
        every_s: Time between two calls of the condition, s.
        what: What is waited for, for the message.

    Raises:
        AssertionError: The condition does not hold in time.
    """
    end_s = clock.monotonic() + within_s
    while not condition():
        if clock.monotonic() >= end_s:
            name = what or getattr(condition, "__qualname__", repr(condition))
            raise AssertionError(f"not within {within_s:g} s: {name}")
        clock.sleep(every_s)


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Require that a ``with`` block ends in time. It is not interrupted.

    Args:
        seconds: Maximum duration, s.

    Raises:
        AssertionError: The block took longer.
    """
    begin_s = clock.monotonic()
    yield
    took_s = clock.monotonic() - begin_s
    if took_s > seconds:
        raise AssertionError(f"took {took_s:.3g} s, must end within {seconds:g} s")
