"""The result of solving any system. Statuses are those of the model."""

from __future__ import annotations

from dataclasses import dataclass

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float
from skinnode.model.status import Status

__all__ = ["Solution", "SolveStats", "Status"]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """How ``solve_system`` ended, with the best iterate found, whatever the status."""

    x: Float
    """(n,) the best iterate."""
    status: Status
    residual_norm: float
    """‖r‖₂ at ``x``."""
    optimality: float
    """First-order optimality ‖Jᵀr‖∞ at ``x``."""
    error_estimate: float
    """Estimate of max |x − x*|: the Newton correction still to come plus what rounding of F leaves open
    through the condition of J. Inf if no root or minimum was found."""
    stats: SolveStats
