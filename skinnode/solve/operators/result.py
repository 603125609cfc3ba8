"""Result of ``solve_system``. The statuses are the same as for a displacement field."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float
from skinnode.model.status import Status

__all__ = ["PointKind", "Solution", "SolveStats", "Status"]


class PointKind(enum.Enum):
    """Kind of point at which ``solve_system`` stopped."""

    ROOT = "root"
    """r is zero to within ``tol_f`` or the error due to rounding of x."""
    MINIMUM = "minimum"
    """‖r‖ has an isolated minimum above zero: Jᵀr is zero, and the Hessian of ½ ‖r‖² is positive definite."""
    FLAT = "flat"
    """Jᵀr is zero, r is not, and ‖r‖ is constant in some direction."""
    SADDLE = "saddle"
    """Jᵀr is zero, r is not, and ‖r‖ decreases in some direction."""
    UNFINISHED = "unfinished"
    """Neither r nor Jᵀr is zero, or the point was not classified."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Outcome of ``solve_system``: the best iterate found, regardless of the status."""

    x: Float
    """(n,) best iterate."""
    status: Status
    """Status of the solve.

    CONVERGED means a root or, with more equations than unknowns, a minimum. ILL_CONDITIONED means a point
    that the equations do not determine, or a minimum of a square system with r ≠ 0.
    """
    kind: PointKind
    """Kind of the point ``x``."""
    residual_norm: float
    """‖r‖₂ at ``x``."""
    optimality: float
    """First-order optimality ‖Jᵀr‖∞ at ``x``."""
    error_estimate: float
    """Estimate of max |x − x*|, where x* is the exact solution; inf unless CONVERGED.

    It is the sum of the last Newton correction and the error due to rounding, which grows with the condition
    number of J or, at a minimum, of the Hessian.
    """
    stats: SolveStats
