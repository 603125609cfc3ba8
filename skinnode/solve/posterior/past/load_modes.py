"""Modes of a layout: the directions in which changes in the loads change the readings.

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

LEAST_SHARE: Final = 1e-4
"""Minimum variance of a mode, relative to the largest. Large displacements change the readings along all
modes, because the readings are not linear in the displacement."""


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
    solver assumes that the errors of the readings are independent, but the filter uses fewer frames for the
    modes of the loads. The noise is therefore stated for these modes."""
    total: Float
    """(m,) Σ weight mode² of each reading."""

    @classmethod
    def of(cls, layout: PatchLayout) -> LoadModes:
        """Return the cached modes of ``layout``, computed on first use."""
        return _modes(layout)


@functools.lru_cache(maxsize=8)
def _modes(layout: PatchLayout) -> LoadModes:
    model = ReadingModel.of(layout)
    middle = len(model.kappa) // 2
    share = np.maximum(1.0 / model.shrink[middle] - 1.0, 0.0)
    share = share / share.sum()
    share = share + LEAST_SHARE * share.max()
    weight = np.sqrt(share)
    return LoadModes(model.vectors_t, share, weight, weight @ model.vectors_t**2)
