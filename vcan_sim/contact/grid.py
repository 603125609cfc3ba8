"""Grid of square cells on the surface; computes the displacement due to tractions on the cells, by FFT.

The displacement is the convolution of the tractions with the response to a single cell. Zero padding to at
least twice the number of cells along each axis prevents wrap-around (Liu, Wang and Liu, Wear 243, 101, 2000).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy

from vcan_sim.contact.layer import Float, Layer, cell_response


@dataclass(frozen=True, eq=False)
class Grid:
    """Elastic response of a grid of square cells. Create instances with :meth:`of`.

    Attributes:
        layer: Elastic layer under the cells.
        shape: Number of cells along x and along y.
        size_m: Side length of a cell, in metres.
    """

    layer: Layer
    shape: tuple[int, int]
    size_m: float
    _padded: tuple[int, int]
    _response: Float
    """(3, 3, …) Fourier transform of the displacement due to a unit traction on one cell."""

    @classmethod
    def of(cls, layer: Layer, shape: tuple[int, int], size_m: float) -> Grid:
        """Create a grid, and compute its elastic response.

        Args:
            layer: Elastic layer under the cells.
            shape: Number of cells along x and along y.
            size_m: Side length of a cell, in metres.
        """
        padded = (
            scipy.fft.next_fast_len(2 * shape[0], real=True),
            scipy.fft.next_fast_len(2 * shape[1], real=True),
        )
        steps = [(np.arange(n) + m - 1) % n - (m - 1) for n, m in zip(padded, shape, strict=True)]
        offset = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1) * size_m
        response = cell_response(layer, offset, size_m, float(np.hypot(*np.abs(offset).max(axis=(0, 1)))))
        turned = np.ascontiguousarray(np.moveaxis(response, (2, 3), (0, 1)))
        return cls(layer, shape, size_m, padded, scipy.fft.rfft2(turned))

    def centres_m(self, origin_m: Float) -> Float:
        """Return the cell centres (X, Y, 2) in metres; the first is at ``origin_m`` (2,)."""
        x, y = (np.arange(n) * self.size_m for n in self.shape)
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1) + origin_m

    def displacement_m(self, traction_pa: Float) -> Float:
        """Return the displacement (3, X, Y) in metres due to tractions (3, X, Y) in Pa."""
        waves = scipy.fft.rfft2(traction_pa, self._padded)
        moved = scipy.fft.irfft2(np.einsum("ijxy,jxy->ixy", self._response, waves), self._padded)
        return np.asarray(moved[:, : self.shape[0], : self.shape[1]])

    def normal_m(self, pressure_pa: Float) -> Float:
        """Return the indentation (X, Y) in metres due to a pressure (X, Y) in Pa."""
        waves = self._response[2, 2] * scipy.fft.rfft2(pressure_pa, self._padded)
        return np.asarray(scipy.fft.irfft2(waves, self._padded)[: self.shape[0], : self.shape[1]])

    def shear_m(self, traction_pa: Float) -> Float:
        """Return the tangential displacement (2, X, Y) in metres due to shear tractions (2, X, Y) in Pa."""
        waves = scipy.fft.rfft2(traction_pa, self._padded)
        moved = scipy.fft.irfft2(np.einsum("ijxy,jxy->ixy", self._response[:2, :2], waves), self._padded)
        return np.asarray(moved[:, : self.shape[0], : self.shape[1]])

    @functools.cached_property
    def largest_compliance(self) -> float:
        """Upper bound on the eigenvalues of the shear compliance matrix, m/Pa.

        The bound is a power-iteration estimate plus a margin of 10 %. It also holds for every subset of
        the cells, because the compliance of a subset is a principal submatrix of this symmetric matrix.
        """
        vector = np.ones((2, *self.shape))
        largest = 0.0
        for _ in range(8):
            vector = vector / np.linalg.norm(vector)
            vector = self.shear_m(vector)
            largest = float(np.linalg.norm(vector))
        return 1.1 * largest
