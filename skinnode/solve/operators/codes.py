"""Numbers that identify operators and statuses in compiled code, and limits set by rounding."""

from __future__ import annotations

from typing import Final

import numpy as np

from skinnode.model.status import Status

OPERATORS: Final = {"gauss_newton": 0, "levenberg_marquardt": 1, "dogleg": 2}
GAUSS_NEWTON: Final = OPERATORS["gauss_newton"]
LEVENBERG_MARQUARDT: Final = OPERATORS["levenberg_marquardt"]

# Negative results of a step, after which the solve continues; a Status that ends the solve is ≥ 0
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
"""Maximum error estimate of a root, relative to max(1, ‖x‖∞); at this limit, half of the digits are
determined."""
MINIMUM_SHARE: Final = EPS ** (1 / 3)
"""Maximum error estimate of a minimum, relative to max(1, ‖x‖∞). The limit is larger than for a root, because
‖r‖² determines x only to √eps."""
STATIONARY: Final = 1e-6
"""Maximum gradient, relative to ‖J_j‖ ‖r‖, that is treated as zero.

Because of rounding, a smaller gradient cannot be distinguished from zero.
"""
STALL_LIMIT: Final = 30
"""Maximum number of steps for refining x in a tall system while ‖r‖² changes only by rounding."""
