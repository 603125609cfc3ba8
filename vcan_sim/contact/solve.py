"""Pressure and friction between a rigid body and an elastic layer.

The pressure p is nonnegative and vanishes outside the contact, and the body does not penetrate the deformed
surface. This complementarity problem is solved by the conjugate gradient method of Polonsky and Keer (Wear
231, 206, 1999). Friction follows Coulomb's law: each cell in contact either sticks, or slips with a shear
traction μ p that opposes the slip. For a given pressure, the shear traction minimises a convex function
subject to the limit μ p in each cell. The minimum is found by an accelerated projected gradient method (Beck
and Teboulle, SIAM Journal on Imaging Sciences 2, 183, 2009). Pressure and shear are weakly coupled, so the
solver alternates between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from vcan_sim.contact.grid import Grid
from vcan_sim.contact.layer import Float

CLOSE: Final = 1e-6
"""Default tolerance: largest residual overlap or gap in a contact, relative to the largest overlap of the
body with the undeformed surface."""
STEPS: Final = 400
"""Maximum number of iterations for either the pressure or the shear."""
TURNS: Final = 24
"""Maximum number of alternations between pressure and shear."""
DAMPED: Final = 5
"""Number of undamped alternations, after which each change is halved. Without damping, the alternation can
oscillate on a thin layer with high friction."""


class NoSolution(RuntimeError):
    """The computation of a contact did not converge."""


@dataclass(frozen=True, eq=False)
class Contact:
    """Tractions, displacements and stick zone of a contact between a body and the skin.

    Attributes:
        traction_pa: (3, X, Y) tractions on the skin, in Pa.
        displacement_m: (3, X, Y) displacements of the surface, in metres.
        sticks: (X, Y) bool, True for cells in contact that do not slip.
    """

    traction_pa: Float
    displacement_m: Float
    sticks: np.ndarray

    def force_n(self, grid: Grid) -> Float:
        """Return the force (3,) in N that the body exerts on the skin."""
        return np.asarray(self.traction_pa.sum(axis=(1, 2)) * grid.size_m**2)


def untouched(grid: Grid) -> Contact:
    """Return the state of the skin when no body touches it."""
    zero = np.zeros((3, *grid.shape))
    return Contact(zero, zero, np.zeros(grid.shape, bool))


def press(grid: Grid, overlap_m: Float, start_pa: Float | None = None, *, close: float = CLOSE) -> Float:
    """Return the pressure (X, Y) in Pa under a frictionless body.

    Args:
        grid: Cells on the surface.
        overlap_m: (X, Y) overlap of the body with the undeformed surface, in m; negative where there is a
            gap.
        start_pa: (X, Y) initial guess for the pressure, Pa, such as the pressure at the previous time step.
        close: Largest permissible residual overlap or gap, relative to the maximum of ``overlap_m``.

    Raises:
        NoSolution: If the iteration does not converge.
    """
    largest = float(overlap_m.max())
    pressure = np.zeros(grid.shape)
    if largest <= 0.0:
        return pressure
    if start_pa is not None:
        pressure = np.maximum(start_pa, 0.0)
    if not pressure.any():
        pressure = (
            np.where(overlap_m > 0.0, overlap_m, 0.0)
            * grid.layer.contact_modulus_pa
            / (grid.size_m * np.sqrt(grid.shape[0] * grid.shape[1]))
        )
    direction, before, conjugate = np.zeros(grid.shape), 1.0, 0.0
    for _ in range(STEPS):
        gap = grid.normal_m(pressure) - overlap_m
        active = pressure > 0.0
        if max(float(np.abs(gap[active]).max(initial=0.0)), -float(gap.min())) < close * largest:
            return pressure
        if not active.any():  # the initial guess was so large that no cell remains in contact
            pressure, conjugate = _steepest(grid, gap), 0.0
            continue
        square = float((gap[active] ** 2).sum())
        direction = np.where(active, gap + conjugate * square / before * direction, 0.0)
        before = square
        moved = grid.normal_m(direction)
        step = float((gap * direction)[active].sum()) / float((moved * direction)[active].sum())
        pressure = np.maximum(pressure - step * direction, 0.0)
        entered = (pressure == 0.0) & (gap < 0.0)
        pressure[entered] -= step * gap[entered]
        conjugate = 0.0 if entered.any() else 1.0
    raise NoSolution(
        f"pressure did not converge in {STEPS} iterations: gap {np.abs(gap[active]).max():.2g} m"
    )


def _steepest(grid: Grid, gap_m: Float) -> Float:
    """Return a pressure (X, Y) in Pa: the overlap multiplied by a factor from an exact line search."""
    direction = np.maximum(-gap_m, 0.0)
    return np.asarray(direction * ((direction**2).sum() / (grid.normal_m(direction) * direction).sum()))


def rub(grid: Grid, limit_pa: Float, target_m: Float, start_pa: Float, *, close: float = CLOSE) -> Float:
    """Return the shear traction (2, X, Y) in Pa that friction causes under a body.

    Args:
        grid: Cells on the surface.
        limit_pa: (X, Y) maximum shear traction μ p, in Pa.
        target_m: (2, X, Y) displacement of each cell in the absence of slip, in metres.
        start_pa: (2, X, Y) initial guess for the shear traction, in Pa.
        close: Tolerance. The iteration stops when every shear traction changes by less than
            0.1 ``close`` times the maximum of ``limit_pa``.

    Raises:
        NoSolution: If the iteration does not converge.
    """
    inside = limit_pa > 0.0
    if not inside.any():
        return np.zeros_like(start_pa)
    compliance = grid.largest_compliance

    def within(shear: Float) -> Float:
        size = np.hypot(*shear)
        return shear * np.where(size > limit_pa, limit_pa / np.maximum(size, 1e-300), 1.0)

    shear = ahead = within(start_pa)
    weight, scale = 1.0, float(limit_pa.max())
    for _ in range(STEPS):
        slip = np.where(inside, grid.shear_m(ahead) - target_m, 0.0)
        after = within(ahead - slip / compliance)
        change = after - shear
        if float(np.abs(after - ahead).max()) < 0.1 * close * scale:
            return after
        if float((change * (ahead - after)).sum()) > 0.0:  # adaptive restart (O'Donoghue and Candès, 2015)
            weight = 1.0
        new = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * weight * weight))
        ahead = after + (weight - 1.0) / new * change
        shear, weight = after, new
    raise NoSolution(f"shear did not converge in {STEPS} iterations")


def advance(  # noqa: PLR0913 - the last two control the search
    grid: Grid,
    last: Contact,
    overlap_m: Float,
    slide_m: Float,
    friction: float,
    *,
    start: Contact | None = None,
    close: float = CLOSE,
) -> Contact:
    """Return the state of a contact after a small movement of the body.

    Args:
        grid: Cells on the surface.
        last: State of the contact before the movement.
        overlap_m: (X, Y) overlap of the body with the undeformed surface after the movement, in metres.
        slide_m: Tangential movement of the body's surface, metres: (2,), or (2, X, Y) if the body rotates.
        friction: Coefficient of friction μ.
        start: Initial guess for the new state; default: ``last``. The guess affects only the computing time.
        close: Tolerance, as in :func:`press` and :func:`rub`.

    Raises:
        NoSolution: If the iteration does not converge.
    """
    slide = slide_m.reshape(2, 1, 1) if slide_m.ndim == 1 else slide_m
    scale = max(float(overlap_m.max()), 0.0)
    none = np.zeros((3, *grid.shape))
    start = last if start is None else start
    shear, pressure = start.traction_pa[:2], -start.traction_pa[2]
    if not friction:
        shear = none[:2]
    by_shear = grid.displacement_m(np.concatenate([shear, none[2:]]))
    for turn in range(TURNS):
        pressure = press(grid, overlap_m + by_shear[2], pressure, close=close)
        by_pressure = grid.displacement_m(np.concatenate([none[:2], -pressure[None]]))
        if not friction:
            break
        target = last.displacement_m[:2] + slide - by_pressure[:2]
        shear, before = rub(grid, friction * pressure, target, shear, close=close), by_shear[2]
        by_shear = grid.displacement_m(np.concatenate([shear, none[2:]]))
        if float(np.abs(by_shear[2] - before).max()) <= 10.0 * close * scale:
            break
        if turn >= DAMPED:
            by_shear[2] = 0.5 * (by_shear[2] + before)
    else:
        raise NoSolution(f"pressure and shear did not converge in {TURNS} alternations")
    sticks = (pressure > 0.0) & (np.hypot(*shear) < (1.0 - 1e-6) * friction * pressure)
    return Contact(np.concatenate([shear, -pressure[None]]), by_pressure + by_shear, sticks)
