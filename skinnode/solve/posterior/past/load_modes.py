"""Modes of a layout: the directions in which the readings change when the loads change.

The modes are the eigenvectors of J C Jᵀ (:mod:`skinnode.solve.checks.reading_model`). If the loads change at
random, the readings' changes along different modes are independent.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.checks.reading_model import ReadingModel

LEAST_SHARE: Final = 1e-3
"""Minimum variance of a mode, relative to the largest. Large displacements change the readings along all
modes, because the readings are not linear in the displacement."""
LARGEST: Final = 16
"""Number of modes that are individually tested for a change."""


@dataclass(frozen=True, eq=False)
class LoadModes:
    """Modes of the m = U K readings; shared by all patches of a layout."""

    modes: Float
    """(m, m) orthonormal modes, as rows, in order of increasing share."""
    share: Float
    """(m,) variance of each mode if the loads change at random. Without the minimum :data:`LEAST_SHARE`, the
    sum would be 1."""
    weight: Float
    """(m,) weight of each mode in the noise of the filtered readings: the square root of the share. The
    solver assumes that the errors of the readings are independent, but the filter averages fewer frames along
    the modes with a large share. The stated noise is therefore the noise of these modes."""
    total: Float
    """(m,) Σ weight mode² of each reading."""
    coordinates_t: Float
    """(U, 3N, K) changes in each wire's readings caused by a movement of a single coordinate, scaled to unit
    norm."""

    @classmethod
    def of(cls, layout: PatchLayout) -> LoadModes:
        """Return the cached modes of ``layout``, computed on first use."""
        return _modes(layout)

    def largest(self, changes: Float) -> Float:
        """Return the largest component of each column of ``changes`` along a mode or a coordinate.

        Only the largest modes are considered. For independent changes of variance 1, each component has a
        variance of 1.

        Args:
            changes: (m, C) changes in the readings.

        Returns:
            (C,) absolute values.
        """
        wires, _, lower = self.coordinates_t.shape
        of_modes = np.abs(self.modes[-LARGEST:] @ changes).max(axis=0)
        local = np.abs(self.coordinates_t @ changes.reshape(wires, lower, -1)).max(axis=(0, 1))
        return np.asarray(np.maximum(of_modes, local))


@functools.lru_cache(maxsize=8)
def _modes(layout: PatchLayout) -> LoadModes:
    model = ReadingModel.of(layout)
    middle = len(model.kappa) // 2
    share = np.maximum(1.0 / model.shrink[middle] - 1.0, 0.0)
    share = share / share.sum()
    share = share + LEAST_SHARE * share.max()
    weight = np.sqrt(share)
    norm = np.linalg.norm(model.jacobian, axis=1, keepdims=True)
    slopes = model.jacobian / np.maximum(norm, 1e-9 * norm.max())
    return LoadModes(
        modes=model.vectors_t,
        share=share,
        weight=weight,
        total=weight @ model.vectors_t**2,
        coordinates_t=np.ascontiguousarray(slopes.transpose(0, 2, 1)),
    )
