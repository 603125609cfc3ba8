"""Result of ``solve_system``, which uses the same statuses as a skin's displacement field."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float
from skinnode.model.status import Status

__all__ = ["PointKind", "Solution", "SolveStats", "Status"]


class PointKind(enum.Enum):
    """Type of the point at which ``solve_system`` stopped."""

    ROOT = "root"
    """The residual r is zero within ``tol_f`` or within the error due to rounding of x."""
    MINIMUM = "minimum"
    """‖r‖ has an isolated minimum above zero: Jᵀr is zero, and the Hessian of ½ ‖r‖² is positive definite."""
    FLAT = "flat"
    """Jᵀr is zero, but r is not zero, and ‖r‖ is constant in some direction."""
    SADDLE = "saddle"
    """Jᵀr is zero, but r is not zero, and ‖r‖ decreases in some direction (a saddle point)."""
    UNFINISHED = "unfinished"
    """Neither r nor Jᵀr is zero at this point."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Outcome of ``solve_system``: the best iterate found, regardless of the status."""

    x: Float
    """(n,) best iterate."""
    status: Status
    """Status of the solve. The status is CONVERGED at a root and, if there are more equations than unknowns,
    at a minimum. The status is ILL_CONDITIONED at a point that the equations do not determine, and at a
    minimum of a square system with r ≠ 0."""
    kind: PointKind
    """Type of the point: root, minimum or neither."""
    residual_norm: float
    """‖r‖₂ at ``x``."""
    optimality: float
    """First-order optimality ‖Jᵀr‖∞ at ``x``."""
    error_estimate: float
    """Estimate of max |x − x*|; inf unless CONVERGED.

    The error estimate is the sum of the last Newton correction and the error due to rounding of x, which
    grows with the condition number of J or, at a minimum, of the Hessian.
    """
    stats: SolveStats
