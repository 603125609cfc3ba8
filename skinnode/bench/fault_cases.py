"""Hard cases 14 to 16 of ``skinnode bench stability``: wrong data, imperfect patches and wide touches.

The data of case 14 are wrong but not marked invalid. Only wires that are CONVERGED and trusted must be
accurate. Case 14 is limited to trackers, the only solvers that test their input. A tracker receives
resistances, not codes, so it cannot recognise a frozen wire by its repeated codes; the host can
(:mod:`skinnode.host.frozen_parts`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from skinnode.bench.case import FINE, PATHS, PITCH_M, Case, preset, press_and_release, pressing
from skinnode.bench.trust_loads import draw
from skinnode.bench.truth import Converter, Load, Press, Skin, Stream, random_press
from skinnode.model.layout import PatchLayout
from skinnode.model.tolerances import ORDINARY
from skinnode.protocol.codes import CodeScale

Spoil = Callable[[np.random.Generator, Stream, Skin], Stream]

SHARES: Final = np.array([0.0, 0.0, 0.0, 0.0, 0.25, 0.5, 0.75, 1.0, 1.0, 1.0, 1.0, 0.6, 0.3, 0.0])
"""Press depth in each frame of case 14, as a fraction of the full depth."""
FAILS: Final = 5
"""Index of the first frame with wrong data in case 14; the press begins one frame earlier."""
TESTED: Final = ("exact", "auto")
"""Methods tested with wrong data in case 14."""
KNOWN: Final = {
    ("upper wire frozen", "1e-5"),
    ("upper wire frozen", "1e-4"),
    ("bits flipped", "1e-5"),
    ("bits flipped", "1e-4"),
    ("lower wires crossed, tared", "1e-4"),
}
"""Pairs of fault and noise level for which a few trusted wires are known to be wrong; ``docs/limits.md``
gives the reasons."""
UPPER, LOWER = 1, 2
"""Axis indices of the upper and lower wires in a (T, U, K) array."""


def fault_cases() -> Iterator[Case]:
    """Yield the cases with wrong data, misplaced wires, and wide or sheared touches."""
    yield from _wrong_data()
    yield from _tolerances()
    yield from _touches()


def _wrong_data() -> Iterator[Case]:
    for converter, noise in ((FINE, "1e-5"), (Converter(sigma=1e-4), "1e-4")):
        skin = Skin(preset("staggered", 0.5))
        for name, spoil in (
            ("crossing stuck", _stuck),
            ("upper wire frozen", _frozen(UPPER)),
            ("lower wire frozen", _frozen(LOWER)),
            ("bits flipped", _flipped),
            ("lower wire open, unmarked", _open(LOWER)),
            ("two lower wires shorted", _shorted(LOWER)),
            ("two upper wires shorted", _shorted(UPPER)),
            ("lower wires crossed, tared", _crossed(LOWER)),
            ("half of the chunks lost", _half),
        ):
            make = pressing(skin, 0.3, converter, SHARES, spoil=spoil)
            known = TESTED if (name, noise) in KNOWN else ()
            yield Case(14, f"{name}, noise {noise}", skin, make, TESTED, converter, known_wrong=known)


def _tolerances() -> Iterator[Case]:
    layout = preset("staggered", 0.5)
    for off in (0.01, 0.02, 0.05):
        # All streams of a case share one baseline and therefore the same shifts.
        rng = np.random.default_rng([15, round(1000 * off)])
        upper, lower = (off * PITCH_M * rng.standard_normal((count, 3)) for count in layout.shape)
        skin = Skin(layout, upper_shift_m=upper, lower_shift_m=lower)
        make = pressing(skin, 0.3, FINE, press_and_release(3))
        name = f"wires placed {off:g} pitch off, staggered h=0.5"
        yield Case(15, name, skin, make, ("posterior", "auto"), tolerances=ORDINARY)


def _touches() -> Iterator[Case]:
    for kind in ("staggered", "aligned"):
        skin = Skin(preset(kind, 0.5))

        def plate(rng: np.random.Generator, layout: PatchLayout = skin.layout) -> tuple[Load, ...]:
            return (draw("whole patch", layout, rng),)

        make = pressing(skin, 0.0, FINE, press_and_release(3), presses=plate)
        yield Case(16, f"whole patch pressed, {kind} h=0.5", skin, make)
    skin = Skin(preset("aligned", 0.5))

    def sheared(rng: np.random.Generator) -> tuple[Press, ...]:
        angle, press = rng.uniform(0, 2 * np.pi), random_press(rng, skin.layout, 0.7)
        shear = float(0.8 * np.cos(angle)), float(0.8 * np.sin(angle))
        return (dataclasses.replace(press, traction_ratio=shear),)

    make = pressing(skin, 0.7, Converter(), np.linspace(0.0, 1.0, 21), presses=sheared)
    yield Case(9, "aligned h=0.5, 70%, shear 0.8, 20 samples", skin, make, PATHS, Converter())


# --- wrong data


def _spoilt(taken: Stream, frames: np.ndarray, valid: np.ndarray | None = None) -> Stream:
    return dataclasses.replace(taken, frames_ohm=frames, valid=taken.valid if valid is None else valid)


def _moved(taken: Stream, skin: Skin) -> np.ndarray:
    """Return the (U, K) magnitudes of the relative resistance changes at full depth."""
    return np.asarray(np.abs(taken.frames_ohm[8] / skin.rest_ohm - 1.0))


def _wire(rng: np.random.Generator, taken: Stream, skin: Skin, axis: int) -> int:
    """Choose one of the three wires most affected by the press."""
    return int(rng.choice(np.argsort(_moved(taken, skin).max(axis=2 - axis))[-3:]))


def _rows(axis: int, wire: int, start: int = FAILS) -> tuple[slice | int, ...]:
    return (slice(start, None), *((wire, slice(None)) if axis == UPPER else (slice(None), wire)))


def _stuck(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    frames = taken.frames_ohm.copy()
    moved = _moved(taken, skin).ravel()
    u, k = divmod(int(rng.choice(np.argsort(moved)[-30:])), frames.shape[2])
    frames[FAILS:, u, k] = frames[FAILS - 1, u, k]
    return _spoilt(taken, frames)


def _frozen(axis: int) -> Spoil:
    def spoil(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
        frames, rows = taken.frames_ohm.copy(), _rows(axis, _wire(rng, taken, skin, axis))
        frames[rows] = frames[rows][0]
        return _spoilt(taken, frames)

    return spoil


def _flipped(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    """Flip one of the upper ten bits of a code in every second frame."""
    frames, scale = taken.frames_ohm.copy(), CodeScale(16)
    for t in range(1, len(frames), 2):
        u, k = (int(rng.integers(count)) for count in frames.shape[1:])
        code = round((frames[t, u, k] / skin.rest_ohm[u, k] - scale.lo) / scale.step)
        code ^= 1 << int(rng.integers(6, 16))
        frames[t, u, k] = (scale.lo + code * scale.step) * skin.rest_ohm[u, k]
    return _spoilt(taken, frames)


def _open(axis: int) -> Spoil:
    """Return a function that opens a wire; its readings then float near the top of the converter range."""

    def spoil(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
        frames, wire = taken.frames_ohm.copy(), int(rng.integers(taken.frames_ohm.shape[axis]))
        rest = np.broadcast_to(skin.rest_ohm, frames.shape)
        rows = _rows(axis, wire)
        noise = 1.0 + taken.noise[rows] * rng.standard_normal(frames[rows].shape)
        frames[rows] = 1.15 * rest[rows] * noise
        return _spoilt(taken, frames)

    return spoil


def _shorted(axis: int) -> Spoil:
    """Return a function that shorts two adjacent wires; both then read their parallel resistance."""

    def spoil(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
        frames, wire = taken.frames_ohm.copy(), int(rng.integers(taken.frames_ohm.shape[axis] - 1))
        first, second = _rows(axis, wire), _rows(axis, wire + 1)
        frames[first] = frames[second] = 1.0 / (1.0 / frames[first] + 1.0 / frames[second])
        return _spoilt(taken, frames)

    return spoil


def _crossed(axis: int) -> Spoil:
    """Return a function that swaps R/R₀ of two adjacent wires, as if they had been swapped before taring."""

    def spoil(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
        frames, wire = taken.frames_ohm.copy(), _wire(rng, taken, skin, axis)
        other = wire + 1 if wire + 1 < frames.shape[axis] else wire - 1
        ratio, rest = frames / skin.rest_ohm, np.broadcast_to(skin.rest_ohm, frames.shape)
        for here, there in ((wire, other), (other, wire)):
            frames[_rows(axis, here, 0)] = ratio[_rows(axis, there, 0)] * rest[_rows(axis, here, 0)]
        return _spoilt(taken, frames)

    return spoil


def _half(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    """Drop each chunk of three codes with a probability of 50 %."""
    valid = taken.valid.copy()
    lost = np.repeat(rng.random((len(valid), valid[0].size // 3)) < 0.5, 3, axis=1)
    valid &= ~lost.reshape(valid.shape)
    return _spoilt(taken, np.where(valid, taken.frames_ohm, np.nan), valid)
