"""Precision of a field: whether its standard deviations are within the user's limits.

The default limit for the displacement is the root-sum-square of two terms: :data:`MULTIPLE` times the
standard deviation of the exact inverse at rest, and a term for the manufacturing tolerances. This limit is at
most :data:`MOST` times the clearance. A healthy patch stays below the default limit. Lost readings, or more
noise than stated, can raise the standard deviations above it.
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
"""Default limit on a standard deviation, as a multiple of the exact inverse's RMS standard deviation at rest.

In 2,640 simulated fields of healthy patches (ten layouts, relative noise 3e-6 to 1e-3, presses of 5 to 30 %
of h), the largest ratio was 12.2.
"""
MOST: Final = 0.3
"""Upper bound on the default limit, in clearances; larger standard deviations mean that the prior dominates
the displacement.

Of the 2,640 fields described at :data:`MULTIPLE`, only those with h = 1 and a relative noise of 1e-3 exceeded
this bound.
"""
TOLERANCE_SHARE: Final = 0.06
"""Term of the default limit for ordinary manufacturing tolerances, in clearances.

For other tolerances, the term is scaled by the largest ratio of a tolerance to its ordinary value. In
simulated presses with a relative noise of at most 1e-5, ordinary tolerances caused standard deviations of up
to 0.028 clearances.
"""
FORCE_SHARE: Final = 0.3
"""Default limit on a normal force's standard deviation, in units of modulus · clearance · pitch.

In the fields described at :data:`MULTIPLE`, this value was at most 0.1. It reached 0.26 in presses of 50 % of
h that were half outside the patch.
"""


@dataclass(frozen=True, slots=True)
class PrecisionLimits:
    """Maximum standard deviations in a precise field; inf for no limit."""

    std_m: float
    """Limit for each coordinate of the displacement, in metres."""
    force_std_n: float
    """Limit for each calibrated normal force, in N."""
    uncalibrated_force_std_n: float
    """Limit for each uncalibrated normal force, in N."""


def limits_of(layout: PatchLayout, options: TrackerOptions) -> PrecisionLimits:
    """Return the user's limits, or the default limits where the user set none.

    There is no default limit for uncalibrated forces.

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
    """Return the RMS standard deviation of the exact inverse at rest, in clearances.

    Returns inf if a wire has fewer resistances than unknowns.
    """
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
    """Return the largest ratio of a tolerance to its ordinary value; 0 for an exact patch."""
    if tolerances is None:
        return 0.0
    ordinary = astuple(ORDINARY)
    return float(max(own / usual for own, usual in zip(astuple(tolerances), ordinary, strict=True)))
