"""Smoothness model: prior covariance of the displacement of an upper wire.

Each coordinate has the covariance C_ij = s² exp(−d_ij² / 2ℓ²), where d_ij is the distance between two
electrodes at rest. Unlike an elastic model, it requires no material constants. The covariance has two uses:
it yields starting points for solves (:mod:`skinnode.solve.starts`), and it ranks the roots of a wire. The
root with the smallest roughness √(uᵀ C⁻¹ u) is the likeliest.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.wires.problem import PatchProblem

CORRELATION_PITCHES: Final = 1.0
"""Correlation length ℓ, in pitches. On the simulated staggered layout, the guided start found 3204 of 3209
roots with a length of 1 pitch, and fewer with 0.7 or 1.5 pitches."""
ROUGH_SHARE: Final = 1e-3
"""Relative increase in the diagonal of C that keeps C from being numerically singular."""


class Smoothness:
    """Smoothness model for every upper wire of a patch.

    Args:
        problem: The patch.

    Attributes:
        covariance: (U, n, n) C for the n = 3N coordinates of each wire, in pitch².
        whitening: (U, N, N) inverse Cholesky factor of C for one coordinate, in pitch⁻¹.
    """

    def __init__(self, problem: PatchProblem) -> None:
        self._problem = problem
        self.covariance, self.whitening = _covariance(problem.layout, problem.step_limit)

    def roughness(self, x: Float) -> Float:
        """Return the roughness √(uᵀ C⁻¹ u) of each wire's displacement u.

        Args:
            x: (U, n) electrode positions, in pitches.

        Returns:
            (U,) roughness, dimensionless.
        """
        displacement = (x - self._problem.rest).reshape(self._problem.layout.upper_m.shape)
        return np.asarray(np.sqrt(((self.whitening @ displacement) ** 2).sum(axis=(1, 2))))


@functools.lru_cache(maxsize=64)
def _covariance(layout: PatchLayout, size: float) -> tuple[Float, Float]:
    """Return C (U, n, n) for a standard deviation of ``size`` pitches, and the whitening matrix (U, N, N)."""
    electrodes: Float = layout.upper_m / layout.pitch_m
    wires, most = electrodes.shape[:2]
    gaps = electrodes[:, :, None, :] - electrodes[:, None, :, :]
    smooth = np.exp(-(gaps**2).sum(axis=-1) / (2.0 * CORRELATION_PITCHES**2))
    smooth += ROUGH_SHARE * np.eye(most)
    covariance = size**2 * np.einsum("uij,cd->uicjd", smooth, np.eye(3)).reshape(wires, 3 * most, -1)
    whitening = np.linalg.inv(np.linalg.cholesky(smooth)) / size
    covariance.setflags(write=False)
    whitening.setflags(write=False)
    return covariance, whitening
