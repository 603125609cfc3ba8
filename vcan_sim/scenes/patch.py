"""Skin of one patch in a scene, interpolated between the time steps of the touches.

The state at a given time is the weighted mean of the four nearest time steps, with the weights of a uniform
cubic B-spline (de Boor, A Practical Guide to Splines, 1978, chapter IX). The weights are nonnegative and sum
to 1, so the mean is physically consistent: pressure is nonnegative, shear traction stays within the friction
limit, and the displacement is the response of the layer to the tractions. All quantities are twice
continuously differentiable in time. Motions shorter than four time steps are smoothed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skinnode.config import SimulationConfig
from skinnode.model.layout import PatchLayout
from vcan_sim.scenes.history import History, Step
from vcan_sim.scenes.shapes import Float
from vcan_sim.scenes.truth import BodyContact, PatchTruth

Weighted = list[tuple[float, Step]]


@dataclass(frozen=True, eq=False)
class PatchScene:
    """Skin of one patch in a scene, as returned by :func:`vcan_sim.scenes.bind_scene`.

    Attributes:
        layout: Layout of the patch at rest, with the upper electrodes on the surface of the elastic layer.
            Curved skin is projected onto the x-y plane.
        simulation: Simulation settings, such as the seed and noise of the converter.
        number: Patch number within the hand.
        step_s: Time step of the contact mechanics, in s.
        repeat_s: Period of the scene, in s; None if the scene plays once.
        histories: Touch histories of the patch.
    """

    layout: PatchLayout
    simulation: SimulationConfig
    number: int
    step_s: float
    repeat_s: float | None
    histories: tuple[History, ...]

    @property
    def end_s(self) -> float:
        """Scene time at which the last touch ends, in s; 0 if there are no touches."""
        return max((history.touch.to_s for history in self.histories), default=0.0)

    def upper_m(self, t_s: float) -> Float:
        """Return the positions (U, N, 3) of the upper electrodes in metres.

        At rest, the result is ``layout.upper_m`` itself.

        Args:
            t_s: Scene time, in s.
        """
        moved = None
        for _, steps in self._touching(t_s):
            for weight, step in steps:
                part = weight * step.electrodes_m
                moved = part if moved is None else moved + part
        if moved is None:
            return self.layout.upper_m
        return np.asarray(self.layout.upper_m + moved.reshape(self.layout.upper_m.shape))

    def truth(self, t_s: float) -> PatchTruth:
        """Return the ground truth of the patch.

        Args:
            t_s: Scene time, in s.
        """
        contacts, moved, wrench = [], np.zeros((self.layout.upper_m.size // 3, 3)), np.zeros(6)
        for history, steps in self._touching(t_s):
            contacts.append(_contact(history, steps))
            for weight, step in steps:
                moved += weight * step.electrodes_m
                wrench += weight * np.concatenate([step.force_n, step.moment_nm])
        return PatchTruth(t_s, moved.reshape(self.layout.upper_m.shape), tuple(contacts), wrench)

    def prepare(self, until_s: float = math.inf) -> None:
        """Compute the time steps of all touches in advance, rather than on demand.

        Args:
            until_s: Scene time up to which the time steps are computed, in s.
        """
        for history in self.histories:
            if history.touch.from_s < until_s:
                history.step(min(history.last, math.ceil(min(until_s / self.step_s, history.last))))

    def _touching(self, t_s: float) -> Iterator[tuple[History, Weighted]]:
        """Yield each touch in contact around ``t_s``, with its weighted time steps."""
        t_s = t_s if self.repeat_s is None or t_s < 0.0 else math.fmod(t_s, self.repeat_s)
        low = math.floor(t_s / self.step_s)
        weights = _spline(t_s / self.step_s - low)
        for history in self.histories:
            if low + 2 < history.first or low - 1 > history.last:
                continue
            states = [(weight, history.step(low - 1 + i)) for i, weight in enumerate(weights)]
            steps = [(weight, step) for weight, step in states if step is not None and weight > 0.0]
            if steps:
                yield history, steps


def _spline(share: float) -> tuple[float, float, float, float]:
    """Return the cubic B-spline weights of four time steps.

    ``share`` is the elapsed fraction of the interval from the second to the third time step.
    """
    s, rest = share, 1.0 - share
    cube, other = s * s * s / 6.0, rest * rest * rest / 6.0
    second = 2.0 / 3.0 - s * s * (1.0 - 0.5 * s)
    return other, second, 1.0 - other - second - cube, cube


def _contact(history: History, steps: Weighted) -> BodyContact:
    """Return the weighted mean of a touch's time steps, in a window that covers their cells."""
    firsts = np.array([step.first for _, step in steps])
    low = firsts.min(axis=0)
    size = (firsts - low).max(axis=0) + np.array(steps[0][1].traction_pa.shape[1:])
    traction, force = np.zeros((3, int(size[0]), int(size[1]))), np.zeros(3)
    area = depth = 0.0
    for weight, step in steps:
        x, y = (np.array(step.first) - low).tolist()
        width, height = step.traction_pa.shape[1:]
        traction[:, x : x + width, y : y + height] += weight * step.traction_pa
        force += weight * step.force_n
        area += weight * step.area_m2
        depth += weight * step.depth_m
    origin = history.cell_m((int(low[0]), int(low[1])))
    pressure = -traction[2]
    x_m = origin[0] + history.size_m * np.arange(size[0])
    y_m = origin[1] + history.size_m * np.arange(size[1])
    total = max(float(pressure.sum()), 1e-300)
    centre = np.array([float(x_m @ pressure.sum(axis=1)) / total, float(y_m @ pressure.sum(axis=0)) / total])
    return BodyContact(history.touch.body, centre, area, depth, force, origin, history.size_m, traction)
