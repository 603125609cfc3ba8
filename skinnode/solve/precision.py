"""Precision of a field: whether its standard deviations are within the user's limits.

The default limit for the displacement depends on the layout, the noise and the tolerances. The default limit
is the root sum square of two terms: :data:`MULTIPLE` times the standard deviation of the exact inverse at
rest, and a term for the tolerances. The limit never exceeds :data:`MOST` times the clearance. The standard
deviations of a healthy patch are below the default limit; if readings are lost or the noise is higher than
stated, they can exceed it.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from skinnode.model.elastic import Rubber
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.model.tolerances import ORDINARY, Tolerances
from skinnode.solve.cramer_rao import patch_std
from skinnode.solve.options import TrackerOptions
from skinnode.solve.wires.problem import PatchProblem

MULTIPLE: Final = 15.0
"""Maximum standard deviation, as a multiple of the exact inverse's RMS standard deviation at rest. In 2,640
fields of healthy patches (ten layouts, relative noise from 3e-6 to 1e-3, presses from 5 to 30 %), the largest
standard deviation was 12.2 times this RMS."""
MOST: Final = 0.3
"""Maximum standard deviation, in clearances, for layouts and noise levels at which the displacement mainly
depends on the prior. Of the 2,640 fields described at :data:`MULTIPLE`, only fields of thick patches (h = 1)
with a relative noise of 1e-3 exceeded the limit of 0.3 clearances."""
TOLERANCE_SHARE: Final = 0.06
"""Contribution of ordinary manufacturing tolerances to the limit, in clearances. For other tolerances, the
contribution is scaled with the largest tolerance. In presses with a relative noise of at most 1e-5, ordinary
tolerances caused standard deviations of up to 0.028 clearances."""
FORCE_SHARE: Final = 0.3
"""Maximum standard deviation of a normal force, divided by the product of modulus, clearance and pitch.

In the fields described at :data:`MULTIPLE`, the force ratio was at most 0.1. In presses of 50 % that were
half outside the patch, the force ratio reached 0.26.
"""


@dataclass(frozen=True, slots=True)
class PrecisionLimits:
    """Largest standard deviations of a precise field; inf for no limit."""

    std_m: float
    """Limit for each coordinate of the displacement, metres."""
    force_std_n: float
    """Limit for the normal force of each contact whose force is calibrated, N."""
    uncalibrated_force_std_n: float
    """Limit for the normal force of each contact whose force is not calibrated, N."""


def limits_of(layout: PatchLayout, options: TrackerOptions) -> PrecisionLimits:
    """Return the user's limits, or the defaults for the layout and the noise.

    By default, uncalibrated forces have no limit; ``Contact.force_calibrated`` shows whether a force is
    calibrated.

    Args:
        layout: The patch.
        options: Options of the tracker.
    """
    std_m, force_std_n = options.max_std_m, options.max_force_std_n
    if std_m is not None and force_std_n is not None:
        return PrecisionLimits(std_m, force_std_n, force_std_n)
    clearance_m = float(PatchProblem.of(layout).clearance.min()) * layout.pitch_m
    if std_m is None:
        share = math.hypot(
            MULTIPLE * _at_rest(layout, options), TOLERANCE_SHARE * _looseness(options.tolerances)
        )
        std_m = clearance_m * min(share, MOST)
    if force_std_n is not None:
        return PrecisionLimits(std_m, force_std_n, force_std_n)
    modulus_pa = (options.rubber or Rubber()).contact_modulus_pa
    return PrecisionLimits(std_m, FORCE_SHARE * modulus_pa * clearance_m * layout.pitch_m, math.inf)


def is_precise(field: FieldFrame, limits: PrecisionLimits) -> bool:
    """Return whether the standard deviations of a field are within the limits."""
    if not field.displacement_std_m.max() <= limits.std_m:
        return False
    return all(
        contact.normal_force_std_n
        <= (limits.force_std_n if contact.force_calibrated else limits.uncalibrated_force_std_n)
        for contact in field.contacts
    )


def _at_rest(layout: PatchLayout, options: TrackerOptions) -> float:
    """Return the standard deviation of the exact inverse at rest, in clearances, or inf."""
    unknowns = layout.unknowns // 3 if options.normal_only else layout.unknowns
    if layout.shape[1] < unknowns:
        return math.inf
    noise, codes = options.relative_noise, options.codes
    if codes is not None:
        measured = np.isfinite(codes.baseline_ohm) & (codes.baseline_ohm > 0)
        rounding = codes.rounding_ohm[measured] / codes.baseline_ohm[measured]
        noise = np.hypot(noise, math.sqrt(float((rounding**2).mean())) if rounding.size else 0.0)
    return patch_std(layout, noise, options.normal_only)


def _looseness(tolerances: Tolerances | None) -> float:
    """Return the largest ratio of a tolerance to the ordinary tolerance; 0 for an exact patch."""
    if tolerances is None:
        return 0.0
    ordinary = astuple(ORDINARY)
    return float(max(own / usual for own, usual in zip(astuple(tolerances), ordinary, strict=True)))
