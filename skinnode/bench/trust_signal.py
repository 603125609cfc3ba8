"""Generates code streams and their true displacements, for ``skinnode bench trust``.

A stream is generated in these steps::

    load, timeline -> displacement -> true resistances -> noise -> faults -> codes -> faults

The six phases of a stream are: rest, press, hold, slide, release, and rest again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.bench.truth import Load, Skin
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import MISSING, Codes, CodeScale, as_baseline, encode

if TYPE_CHECKING:
    from skinnode.bench.trust_faults import Fault

PITCH_M: Final = 4e-3
LAYOUTS: Final = (("staggered", 0.5), ("staggered", 1.0), ("aligned", 0.5))
"""Layouts as (preset name, layer height in pitches)."""
NOISES: Final = (1e-5, 1e-4, 1e-3)
SCALE: Final = CodeScale(16)
RATE_HZ: Final = 100.0
"""Scan rate used to convert numbers of scans to hours, in Hz."""


@dataclass(frozen=True)
class Timeline:
    """Number of scans in each phase of a stream; by default, about 5 s in total at 12.5 scans/s."""

    rest: int = 12
    press: int = 8
    hold: int = 10
    slide: int = 10
    release: int = 6
    after: int = 10

    @property
    def scans(self) -> int:
        """Total number of scans."""
        return self.rest + self.press + self.hold + self.slide + self.release + self.after

    @property
    def shares(self) -> Float:
        """(T,) depth of the load in each scan, as a fraction of the full depth."""
        ramp = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, self.press + 1) / self.press)
        lift = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, self.release + 1) / self.release)
        held = np.ones(self.hold + self.slide)
        return np.concatenate([np.zeros(self.rest), ramp, held, lift, np.zeros(self.after)])

    @property
    def slid(self) -> Float:
        """(T,) position of the load in each scan, as a fraction of the total sliding distance."""
        way = np.zeros(self.scans)
        start = self.rest + self.press + self.hold
        way[start : start + self.slide] = np.arange(1, self.slide + 1) / max(self.slide, 1)
        way[start + self.slide :] = 1.0
        return way


@dataclass(eq=False)
class Signal:
    """Readings and codes of a converter; faults modify them in place."""

    rng: np.random.Generator
    rest_ohm: Float
    """(U, K), ohm: baseline resistances stored in the node."""
    ohm: Float
    """(T, U, K), ohm: readings."""
    bad: NDArray[np.bool_]
    """(T, U, K) bool: True where a fault changed the reading."""
    pressed: slice
    """Range of scans in which the load is at full depth."""
    phase: NDArray[np.int64]
    """(T,) conversion phase sent in each summary: 1, 2, 3, 1, …; always 0 if the patch does not count
    conversions."""
    codes: Codes = field(default_factory=lambda: np.zeros(0, np.uint32))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, U, K): numbers of scans, upper wires and lower wires."""
        scans, upper, lower = self.ohm.shape
        return scans, upper, lower


@dataclass(frozen=True, eq=False)
class CodeStream:
    """A patch's scans as received by the host, with the true displacements and forces."""

    layout: PatchLayout
    baseline_ohm: Float
    """(U, K), ohm: baseline resistances stored in the node."""
    stated_noise: float
    """Relative noise stated in the hand file."""
    ordinary: bool
    """Whether the hand file states ordinary manufacturing tolerances for the patch."""
    codes: Codes
    """(T, U, K) received codes; MISSING if the chunk was lost."""
    truth_m: Float
    """(T, U, N, 3), metres: true displacement."""
    force_n: Float
    """(T, 3), newtons: true force on the skin; NaN if unknown."""
    bad: NDArray[np.bool_]
    """(T, U, K) bool: True where a fault changed the reading."""
    touched: NDArray[np.bool_]
    """(T,) bool: True while the load is at full depth."""
    untouched: NDArray[np.bool_]
    """(T,) bool: True while the patch is at rest."""
    phase: NDArray[np.int64]
    """(T,) conversion phase received in each summary; always 0 if the patch does not count conversions."""
    scored_from: int = 0
    """Index of the first scored scan."""


@dataclass(frozen=True)
class Setting:
    """A layout and a noise level."""

    preset: str
    height: float
    """Height of the upper layer above the lower layer, in pitches."""
    noise: float

    @property
    def name(self) -> str:
        """Short description for reports; also used to seed the streams."""
        return f"{self.preset} h={self.height:g}, {self.noise:.0e}".replace("e-0", "e-")

    def layout(self) -> PatchLayout:
        """Return the layout of the patch."""
        return PatchLayout.preset(self.preset, pitch_m=PITCH_M, height_m=self.height * PITCH_M)


def all_settings() -> list[Setting]:
    """Return all combinations of layout and noise level."""
    return [Setting(preset, height, noise) for preset, height in LAYOUTS for noise in NOISES]


def make(
    setting: Setting, load: Load, faults: Sequence[Fault], rng: np.random.Generator, timeline: Timeline
) -> CodeStream:
    """Generate the code stream of a loaded patch with faults.

    Args:
        setting: Layout and noise.
        load: Load on the patch.
        faults: Faults, in the order in which they are applied.
        rng: Random generator for noise and faults.
        timeline: Phases of the stream.
    """
    layout = setting.layout()
    skin, stated, ordinary, scored_from = Skin(layout), setting.noise, False, 0
    for fault in faults:
        if fault.timeline is not None:
            timeline = fault.timeline(timeline)
        if fault.made is not None:
            skin = fault.made(skin, rng)
        stated *= fault.stated
        ordinary |= fault.ordinary
        scored_from = max(scored_from, fault.scored_from)
    truth, force = motion(layout, load, timeline, rng)
    ohm = _resistances(skin, truth)
    start = timeline.rest + timeline.press
    signal = Signal(
        rng,
        skin.rest_ohm.copy(),
        ohm,
        np.zeros(ohm.shape, bool),
        slice(start, start + timeline.hold + timeline.slide),
        1 + np.arange(timeline.scans) % 3,
    )
    for fault in faults:
        if fault.wired is not None:
            fault.wired(signal)
    signal.ohm *= 1.0 + setting.noise * rng.standard_normal(ohm.shape)
    for fault in faults:
        if fault.read is not None:
            fault.read(signal)
    signal.codes = encode(signal.ohm, signal.rest_ohm, SCALE)
    for fault in faults:
        if fault.sent is not None:
            fault.sent(signal)
    shares = timeline.shares
    return CodeStream(
        layout,
        as_baseline(signal.rest_ohm),
        stated,
        ordinary,
        signal.codes,
        truth,
        force,
        signal.bad & (signal.codes != MISSING),
        shares == 1.0,
        shares == 0.0,
        signal.phase,
        scored_from,
    )


def _resistances(skin: Skin, truth: Float) -> Float:
    """Return the (T, U, K) resistances in ohms; the resistances at rest are computed only once."""
    ohm = np.repeat(skin.rest_ohm[None], len(truth), axis=0)
    for t in np.flatnonzero(truth.any(axis=(1, 2, 3))):
        ohm[t] = skin.resistance_ohm(truth[t])
    return ohm


def motion(
    layout: PatchLayout, load: Load, timeline: Timeline, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Return a sliding load's (T, U, N, 3) displacement in metres and (T, 3) force in newtons.

    The load slides by two pitches in a random direction, roughly towards the middle of the patch.
    """
    points = layout.upper_m[..., :2].reshape(-1, 2)
    toward = 0.5 * (points.min(axis=0) + points.max(axis=0)) - load.center_m
    angle = rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(angle), np.sin(angle)]) * 2.0 * layout.pitch_m
    way *= 1.0 if way @ toward >= 0 else -1.0
    shares, slid = timeline.shares, timeline.slid
    truth = np.zeros((timeline.scans, *layout.upper_m.shape))
    for t, (share, gone) in enumerate(zip(shares, slid, strict=True)):
        if share > 0.0:
            truth[t] = load.displacement_m(points - gone * way, share).reshape(layout.upper_m.shape)
    force = np.array([load.force_n(share) if share > 0.0 else np.zeros(3) for share in shares])
    return truth, force
