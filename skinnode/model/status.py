"""How a solve ended."""

from __future__ import annotations

import enum


class Status(enum.IntEnum):
    """How a solve ended. Every status but CONVERGED comes with the best iterate found."""

    CONVERGED = 0
    MAX_STEPS = 1
    DEADLINE = 2
    RADIUS_TOO_SMALL = 3
    STEP_TOO_SMALL = 4
    ILL_CONDITIONED = 5
    NON_FINITE = 6
    INVALID_START = 7
    INCONSISTENT = 8
    """No deformation explains the resistances: χ² far above what their noise allows."""
