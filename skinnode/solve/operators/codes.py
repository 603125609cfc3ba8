"""Operator and status codes of the compiled code, and tolerances for rounding errors."""

from __future__ import annotations

from typing import Final

import numpy as np

from skinnode.model.status import Status

OPERATORS: Final = {"gauss_newton": 0, "levenberg_marquardt": 1, "dogleg": 2}
GAUSS_NEWTON: Final = OPERATORS["gauss_newton"]
LEVENBERG_MARQUARDT: Final = OPERATORS["levenberg_marquardt"]

# A step returns one of these negative codes if the solve continues, or a Status (≥ 0) if the solve ends
TRY: Final = -1
ACCEPTED: Final = -2
REJECTED: Final = -3
OUTSIDE: Final = -4

CONVERGED: Final = int(Status.CONVERGED)
MAX_STEPS: Final = int(Status.MAX_STEPS)
RADIUS_TOO_SMALL: Final = int(Status.RADIUS_TOO_SMALL)
STEP_TOO_SMALL: Final = int(Status.STEP_TOO_SMALL)
ILL_CONDITIONED: Final = int(Status.ILL_CONDITIONED)
NON_FINITE: Final = int(Status.NON_FINITE)
INVALID_START: Final = int(Status.INVALID_START)

EPS: Final = float(np.finfo(np.float64).eps)
ROOT_SHARE: Final = EPS ** (1 / 2)
"""Maximum estimated error of a root x, relative to max(1, ‖x‖∞). With √eps, half of the digits are
correct."""
MINIMUM_SHARE: Final = EPS ** (1 / 3)
"""Maximum estimated error of a minimum x of ‖r‖, relative to max(1, ‖x‖∞).

The limit is larger than for a root, because rounding of ‖r‖² hides relative changes of √eps in x.
"""
STATIONARY: Final = 1e-6
"""Fraction of ‖J_j‖ ‖r‖ below which component j of the gradient Jᵀr counts as zero (rounding error)."""
STALL_LIMIT: Final = 30
"""Maximum number of steps in which ‖r‖² changes only by rounding errors, for a tall system (m > n)."""
