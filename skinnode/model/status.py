"""Outcome of a solve."""

from __future__ import annotations

import enum
from collections.abc import Iterable


class Status(enum.IntEnum):
    """Outcome of a solve. If the solve did not converge, its result is the best iterate found."""

    CONVERGED = 0
    """The result is a root and passed all checks."""
    MAX_STEPS = 1
    """The maximum number of steps was reached before the tolerance was met."""
    DEADLINE = 2
    """The time limit was reached."""
    RADIUS_TOO_SMALL = 3
    """The trust region became too small, because no step reduced the residual. The iterate is not a root."""
    STEP_TOO_SMALL = 4
    """The steps became smaller than the tolerance, but the iterate is not a root."""
    ILL_CONDITIONED = 5
    """The Jacobian is singular, too few resistances remain, or the root may be on the wrong branch."""
    NON_FINITE = 6
    """A value overflowed, or the resistances were not usable."""
    INVALID_START = 7
    """The function or its Jacobian is not finite at the starting point; `solve_system` returns that point."""
    INCONSISTENT = 8
    """No deformation explains the resistances: χ² is far larger than noise can explain."""


_BY_NUMBER = tuple(Status)


def as_statuses(numbers: Iterable[int]) -> tuple[Status, ...]:
    """Convert integers to statuses; five times as fast as ``map(Status, numbers)``."""
    return tuple(map(_BY_NUMBER.__getitem__, numbers))
