"""Dimensionless equations of a patch: one system of equations per upper wire.

Lengths are in pitches. The residuals are r_k = w_k (a_k F_k − 1). The scaled resistances are
a_k = R_k / (R₀ F₀)_k, where R₀ and F₀ are the values of R and F at rest. If R₀ was measured, errors in the
resistivity and in the front end's gain cancel; otherwise, R₀ F₀ is computed from the resistivity of the
layout. With the weights w_k = σ_min / σ_k, the least-squares solution minimises χ². An equation with weight 0
is ignored.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.forward import potential_per_m
from skinnode.model.kernels import lower_rows
from skinnode.model.layout import Float, PatchLayout, require_array

TRUST_SHARE: Final = 0.25
"""Initial trust radius, relative to the smallest clearance between the layers at rest.

Within this radius, F is nearly linear. From one frame of a live stream to the next, the skin moves less than
this radius.
"""


@dataclass(frozen=True, eq=False)
class PatchProblem:
    """Geometry and rest resistances of a patch in solver units: lengths in pitches, scaled resistances."""

    layout: PatchLayout
    rest: Float
    """(U, 3N) positions of the upper electrodes at rest, in pitches."""
    lower: Float
    """(3, M, K) positions of the lower electrodes, in pitches."""
    gain: Float
    """(U, K) factors 1 / (R₀ F₀) that convert resistances in ohms to scaled resistances."""
    a_rest: Float
    """(U, K) scaled resistances at rest, 1 / F₀."""
    share_at_rest: Float
    """(U, N, K) contribution of each upper electrode to F at rest."""
    clearance: Float
    """(U, N) distance of each upper electrode from the nearest lower electrode at rest, in pitches."""

    @classmethod
    def of(cls, layout: PatchLayout, baseline_ohm: ArrayLike | None = None) -> PatchProblem:
        """Convert a patch to solver units.

        Args:
            layout: The patch.
            baseline_ohm: (U, K) resistances measured at rest, in ohms; by default, they are computed from the
                resistivity of the layout.

        Raises:
            ValueError: If ``baseline_ohm`` has the wrong shape or contains a value that is not positive and
                finite.
        """
        pitch = layout.pitch_m
        rest, lower, potential, share, clearance = _at_rest(layout)
        gain = np.full(layout.shape, 1.0 / (layout.resistivity_ohm_per_m * pitch))
        if baseline_ohm is not None:
            baseline = require_array("baseline_ohm", baseline_ohm, layout.shape)
            if not (baseline > 0).all():
                where = tuple(int(i) for i in np.argwhere(~(baseline > 0))[0])
                raise ValueError(f"baseline_ohm: got {baseline[where]} at {list(where)}, must be positive")
            gain = 1.0 / (baseline * potential)
        return cls(layout, rest, lower, gain, 1.0 / potential, share, clearance)

    @property
    def step_limit(self) -> float:
        """Initial trust radius, in pitches per coordinate."""
        return TRUST_SHARE * float(self.clearance.min())

    def displacement_m(self, x: Float) -> Float:
        """Return the displacement (U, N, 3) in m for ``x`` (U, 3N) in pitches."""
        return np.asarray((x - self.rest) * self.layout.pitch_m).reshape(self.layout.upper_m.shape)

    def out_of_reach(self, x: Float) -> NDArray[np.bool_]:
        """Return a mask (U,) of the wires with an electrode farther from rest than its clearance.

        Such a displacement is implausible. The test rejects the roots that arise from the symmetries of F,
        which does not change if an electrode is reflected in the lower layer or if two electrodes of a wire
        are exchanged.
        """
        moved = (x - self.rest).reshape(self.layout.upper_m.shape)
        with np.errstate(over="ignore"):
            return np.asarray(((moved**2).sum(axis=-1) > self.clearance**2).any(axis=1))


@functools.lru_cache(maxsize=64)  # the computation takes 2 ms per layout
def _at_rest(layout: PatchLayout) -> tuple[Float, Float, Float, Float, Float]:
    """Return rest, lower, F₀, share_at_rest and clearance of a :class:`PatchProblem`, all read-only."""
    pitch = layout.pitch_m
    rest = layout.upper_m.reshape(layout.shape[0], -1) / pitch
    gaps = layout.upper_m[:, :, None, :] - layout.lower_m.reshape(1, 1, -1, 3)
    distance = np.sqrt((gaps**2).sum(axis=-1)) / pitch
    share = (1.0 / distance.reshape(*rest.shape[:1], -1, *layout.lower_m.shape[:2])).sum(axis=-1)
    found = (
        rest,
        lower_rows(layout.lower_m / pitch),
        potential_per_m(layout, layout.upper_m) * pitch,
        share,
        distance.min(axis=-1),
    )
    for array in found:
        array.setflags(write=False)
    return found
