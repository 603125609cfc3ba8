"""Contact mechanics of one touch at fixed time steps.

Friction depends on history, so the time steps are computed in order and stored. The cells belong to a lattice
that is fixed to the patch. The window follows the body in whole-cell steps, so tractions are never
interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from threading import Lock
from typing import Final

import numpy as np

from vcan_sim.contact.grid import Grid
from vcan_sim.contact.solve import Contact, NoSolution, advance, untouched
from vcan_sim.scenes.motions import Pose, pose_at
from vcan_sim.scenes.response import Electrodes
from vcan_sim.scenes.shapes import Float, Shape
from vcan_sim.scenes.tables import TouchConfig
from vcan_sim.scenes.window import CLOSE, Window, centred_m, overlap_m, solve_depth

_LEAST: Final = 1e-5
"""Depth or force below which contact is neglected, relative to the maximum during the touch."""
_LOOSER: Final = (1.0, 10.0, 100.0)
"""Factors applied to the contact solver's tolerance, tried in turn until the solver converges."""


@dataclass(frozen=True, eq=False)
class Step:
    """State of a touch at one time step.

    Attributes:
        first: (2,) lattice indices of the first cell of the window.
        traction_pa: (3, X, Y) tractions on the skin, in Pa.
        electrodes_m: (E, 3) displacement of the electrodes, in metres.
        force_n: (3,) force on the skin, in N.
        moment_nm: (3,) moment of the force about the origin of the patch, N m.
        area_m2: Area of contact, m².
        depth_m: Depth of the body's lowest point below the undeformed surface, in metres.
    """

    first: tuple[int, int]
    traction_pa: Float
    electrodes_m: Float
    force_n: Float
    moment_nm: Float
    area_m2: float
    depth_m: float


class History:
    """Time steps of one touch, computed on demand. Threads may share an instance.

    Args:
        touch: Touch to compute.
        shape: Shape of the body that touches the skin.
        friction: Coefficient of friction.
        window: Cells under the body.
        step_s: Time step, in s.
        electrodes: Electrodes whose displacement is computed.
    """

    def __init__(  # noqa: PLR0913 - all inputs of a touch
        self,
        touch: TouchConfig,
        shape: Shape,
        friction: float,
        window: Window,
        step_s: float,
        electrodes: Electrodes,
    ) -> None:
        self.touch, self.window, self.step_s = touch, window, step_s
        self.first = math.floor(touch.from_s / step_s)
        """Number of the first time step. There is no contact before this step."""
        self.last = math.ceil(touch.to_s / step_s)
        """Number of the last time step. There is no contact after this step."""
        self._shape, self._friction, self._electrodes = shape, friction, electrodes
        self._steps: list[Step | None] = []
        self._contact = untouched(window.grid)
        self._pose: Pose | None = None
        self._first_cell = (0, 0)
        self._depth_and_force: tuple[float, float] | None = None
        self._lock = Lock()

    @property
    def size_m(self) -> float:
        """Side length of a cell, in metres."""
        return self.window.grid.size_m

    def step(self, number: int) -> Step | None:
        """Return the state at time ``number * step_s``; None if there is no contact."""
        index = number - self.first
        if index < 0 or number > self.last:
            return None
        with self._lock:
            while len(self._steps) <= index:
                self._steps.append(self._following(self.first + len(self._steps)))
            return self._steps[index]

    def cell_m(self, first: tuple[int, int]) -> Float:
        """Return the centre (2,) of a lattice cell in the patch frame, in metres."""
        return np.asarray(self.touch.at_m) + centred_m(self.window.grid) + self.size_m * np.array(first)

    def _following(self, number: int) -> Step | None:
        pose, last = pose_at(self.touch, number * self.step_s), self._pose
        if self._steps and last is not None and self._steps[-1] is not None and pose == last:
            return self._steps[-1]  # the body has not moved
        largest = self.window.force_n if self.touch.by_force else self.window.deepest_m
        if pose.level < _LEAST * largest:
            self._contact, self._pose = untouched(self.window.grid), pose
            self._depth_and_force = None
            return None
        start = self._contact  # in sliding contact, the tractions move with the body
        self._follow(pose)
        offset = self.cell_m(self._first_cell) - np.asarray(pose.place_m)
        slide = np.zeros(2) if last is None else np.subtract(pose.slid_m, last.slid_m)
        if last is not None and pose.yaw_rad != last.yaw_rad:
            arm = self.window.grid.centres_m(offset)
            turn = pose.yaw_rad - last.yaw_rad
            slide = slide[:, None, None] + turn * np.stack([-arm[..., 1], arm[..., 0]])
        depth, contact = self._solve(pose, offset, slide, start)
        self._contact, self._pose = contact, pose
        return self._summary(depth)

    def _solve(self, pose: Pose, offset_m: Float, slide_m: Float, start: Contact) -> tuple[float, Contact]:
        """Return the depth (m) and the contact at a new pose. ``start`` is the initial guess."""
        grid = self.window.grid

        def at(depth_m: float) -> Contact:
            nonlocal start
            over = overlap_m(grid, self._shape, offset_m, pose.yaw_rad, depth_m)
            found = _advance(grid, self._contact, start, over, slide_m, self._friction)
            start = found
            return found

        if not self.touch.by_force:
            return pose.level, at(pose.level)
        newest: Contact = self._contact

        def force_n(depth_m: float) -> float:
            nonlocal newest
            newest = at(depth_m)
            return -float(newest.force_n(grid)[2])

        known = self._depth_and_force or (self.window.deepest_m, self.window.force_n)
        depth = solve_depth(force_n, pose.level, known)
        self._depth_and_force = (depth, -float(newest.force_n(grid)[2]))
        return depth, newest

    def _follow(self, pose: Pose) -> None:
        """Move the window with the body, in whole-cell steps. The tractions stay in place on the skin."""
        grid = self.window.grid
        way = (np.asarray(pose.place_m) - np.asarray(self.touch.at_m)) / grid.size_m
        first = (round(float(way[0])), round(float(way[1])))
        shift = (first[0] - self._first_cell[0], first[1] - self._first_cell[1])
        self._first_cell = first
        if shift != (0, 0) and self._contact.traction_pa.any():
            traction = _shifted(self._contact.traction_pa, shift)
            moved = grid.displacement_m(traction)
            self._contact = replace(self._contact, traction_pa=traction, displacement_m=moved)

    def _summary(self, depth_m: float) -> Step:
        grid, contact = self.window.grid, self._contact
        origin = self.cell_m(self._first_cell)
        places = np.moveaxis(grid.centres_m(origin), -1, 0)
        force = contact.traction_pa * grid.size_m**2
        x, y, z = places[0], places[1], self._electrodes.surface_m
        moment = np.array(
            [
                (y * force[2] - z * force[1]).sum(),
                (z * force[0] - x * force[2]).sum(),
                (x * force[1] - y * force[0]).sum(),
            ]
        )
        touching = contact.traction_pa[2] < 0.0
        return Step(
            self._first_cell,
            contact.traction_pa,
            self._electrodes.displacement_m(grid, origin, contact),
            force.sum(axis=(1, 2)),
            moment,
            float(touching.sum()) * grid.size_m**2,
            depth_m,
        )


def _advance(  # noqa: PLR0913 - all inputs of a time step
    grid: Grid, last: Contact, start: Contact, overlap_m: Float, slide_m: Float, friction: float
) -> Contact:
    """Return the contact after the body has moved.

    If the solver does not converge, it runs again with the next factor in ``_LOOSER``. If no factor is large
    enough, the time step is computed without friction.

    Raises:
        NoSolution: If the solver does not converge even without friction.
    """
    for looser in _LOOSER:
        try:
            return advance(grid, last, overlap_m, slide_m, friction, start=start, close=looser * CLOSE)
        except NoSolution:
            continue
    return advance(grid, untouched(grid), overlap_m, np.zeros(2), 0.0, close=_LOOSER[-1] * CLOSE)


def _shifted(traction_pa: Float, shift: tuple[int, int]) -> Float:
    """Return tractions (3, X, Y) in a window shifted by whole cells, with zeros in the new cells."""
    moved = np.zeros_like(traction_pa)
    size = traction_pa.shape[1:]
    if abs(shift[0]) >= size[0] or abs(shift[1]) >= size[1]:
        return moved
    here = tuple(slice(max(-s, 0), n - max(s, 0)) for s, n in zip(shift, size, strict=True))
    there = tuple(slice(max(s, 0), n - max(-s, 0)) for s, n in zip(shift, size, strict=True))
    moved[:, here[0], here[1]] = traction_pa[:, there[0], there[1]]
    return moved
