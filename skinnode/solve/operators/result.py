"""Result of solving a system of equations, with the statuses of the model."""

from __future__ import annotations

from dataclasses import dataclass

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float
from skinnode.model.status import Status

__all__ = ["Solution", "SolveStats", "Status"]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Outcome of ``solve_system``, with the best iterate found, whatever the status."""

    x: Float
    """(n,) best iterate."""
    status: Status
    residual_norm: float
    """‖r‖₂ at ``x``."""
    optimality: float
    """First-order optimality ‖Jᵀr‖∞ at ``x``."""
    error_estimate: float
    """Estimate of max |x − x*|: the remaining Newton correction plus the effect of rounding F, amplified
    by the condition number of J; inf if no root or minimum was found."""
    stats: SolveStats
