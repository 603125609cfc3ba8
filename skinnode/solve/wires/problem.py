"""Dimensionless form of a patch: one system of equations per upper wire.

Lengths are in pitches, and residuals are relative: r_k = w_k (a_k F_k − 1) with a_k = R_k / (R₀ F₀)_k. A
residual is therefore a fraction of a resistance, regardless of the rubber and the size of the patch. If the
rest resistances R₀ have been measured, the resistivity and the front end's gain cancel; otherwise, R₀ F₀ is
the layout's resistivity. The weights w_k = σ_min / σ_k account for different noise in different equations, so
that solving a tall system minimises χ². A weight of 0 drops an equation.
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
"""Initial trust radius as a fraction of the electrodes' clearance at rest.

F is smooth on the scale of the distance to the nearest charge. In a live stream, the skin moves less than the
trust radius between two frames.
"""


@dataclass(frozen=True, eq=False)
class PatchProblem:
    """Constants of a patch in solver units."""

    layout: PatchLayout
    rest: Float
    """(U, 3N) electrodes at rest, pitches."""
    lower: Float
    """(3, M, K) lower electrodes, pitches."""
    gain: Float
    """(U, K) 1 / (R₀ F₀): a = R · gain."""
    a_rest: Float
    """(U, K) value of a at rest, 1 / F."""
    share_at_rest: Float
    """(U, N, K) contribution of each electrode at rest to F."""
    clearance: Float
    """(U, N) distance of each electrode at rest from the nearest lower electrode, pitches."""

    @classmethod
    def of(cls, layout: PatchLayout, baseline_ohm: ArrayLike | None = None) -> PatchProblem:
        """Convert a patch to solver units; ``baseline_ohm`` (U, K) are measured rest resistances, ohm.

        Raises ValueError if a rest resistance is not positive.
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
        """Initial trust radius, pitches per coordinate."""
        return TRUST_SHARE * float(self.clearance.min())

    def displacement_m(self, x: Float) -> Float:
        """Return the displacement (U, N, 3) in m for ``x`` (U, 3N) in pitches."""
        return np.asarray((x - self.rest) * self.layout.pitch_m).reshape(self.layout.upper_m.shape)

    def out_of_reach(self, x: Float) -> NDArray[np.bool_]:
        """Return a mask (U,) of the wires with an electrode farther from rest than its clearance at rest.

        F does not change if electrodes are reflected in the lower layer, or if two electrodes swap places.
        Roots created by these symmetries are out of reach, because rubber that is pressed from outside does
        not move farther than its own thickness.
        """
        moved = (x - self.rest).reshape(self.layout.upper_m.shape)
        with np.errstate(over="ignore"):
            return np.asarray(((moved**2).sum(axis=-1) > self.clearance**2).any(axis=1))


@functools.lru_cache(maxsize=64)  # cached, because the computation takes 2 ms per layout
def _at_rest(layout: PatchLayout) -> tuple[Float, Float, Float, Float, Float]:
    """Return read-only arrays for a :class:`PatchProblem`: rest, lower, F, share_at_rest and clearance."""
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
