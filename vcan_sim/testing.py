"""Wait functions for tests, in virtual or real time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from skinnode.process import clock


def eventually(
    condition: Callable[[], object], within_s: float = 10.0, *, every_s: float = 0.01, what: str = ""
) -> None:
    """Wait until a condition is true.

    Args:
        condition: Function without arguments that returns a true or false value.
        within_s: Maximum wait, in s.
        every_s: Interval between calls of ``condition``, in s.
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
    """Check a time limit at the end of a ``with`` block. The block is not interrupted.

    Args:
        seconds: Maximum duration, in s.

    Raises:
        AssertionError: If the block takes longer than ``seconds``.
    """
    begin_s = clock.monotonic()
    yield
    took_s = clock.monotonic() - begin_s
    if took_s > seconds:
        raise AssertionError(f"took {took_s:.3g} s, must end within {seconds:g} s")
