"""Functions for waiting in tests, in virtual time or real time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from skinnode.process import clock


def eventually(
    condition: Callable[[], object], within_s: float = 10.0, *, every_s: float = 0.01, what: str = ""
) -> None:
    """Wait until a condition is true.

    Args:
        condition: Function without arguments. Its result is interpreted as true or false.
        within_s: Maximum wait, s.
        every_s: Time between two calls of ``condition``, s.
        what: Description of the condition, for the error message.

    Raises:
        AssertionError: If the condition is not true within ``within_s``.
    """
    end_s = clock.monotonic() + within_s
    while not condition():
        if clock.monotonic() >= end_s:
            name = what or getattr(condition, "__qualname__", repr(condition))
            raise AssertionError(f"condition not true within {within_s:g} s: {name}")
        clock.sleep(every_s)


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Check that a ``with`` block takes no longer than a maximum duration; the block is not interrupted.

    Args:
        seconds: Maximum duration, s.

    Raises:
        AssertionError: If the block takes longer.
    """
    begin_s = clock.monotonic()
    yield
    took_s = clock.monotonic() - begin_s
    if took_s > seconds:
        raise AssertionError(f"took {took_s:.3g} s, must end within {seconds:g} s")
