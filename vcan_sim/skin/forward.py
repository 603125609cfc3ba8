"""Conductances between the electrodes of a patch.

An exact patch has point electrodes. The path between two electrodes at distance d has the conductance
1 / (ρ d), which has the form of the potential of a point charge. :class:`ExactForward` sums these
conductances directly. :class:`Paths` adds two effects:

finite electrodes   A conducting disc of radius a has the potential arcsin(2a / (l₁ + l₂)) / a instead of 1/d,
                    where l₁ and l₂ are the distances to the nearest and farthest points of its rim
                    (Weber 1873; Jackson, Classical Electrodynamics, 3rd ed., problem 3.3). The conductance
                    between two discs is the average of this potential over a parallel disc with the charge
                    density 1/√(a² − r²). Each of the two discs adds (a²/6) ∇²(1/d), where ∇² is the Laplacian
                    in the plane. The average is therefore approximated by the potential of one disc of radius
                    √2 a; the relative error is of order (a/d)⁴.
strain              The resistivity ρ of a path becomes ρ (1 + β ε), where ε = d/d₀ − 1 is the strain of the
                    path relative to rest. This is the linear piezoresistive law (Smith, Phys. Rev. 94, 1954)
                    for each path separately. The model neglects strain perpendicular to the path.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import numpy as np

from skinnode.model.layout import Float


class ExactForward:
    """Computes the resistances of a patch with point electrodes by direct summation.

    This class shares no code with the solver kernels, so the ground truth and the solvers cannot share a bug.
    For speed, it allocates no temporary arrays of shape (…, 3).

    Args:
        shape: (U, N, K, M): U upper wires with N electrodes each, and K lower wires with M electrodes each.
        lower_m: (K, M, 3) float64, m: lower electrodes.
        resistivity_ohm_per_m: Resistance of a path per metre of distance between its electrodes, ohm/m.
    """

    def __init__(
        self, shape: tuple[int, int, int, int], lower_m: Float, resistivity_ohm_per_m: float
    ) -> None:
        self._shape = shape
        self._lower = np.ascontiguousarray(lower_m.reshape(-1, 3).T)
        self._resistivity = resistivity_ohm_per_m

    def __call__(self, upper_m: Float) -> Float:
        """Return the resistances (U, K) in ohms for upper electrodes at (U, N, 3) in metres."""
        distance = np.zeros((upper_m.size // 3, self._lower.shape[1]))
        for here, there in zip(upper_m.reshape(-1, 3).T, self._lower, strict=True):
            distance += (here[:, None] - there) ** 2
        np.sqrt(distance, out=distance)
        with np.errstate(divide="ignore"):
            potential = (1.0 / distance).reshape(self._shape).sum(axis=(1, 3))
        return np.asarray(self._resistivity / potential)


class Paths:
    """Conductances of all paths between upper and lower electrodes, multiplied by the resistivity.

    Args:
        upper_m: (U, N, 3) float64, m: upper electrodes at rest.
        lower_m: (K, M, 3) float64, m: lower electrodes.
        radius_m: Radius of the electrodes, in m; 0 for points.
        strain: β, relative change in resistivity per unit strain of a path.
    """

    def __init__(self, upper_m: Float, lower_m: Float, radius_m: float, strain: float) -> None:
        self._lower = np.ascontiguousarray(lower_m.reshape(-1, 3).T)
        self._radius_m = math.sqrt(2.0) * radius_m
        self._strain = strain
        self._per_m: Float | None = None
        if strain:
            with self._work(upper_m) as work:
                self._per_m = strain / np.sqrt(self._squares(upper_m, work)[1])

    def sums(self, upper_m: Float, shape: tuple[int, ...], axes: tuple[int, ...]) -> Float:
        """Return conductances summed over the electrodes of each wire.

        Args:
            upper_m: (U, N, 3) float64, m: upper electrodes.
            shape: (U, N, K, M).
            axes: Axes of ``shape`` to sum over: 1, 3, both or none.

        Returns:
            (U, N or 1, K, M or 1) float64, 1/m; divide by the resistivity (ohm/m) to obtain siemens.
        """
        with self._work(upper_m) as work:
            return np.asarray(self._each(upper_m, work).reshape(shape).sum(axis=axes, keepdims=True))

    def _work(self, upper_m: Float) -> contextlib.AbstractContextManager[Float]:
        return _borrowed((3, upper_m.size // 3, self._lower.shape[1]))

    def _each(self, upper_m: Float, work: Float) -> Float:
        """Return the conductances (U N, K M) of all paths in 1/m, stored in ``work``."""
        plane, square = self._squares(upper_m, work)
        found: Float = work[2]
        with np.errstate(divide="ignore"):
            if self._radius_m:
                _disc(plane, square, self._radius_m, out=found)
            else:
                np.divide(1.0, np.sqrt(square, out=found), out=found)
        if self._per_m is not None:
            factor = np.sqrt(square, out=plane)
            factor *= self._per_m
            factor += 1.0 - self._strain
            found /= factor
        return found

    def _squares(self, upper_m: Float, work: Float) -> tuple[Float, Float]:
        """Return the squared distances (U N, K M) in the plane and in space, in m², stored in ``work``."""
        here, there = np.ascontiguousarray(upper_m.reshape(-1, 3).T), self._lower
        plane, square, gap = work
        for axis, out in ((0, plane), (1, gap), (2, square)):
            np.subtract(here[axis][:, None], there[axis], out=out)
            np.multiply(out, out, out=out)
        plane += gap
        square += plane
        return plane, square


_unused: dict[tuple[int, ...], list[Float]] = {}


@contextlib.contextmanager
def _borrowed(shape: tuple[int, ...]) -> Iterator[Float]:
    """Lend a work array to one thread at a time; patches of the same shape share the arrays.

    The arrays are reused because mapping memory pages for new arrays would take longer than the arithmetic.
    """
    unused = _unused.setdefault(shape, [])
    try:
        work = unused.pop()
    except IndexError:
        work = np.empty(shape)
    try:
        yield work
    finally:
        unused.append(work)


def _disc(plane: Float, square: Float, radius_m: float, out: Float) -> None:
    """Write the potential (1/m) of a conducting disc of unit charge to ``out``. Overwrites ``plane``.

    With s = d² + a², the identity l₁² l₂² = s² − 4 a² p gives (l₁ + l₂)² / 4 = (s + √(s² − 4 a² p)) / 2.

    Args:
        plane: p, squared distances from the axis of the disc, m².
        square: d², squared distances from the centre of the disc, m².
        radius_m: a, radius of the disc, in m.
        out: Array for the potentials, 1/m.
    """
    a2 = radius_m * radius_m
    np.multiply(plane, 4.0 * a2, out=plane)
    np.add(square, a2, out=out)
    np.multiply(out, out, out=out)
    out -= plane
    np.maximum(out, 0.0, out=out)
    np.sqrt(out, out=out)
    out += square
    out += a2
    out *= 0.5
    np.sqrt(out, out=out)
    np.divide(radius_m, out, out=out)
    np.minimum(out, 1.0, out=out)
    np.arcsin(out, out=out)
    out /= radius_m
