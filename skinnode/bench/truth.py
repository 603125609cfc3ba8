"""Generates ground truth for benchmarks, independently of the solvers' assumptions.

Displacements are closed-form solutions for rigid spheres on rubber
(:class:`skinnode.model.elastic.HertzContact`), which need neither a grid nor a prior. :class:`Skin` computes
the resistances. Unlike the solver's model, a skin can have electrodes of finite size, strain-dependent
resistivity, a different layer height, or a contact resistance in series. :class:`Converter` adds noise and
quantises the readings to codes.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from skinnode.model.elastic import HertzContact, Rubber
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import CodeScale, decode, encode

RUBBER: Final = Rubber()
EXACT_NOISE: Final = 1e-9
"""Relative noise passed to a tracker for noise-free data. This noise determines the tolerance of the
solver."""
RING: Final = 4
"""Number of points on the rim of an electrode of finite size. The potential between two electrodes is the
mean over all 16 pairs of points."""


class Load(Protocol):
    """A body that presses on the skin.

    The argument ``share`` is the current depth divided by the full depth.
    """

    @property
    def center_m(self) -> tuple[float, float]:
        """Initial centre (x, y) of the load, in metres."""

    @property
    def depth_m(self) -> float:
        """Full depth, in metres."""

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the (P, 3) displacements of the (P, 2) surface points, in metres."""

    def force_n(self, share: float) -> Float:
        """Return the (3,) force on the rubber, in newtons; NaN if it is unknown for this kind of body."""


@dataclass(frozen=True)
class Press:
    """A sphere that presses on the skin (lengths in metres); ``share`` is the fraction of the full depth."""

    center_m: tuple[float, float]
    radius_m: float
    depth_m: float
    traction_ratio: tuple[float, float] = (0.0, 0.0)
    shear_only: bool = False
    """Whether only the tangential traction acts. The result is the displacement with friction minus the
    displacement without friction."""

    def contacts(self, share: float) -> tuple[tuple[int, HertzContact], ...]:
        """Return the closed-form solutions to superpose, each with its sign (+1 or −1)."""
        depth = share * self.depth_m
        full = HertzContact(RUBBER, self.radius_m, depth, self.center_m, self.traction_ratio)
        if not self.shear_only:
            return ((1, full),)
        return ((1, full), (-1, HertzContact(RUBBER, self.radius_m, depth, self.center_m)))

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the (P, 3) displacements at the (P, 2) surface points, in metres."""
        moved = np.zeros((len(points_m), 3))
        for sign, contact in self.contacts(share):
            moved += sign * contact.displacement_m(points_m)
        return moved

    def force_n(self, share: float) -> Float:
        """Return the (3,) force on the rubber, in newtons."""
        force = np.zeros(3)
        for sign, contact in self.contacts(share):
            force += sign * np.array(contact.force_n)
        return force


@dataclass(frozen=True, eq=False)
class Skin:
    """A simulated patch; the solver knows only its nominal ``layout``.

    Args:
        layout: Nominal layout, which is passed to the solver.
        height: True height of the upper layer divided by the nominal height.
        electrode: Radius of the electrodes, in pitches; 0 for point electrodes, as in the solver's model.
        strain: Coefficient β of the strain-dependent resistance ρ d (1 + β (d/d₀ − 1)), where d₀ is the
            distance d at rest.
        series: Contact resistance in series with each crossing, as a fraction of the crossing's R₀.
        points_m: (U, N, 2) positions of the upper electrodes in surface coordinates, for a curved patch.
        axes: (U, N, 3, 3) local axes at each upper electrode; the rows are two tangents and the outward
            normal.
        upper_shift_m: (U, 3), metres: displacements of the upper wires from their nominal positions.
        lower_shift_m: (K, 3), metres: displacements of the lower wires from their nominal positions.
    """

    layout: PatchLayout
    height: float = 1.0
    electrode: float = 0.0
    strain: float = 0.0
    series: float = 0.0
    points_m: Float | None = field(default=None)
    axes: Float | None = field(default=None)
    upper_shift_m: Float | None = field(default=None)
    lower_shift_m: Float | None = field(default=None)

    @functools.cached_property
    def body(self) -> PatchLayout:
        """True layout of the patch."""
        if self.height == 1.0 and self.upper_shift_m is None and self.lower_shift_m is None:
            return self.layout
        upper, lower = self.layout.upper_m, self.layout.lower_m
        if self.axes is None:
            upper = upper * np.array([1.0, 1.0, self.height])
        else:  # on a curved patch, the height is measured along the normal
            upper = upper + (self.height - 1.0) * self._gap_m[..., None] * self.axes[:, :, 2]
        if self.upper_shift_m is not None:
            upper = upper + self.upper_shift_m[:, None]
        if self.lower_shift_m is not None:
            lower = lower + self.lower_shift_m[:, None]
        return PatchLayout(upper, lower, self.layout.resistivity_ohm_per_m)

    @property
    def _gap_m(self) -> Float:
        """(U, N), metres: distances of the upper electrodes from the lower layer, along the normals."""
        gap = self.layout.upper_m[:, :, None] - self.layout.lower_m.reshape(-1, 3)
        nearest = np.argmin((gap**2).sum(axis=-1), axis=-1)[..., None, None]
        assert self.axes is not None
        return np.asarray(
            (np.take_along_axis(gap, nearest, axis=2)[:, :, 0] * self.axes[:, :, 2]).sum(axis=-1)
        )

    def displacement_m(self, presses: tuple[Load, ...], share: float) -> Float:
        """Return the (U, N, 3) displacement of the electrodes due to all presses, in metres."""
        points = self.body.upper_m[..., :2] if self.points_m is None else self.points_m
        moved = np.zeros((points.shape[0] * points.shape[1], 3))
        for press in presses:
            moved += press.displacement_m(points.reshape(-1, 2), share)
        moved = moved.reshape(self.layout.upper_m.shape)
        return moved if self.axes is None else np.asarray(np.einsum("una,unab->unb", moved, self.axes))

    @functools.cached_property
    def rest_ohm(self) -> Float:
        """(U, K), ohm: noise-free resistances at rest, passed to the solver as the baseline."""
        return self.resistance_ohm(np.zeros(self.layout.upper_m.shape))

    def resistance_ohm(self, displacement_m: Float) -> Float:
        """Return the (U, K) resistances in ohms for a (U, N, 3) displacement in metres."""
        upper = self.body.upper_m + displacement_m
        if self.strain:
            found = self._strained(upper)
        elif self.electrode:
            found = self._finite(upper)
        else:
            found = self._points(upper)
        return found if not self.series else found + self.series * self._rest_without_series

    @functools.cached_property
    def _rest_without_series(self) -> Float:
        return self._points(self.body.upper_m)

    def _points(self, upper: Float) -> Float:
        """Compute the same as :func:`skinnode.model.forward.resistance_ohm`, about five times as fast."""
        lower = self.body.lower_m.reshape(-1, 3)
        square = np.zeros((upper.shape[0] * upper.shape[1], len(lower)))
        for axis in range(3):
            gap = np.subtract.outer(upper[..., axis].ravel(), lower[:, axis])
            square += gap * gap
        near = 1.0 / np.sqrt(square)
        near = near.reshape(*upper.shape[:2], self.layout.shape[1], -1).sum(axis=(1, 3))
        return np.asarray(self.layout.resistivity_ohm_per_m / near)

    @functools.cached_property
    def _rest_distance(self) -> Float:
        return self._distance(self.body.upper_m)

    def _distance(self, upper: Float) -> Float:
        """Return the (U, K, M, N) distances between upper and lower electrodes, in metres."""
        gap = upper[:, None, None, :, :] - self.body.lower_m[None, :, :, None, :]
        return np.asarray(np.sqrt(np.einsum("ukmna,ukmna->ukmn", gap, gap)))

    def _strained(self, upper: Float) -> Float:
        distance = self._distance(upper)
        path = distance * (1.0 + self.strain * (distance / self._rest_distance - 1.0))
        return np.asarray(self.layout.resistivity_ohm_per_m / (1.0 / path).sum(axis=(2, 3)))

    def _finite(self, upper: Float) -> Float:
        """Return the (U, K) resistances in ohms; potentials are averaged over the rims of electrodes."""
        radius = self.electrode * self.layout.pitch_m
        rims = []
        for points, turned in ((upper, 0.0), (self.body.lower_m, 0.5)):
            angle = 2 * np.pi * (np.arange(RING) + turned) / RING
            rim = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
            rims.append((points[:, :, None, :] + rim).reshape(-1, 3))
        above, below = rims
        square = (above**2).sum(axis=1)[:, None] + (below**2).sum(axis=1) - 2 * above @ below.T
        shape = (upper.shape[0], upper.shape[1] * RING, self.layout.shape[1], -1)
        near = (1.0 / np.sqrt(square)).reshape(shape).sum(axis=(1, 3)) / RING**2
        return np.asarray(self.layout.resistivity_ohm_per_m / near)


@dataclass(frozen=True)
class Converter:
    """Converter with relative noise ``sigma``; quantises R/R₀ to ``bits``-bit codes if ``bits`` is not 0.

    As in the protocol, the codes cover the range from ``lo`` to ``hi``, and three codes are reserved. Codes
    of 16 and 24 bits are encoded and decoded with the protocol's codec.
    """

    sigma: float = 0.0
    bits: int = 0
    lo: float = 0.25
    hi: float = 1.25

    @property
    def exact(self) -> bool:
        """Whether every reading equals the true resistance."""
        return self.sigma == 0.0 and self.bits == 0

    @property
    def relative_std(self) -> float:
        """Relative standard deviation of a reading at rest, passed to the solver as the noise."""
        if self.exact:
            return EXACT_NOISE
        rounding = (self.hi - self.lo) / ((1 << self.bits) - 4) / math.sqrt(12.0) if self.bits else 0.0
        return math.hypot(self.sigma, rounding)

    def read(
        self, resistance: Float, rest: Float, rng: np.random.Generator
    ) -> tuple[Float, NDArray[np.bool_], Float]:
        """Simulate the conversion; return the readings, their validity and their relative noise."""
        if self.exact:
            return resistance, np.ones(resistance.shape, bool), np.full(resistance.shape, EXACT_NOISE)
        noisy = resistance * (1.0 + self.sigma * rng.standard_normal(resistance.shape))
        noise = np.full(resistance.shape, self.sigma)
        if not self.bits:
            return noisy, np.ones(resistance.shape, bool), noise
        steps = (1 << self.bits) - 4
        step = (self.hi - self.lo) / steps
        if self.bits in (16, 24):
            scale = CodeScale(self.bits, self.lo, self.hi)
            decoded, valid = decode(encode(noisy, rest, scale), rest, scale)
        else:
            code = np.rint((noisy / rest - self.lo) / step)
            valid = (code >= 0) & (code <= steps)
            decoded = np.where(valid, (self.lo + code * step) * rest, np.nan)
        with np.errstate(invalid="ignore"):
            rounding = step / np.sqrt(12.0) * rest / np.where(valid, decoded, rest)
        return decoded, valid, np.hypot(noise, rounding)


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """A sequence of frames to be solved, and the true displacements and forces."""

    frames_ohm: Float
    """(T, U, K), ohm: readings; invalid readings are not finite."""
    valid: NDArray[np.bool_]
    """(T, U, K)"""
    noise: Float
    """(T, U, K) relative standard deviation of each reading."""
    truth_m: Float
    """(T, U, N, 3), metres: true displacement; NaN in frames of a physically impossible motion."""
    force_n: Float
    """(T, 3), newtons: total force of all loads; NaN in frames of a physically impossible motion."""
    presses: tuple[Load, ...] = ()

    def every(self, stride: int) -> Stream:
        """Return a stream that contains every ``stride``-th frame, starting with the first."""
        return Stream(
            self.frames_ohm[::stride],
            self.valid[::stride],
            self.noise[::stride],
            self.truth_m[::stride],
            self.force_n[::stride],
            self.presses,
        )


def stream(  # noqa: PLR0913 - the parts of a stream
    skin: Skin,
    presses: tuple[Load, ...],
    shares: Float,
    converter: Converter,
    rng: np.random.Generator,
    gain: Float | None = None,
) -> Stream:
    """Generate the stream of a patch deformed by one or more superposed presses.

    Args:
        skin: Patch to press.
        presses: Presses; their displacements are added.
        shares: (T,) fractions of the full depth, one per frame.
        converter: Converter that reads the resistances.
        rng: Random generator for the noise.
        gain: Factors by which the resistances are multiplied, (T, U, K) or broadcastable to that shape;
            default: 1.
    """
    truth = np.stack([skin.displacement_m(presses, share) for share in shares])
    resistance = np.stack([skin.resistance_ohm(moved) for moved in truth])
    if gain is not None:
        resistance = resistance * gain
    frames, valid, noise = converter.read(resistance, skin.rest_ohm, rng)
    force = np.array([sum((press.force_n(share) for press in presses), np.zeros(3)) for share in shares])
    return Stream(frames, valid, noise, truth, force, presses)


def random_press(  # noqa: PLR0913 - keyword arguments, each a range
    rng: np.random.Generator,
    layout: PatchLayout,
    depth: float,
    *,
    radius: tuple[float, float] = (1.5, 4.0),
    shear: float = 0.3,
    margin: float = 2.0,
    where: Literal["inside", "edge", "half off"] = "inside",
) -> Press:
    """Return a sphere that presses on the skin with random position, radius and friction.

    Args:
        rng: Random generator.
        layout: Patch to press.
        depth: Depth divided by the layer height.
        radius: Minimum and maximum radius of the sphere, in pitches.
        shear: Maximum coefficient of friction.
        margin: Minimum distance from the centre to the border of the patch, in pitches.
        where: ``inside``, ``edge`` or ``half off``. For ``edge``, the centre is on the patch's border in the
            x direction; for ``half off``, it is half a contact radius outside this border.
    """
    pitch = layout.pitch_m
    points = layout.upper_m[..., :2].reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    inset = np.minimum(margin * pitch, 0.4 * (high - low))
    center = rng.uniform(low + inset, high - inset)
    sphere = rng.uniform(*radius) * pitch
    sunk = depth * layout.height_m
    if where != "inside":
        right = rng.random() < 0.5
        outside = 0.0 if where == "edge" else 0.5 * np.sqrt(sphere * sunk)
        center[0] = high[0] + outside if right else low[0] - outside
    angle = rng.uniform(0, 2 * np.pi)
    friction = rng.uniform(0, shear)
    traction = (float(friction * np.cos(angle)), float(friction * np.sin(angle)))
    return Press((float(center[0]), float(center[1])), float(sphere), float(sunk), traction)
