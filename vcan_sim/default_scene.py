"""Scene in which a sphere repeatedly presses into the skin, slides in a random direction and lifts off.

The ground truth is free of discretisation error: the displacement of the electrodes is the closed-form
solution for a sliding Hertz contact on a half-space (:class:`skinnode.model.elastic.HertzContact`). A scene
is a pure function of scene time and seed, so its states can be computed for any times, in any order.

The onset of sliding is simplified. While the sphere accelerates, the ratio of shear stress to pressure rises
from zero to the coefficient of friction, uniformly across the contact. In a real contact, slip starts at the
rim and spreads inwards (Cattaneo, Mindlin).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from skinnode.config import SimulationConfig
from skinnode.model.elastic import HertzContact, Rubber
from skinnode.model.layout import Float, PatchLayout
from vcan_sim.smooth import GLIDE_RAMP, ease, glide

LEAD_S: Final = 0.8
"""Minimum time (s) before the first press. During this time, the baseline of the untouched skin is
measured."""

PRESS, SLIDE, LIFT = 0.36, 0.40, 0.14
"""Durations of pressing, sliding and lifting, as fractions of a cycle. For the rest of the cycle, the skin is
untouched."""

_GOLDEN: Final = 0.5 * (math.sqrt(5.0) - 1.0)


@dataclass(frozen=True, slots=True)
class Stroke:
    """Stroke of a sphere that presses, slides and lifts off; ``heading`` is a unit vector along the slide."""

    radius_m: float
    depth_m: float
    friction: float
    start_m: tuple[float, float]
    heading: tuple[float, float]
    slide_m: float
    press_s: float
    slide_s: float
    lift_s: float

    def contact(self, rubber: Rubber, t_s: float) -> HertzContact | None:
        """Return the contact ``t_s`` seconds into the stroke; None if there is no contact."""
        lifting = t_s - self.press_s - self.slide_s
        depth = self.depth_m * ease(t_s / self.press_s) * (1.0 - ease(lifting / self.lift_s))
        if depth <= 0.0:
            return None
        sliding = (t_s - self.press_s) / self.slide_s
        way = self.slide_m * glide(sliding)
        shear = self.friction * ease(sliding / GLIDE_RAMP) if self.slide_m > 0.0 else 0.0
        return HertzContact(
            rubber,
            self.radius_m,
            depth,
            (self.start_m[0] + way * self.heading[0], self.start_m[1] + way * self.heading[1]),
            (shear * self.heading[0], shear * self.heading[1]),
        )


@dataclass(frozen=True)
class Scene:
    """Scene in which a sphere makes random strokes over one patch.

    Args:
        layout: Layout of the patch at rest, with the upper electrodes on the surface of the rubber. Curved
            skin is projected onto the x-y plane.
        simulation: Seed, sphere radius, depth, friction, speed and timing of the strokes.
        number: Number of the patch in the hand. It selects the random strokes and the time of the first
            touch.
        rubber: Material of the skin. Its Young's modulus affects forces but not displacements.
    """

    layout: PatchLayout
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    number: int = 0
    rubber: Rubber = field(default_factory=Rubber)

    @property
    def lead_s(self) -> float:
        """Scene time of the first touch, in s. It differs between patches by up to a quarter of a cycle."""
        return LEAD_S + 0.25 * self.simulation.cycle_s * math.fmod(self.number * _GOLDEN, 1.0)

    def stroke(self, index: int) -> Stroke:
        """Return the stroke that begins at ``lead_s + index * cycle_s``."""
        options = self.simulation
        random = np.random.default_rng([options.seed, self.number, index])
        press_s, slide_s, lift_s = (share * options.cycle_s for share in (PRESS, SLIDE, LIFT))
        low, high = self._field_m
        angle = random.uniform(0.0, 2.0 * math.pi)
        heading = np.array([math.cos(angle), math.sin(angle)])
        with np.errstate(divide="ignore"):
            room = float(np.min((high - low) / np.abs(heading)))
        slide_m = min(options.slide_speed_m_per_s * (1.0 - GLIDE_RAMP) * slide_s, room)
        way = slide_m * heading
        first, last = low - np.minimum(way, 0.0), high - np.maximum(way, 0.0)
        start = random.uniform(first, np.maximum(first, last))  # rounding can make `first` exceed `last`
        return Stroke(
            radius_m=options.indenter_radius_m,
            depth_m=options.depth * self.layout.height_m,
            friction=options.shear_ratio,
            start_m=(float(start[0]), float(start[1])),
            heading=(float(heading[0]), float(heading[1])),
            slide_m=slide_m,
            press_s=press_s,
            slide_s=slide_s,
            lift_s=lift_s,
        )

    def contacts(self, t_s: float) -> tuple[HertzContact, ...]:
        """Return the contacts at scene time ``t_s``."""
        index, since = divmod(t_s - self.lead_s, self.simulation.cycle_s)
        if index < 0 or self.simulation.depth == 0.0:
            return ()
        contact = self.stroke(int(index)).contact(self.rubber, since)
        return () if contact is None else (contact,)

    def upper_m(self, t_s: float) -> Float:
        """Return the positions (U, N, 3) of the upper electrodes at scene time ``t_s``, in metres.

        At rest, the result is ``layout.upper_m`` itself.
        """
        contacts = self.contacts(t_s)
        if not contacts:
            return self.layout.upper_m
        moved = sum(contact.displacement_m(self._surface_m) for contact in contacts)
        return np.asarray(self.layout.upper_m + np.reshape(moved, self.layout.upper_m.shape))

    @functools.cached_property
    def _surface_m(self) -> Float:
        return np.ascontiguousarray(self.layout.upper_m[..., :2].reshape(-1, 2))

    @functools.cached_property
    def _field_m(self) -> tuple[Float, Float]:
        """Lower and upper corners of the rectangle within which the centre of the sphere moves.

        The rectangle lies one pitch inside the outermost electrodes on each side. If the patch is too narrow
        for that, the rectangle shrinks to the centre line or centre of the patch.
        """
        low, high = self._surface_m.min(axis=0), self._surface_m.max(axis=0)
        inset = np.minimum(self.layout.pitch_m, 0.5 * (high - low))
        return low + inset, high - inset
