"""Faults for ``skinnode bench trust``, applied to arrays of readings and codes.

The faults include every simulator fault that changes values. Each fault is applied at the stage at which it
occurs in a real patch:

made    deviation of the patch from its layout, present when the baseline is measured
wired   wiring, before the converter adds noise
read    readings, after the converter has added noise
sent    codes, in transit to the host
stated  noise or tolerances stated in the hand file

``Signal.bad`` marks the readings changed by a fault. A fault reported for any other reading is a false alarm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.bench.trust_signal import PITCH_M, SCALE, Signal, Timeline
from skinnode.bench.truth import Skin
from skinnode.protocol.codes import MISSING

CHUNK: Final = 3
"""Number of 16-bit codes in a chunk on classic CAN."""
NOISY: Final = 3e-3
"""Relative noise of a wire with a bad contact; the simulator uses the same value."""
SETTLE: Final = 50
"""Number of scans at rest within which the host must detect an incorrect noise level in the hand file."""

InPlace = Callable[[Signal], None]


@dataclass(frozen=True, eq=False)
class Fault:
    """A fault that occurs at a random location and a random time in each stream."""

    name: str
    made: Callable[[Skin, np.random.Generator], Skin] | None = None
    wired: InPlace | None = None
    read: InPlace | None = None
    sent: InPlace | None = None
    timeline: Callable[[Timeline], Timeline] | None = None
    stated: float = 1.0
    """Ratio of the noise stated in the hand file to the true noise."""
    ordinary: bool = False
    """Whether the hand file states ordinary tolerances instead of exact positions."""
    local: bool = False
    """Whether the fault is confined to individual crossings or wires, so that the others can be trusted."""
    scored_from: int = 0
    """Index of the first scored scan."""
    group: str = ""
    """Group of mutually exclusive faults to which the fault belongs; empty if it can be combined with any
    fault."""


# --- places and times


def _one(signal: Signal, axis: int, many: int = 1) -> int:
    """Choose ``many`` adjacent upper (``axis`` 1) or lower (2) wires; return the index of the first wire."""
    return int(signal.rng.integers(signal.shape[axis] - many + 1))


def _pressed_wire(signal: Signal, axis: int) -> int:
    """Choose one of the three upper (``axis`` 1) or lower (2) wires most affected by the load."""
    middle = (signal.pressed.start + signal.pressed.stop) // 2
    change = np.abs(signal.ohm[middle] / signal.rest_ohm - 1.0).max(axis=2 - axis)
    most = np.argsort(change)[-3:]
    return int(signal.rng.choice(most))


def _crossing(signal: Signal) -> tuple[int, int]:
    """Choose one of the 30 crossings most affected by the load."""
    middle = (signal.pressed.start + signal.pressed.stop) // 2
    change = np.abs(signal.ohm[middle] / signal.rest_ohm - 1.0).ravel()
    at = int(signal.rng.choice(np.argsort(change)[-30:]))
    return divmod(at, signal.shape[2])


def _at_rest(signal: Signal) -> int:
    return int(signal.rng.integers(2, 8))


def _pressing(signal: Signal) -> int:
    """Choose a random scan during which the load is being applied."""
    first = max(1, signal.pressed.start - 6)
    return int(signal.rng.integers(first, max(first + 1, signal.pressed.start - 1)))


def _row(signal: Signal, axis: int, wire: int, start: int = 0) -> tuple[slice | int, ...]:
    """Return an index that selects all readings of one wire from scan ``start`` onwards."""
    scans = slice(start, None)
    return (scans, wire, slice(None)) if axis == 1 else (scans, slice(None), wire)


# --- codes


def _lose(share: float) -> InPlace:
    def sent(signal: Signal) -> None:
        scans, upper, lower = signal.shape
        lost = signal.rng.random((scans, -(-upper * lower // CHUNK))) < share
        gone = np.repeat(lost, CHUNK, axis=1)[:, : upper * lower].reshape(signal.shape)
        signal.codes[gone] = MISSING

    return sent


def _tear(signal: Signal) -> None:
    """Mark the second half of every fourth scan as missing."""
    signal.codes.reshape(len(signal.codes), -1)[::4, signal.codes[0].size // 2 :] = MISSING


def _lose_all(signal: Signal) -> None:
    signal.codes[signal.pressed.start + 4 : signal.pressed.start + 10] = MISSING


def _leave_one(signal: Signal) -> None:
    kept = signal.codes[:, 3, 7].copy()
    _lose_all(signal)
    signal.codes[:, 3, 7] = kept


def _freeze(start: Callable[[Signal], int], *, counted: bool = True) -> InPlace:
    """Return a function that repeats a scan's codes; ``counted`` is True if the patch counts conversions."""

    def sent(signal: Signal) -> None:
        t = start(signal)
        signal.phase[t + 1 :] = signal.phase[t]
        if not counted:
            signal.phase[:] = 0
        signal.codes[t + 1 :] = signal.codes[t]
        signal.bad[t + 1 :] = True

    return sent


def _freeze_wire(axis: int) -> InPlace:
    def sent(signal: Signal) -> None:
        t, at = _pressing(signal), _pressed_wire(signal, axis)
        rows = _row(signal, axis, at, t + 1)
        signal.codes[rows] = signal.codes[_row(signal, axis, at, t)][0]
        signal.bad[rows] = True

    return sent


def _stick(constant: bool) -> InPlace:
    def sent(signal: Signal) -> None:
        t, (u, k) = _at_rest(signal), _crossing(signal)
        value = signal.codes[t, u, k]
        if constant:  # the stuck value is a ratio R/R₀ between 0.6 and 1.1
            value = np.uint32(round((float(signal.rng.uniform(0.6, 1.1)) - SCALE.lo) / SCALE.step))
        signal.codes[t + 1 :, u, k] = value
        signal.bad[t + 1 :, u, k] = True

    return sent


def _flip(signal: Signal, scans: slice, u: int, k: int, bit: int) -> None:
    before = signal.codes[scans, u, k]
    signal.codes[scans, u, k] = np.where(before <= SCALE.steps, before ^ np.uint32(1 << bit), before)
    signal.bad[scans, u, k] = True


def _flip_once(signal: Signal) -> None:
    """Flip one bit of one code in one scan, which changes the code by more than the noise."""
    t = int(signal.rng.integers(2, signal.shape[0] - 2))
    _flip(signal, slice(t, t + 1), *_crossing(signal), int(signal.rng.integers(6, 16)))


def _flip_often(signal: Signal) -> None:
    """Flip a random bit of a random code in every third scan."""
    for t in range(2, signal.shape[0], 3):
        _flip(
            signal,
            slice(t, t + 1),
            _one(signal, 1),
            _one(signal, 2),
            int(signal.rng.integers(16)),
        )


def _flip_for_ever(signal: Signal) -> None:
    _flip(signal, slice(_at_rest(signal), None), *_crossing(signal), int(signal.rng.integers(6, 16)))


def _corrupt(signal: Signal) -> None:
    """Corrupt a byte of a random code in every tenth scan, as if the scans had no checksum."""
    for t in range(4, signal.shape[0], 10):
        u, k = _one(signal, 1), _one(signal, 2)
        low = signal.rng.random() < 0.5
        changed = signal.codes[t, u, k] ^ np.uint32(int(signal.rng.integers(1, 256)) << (0 if low else 8))
        if signal.codes[t, u, k] != MISSING:
            signal.codes[t, u, k] = changed
            signal.bad[t, u, k] = True


# --- wires


def _open(axis: int) -> InPlace:
    def read(signal: Signal) -> None:
        rows = _row(signal, axis, _one(signal, axis), _pressing(signal))
        signal.ohm[rows] = np.inf
        signal.bad[rows] = True

    return read


def _shorted_to_all(axis: int) -> InPlace:
    def read(signal: Signal) -> None:
        rows = _row(signal, axis, _one(signal, axis), _pressing(signal))
        signal.ohm[rows] = 0.0
        signal.bad[rows] = True

    return read


def _open_unmarked(axis: int) -> InPlace:
    """Return a function that opens a wire; its readings then float near the top of the converter range."""

    def wired(signal: Signal) -> None:
        at, t = _one(signal, axis), _pressing(signal)
        rows = _row(signal, axis, at, t)
        rest = signal.rest_ohm[at] if axis == 1 else signal.rest_ohm[:, at]
        signal.ohm[rows] = rest * signal.rng.uniform(1.1, 1.2)
        signal.bad[rows] = True

    return wired


def _two_shorted(axis: int) -> InPlace:
    """Return a function that shorts two adjacent wires; both then read their parallel resistance."""

    def wired(signal: Signal) -> None:
        at, t = _one(signal, axis, 2), _pressing(signal)
        first, second = _row(signal, axis, at, t), _row(signal, axis, at + 1, t)
        both = 1.0 / (1.0 / signal.ohm[first] + 1.0 / signal.ohm[second])
        signal.ohm[first] = signal.ohm[second] = both
        signal.bad[first] = signal.bad[second] = True

    return wired


def _crossed(axis: int, *, tared: bool) -> InPlace:
    """Return a function that swaps two adjacent wires before (``tared``) or after a baseline measurement."""

    def wired(signal: Signal) -> None:
        at = _pressed_wire(signal, axis)
        other = at + 1 if at + 1 < signal.shape[axis] else at - 1
        start = 0 if tared else _at_rest(signal)
        first, second = _row(signal, axis, at, start), _row(signal, axis, other, start)
        signal.ohm[first], signal.ohm[second] = signal.ohm[second].copy(), signal.ohm[first].copy()
        signal.bad[first] = signal.bad[second] = True
        if tared:
            rest = signal.rest_ohm if axis == 1 else signal.rest_ohm.T
            rest[[at, other]] = rest[[other, at]]

    return wired


def _gain(axis: int, by: float) -> InPlace:
    """Return a function that changes the gain of a wire after the baseline measurement."""

    def wired(signal: Signal) -> None:
        rows = _row(signal, axis, _pressed_wire(signal, axis), _at_rest(signal))
        signal.ohm[rows] *= 1.0 + by * signal.rng.choice((-1.0, 1.0))
        signal.bad[rows] = True

    return wired


def _noisy(axis: int) -> InPlace:
    def read(signal: Signal) -> None:
        rows = _row(signal, axis, _pressed_wire(signal, axis), _at_rest(signal))
        signal.ohm[rows] *= 1.0 + NOISY * signal.rng.standard_normal(signal.ohm[rows].shape)
        signal.bad[rows] = True

    return read


# --- geometry


def _placed(off: float) -> Callable[[Skin, np.random.Generator], Skin]:
    def made(skin: Skin, rng: np.random.Generator) -> Skin:
        upper, lower = skin.layout.shape
        return dataclasses.replace(
            skin,
            upper_shift_m=off * PITCH_M * rng.standard_normal((upper, 3)),
            lower_shift_m=off * PITCH_M * rng.standard_normal((lower, 3)),
        )

    return made


def _thick(by: float) -> Callable[[Skin, np.random.Generator], Skin]:
    return lambda skin, rng: dataclasses.replace(skin, height=1.0 + by)


def _wide(radius: float) -> Callable[[Skin, np.random.Generator], Skin]:
    return lambda skin, rng: dataclasses.replace(skin, electrode=radius)


# --- the stream


def _touched_at_start(timeline: Timeline) -> Timeline:
    return dataclasses.replace(timeline, rest=0, press=0)


def _long_rest(timeline: Timeline) -> Timeline:
    return dataclasses.replace(timeline, rest=SETTLE + 10)


def _noise_stated(name: str, ratio: float) -> Fault:
    return Fault(name, stated=ratio, timeline=_long_rest, scored_from=SETTLE, group="noise")


def some_bits() -> Fault:
    """Return a fault that flips one bit in every third scan."""
    return Fault("a bit flipped in every third scan", sent=_flip_often, local=True)


def singles() -> list[Fault]:
    """Return all faults, which the benchmark applies singly and in pairs."""
    upper, lower = 1, 2
    return [
        Fault("5 % of chunks lost", sent=_lose(0.05)),
        Fault("50 % of chunks lost", sent=_lose(0.5)),
        Fault("scans torn", sent=_tear),
        Fault("all readings lost", sent=_lose_all),
        Fault("one reading left", sent=_leave_one),
        Fault("patch frozen in mid-press", sent=_freeze(_pressing)),
        Fault("patch frozen, nothing counted", sent=_freeze(_pressing, counted=False)),
        Fault("patch frozen at rest", sent=_freeze(_at_rest)),
        Fault("patch frozen while held", sent=_freeze(lambda signal: signal.pressed.start + 5)),
        Fault("upper wire frozen", sent=_freeze_wire(upper), local=True),
        Fault("lower wire frozen", sent=_freeze_wire(lower), local=True),
        Fault("crossing frozen at last reading", sent=_stick(constant=False), local=True),
        Fault("crossing stuck at a constant", sent=_stick(constant=True), local=True),
        Fault("bit flipped once", sent=_flip_once, local=True),
        Fault("bit flipped for ever", sent=_flip_for_ever, local=True),
        Fault("byte corrupted, no check", sent=_corrupt, local=True),
        Fault("upper wire open", read=_open(upper), local=True),
        Fault("lower wire open", read=_open(lower), local=True),
        Fault("upper wire shorted to all", read=_shorted_to_all(upper), local=True),
        Fault("lower wire shorted to all", read=_shorted_to_all(lower), local=True),
        Fault("upper wire open, unmarked", wired=_open_unmarked(upper), local=True),
        Fault("lower wire open, unmarked", wired=_open_unmarked(lower), local=True),
        Fault("two upper wires shorted", wired=_two_shorted(upper), local=True),
        Fault("two lower wires shorted", wired=_two_shorted(lower), local=True),
        Fault("upper wires crossed", wired=_crossed(upper, tared=False), local=True),
        Fault("lower wires crossed", wired=_crossed(lower, tared=False), local=True),
        Fault("upper wires crossed, tared", wired=_crossed(upper, tared=True), local=True),
        Fault("lower wires crossed, tared", wired=_crossed(lower, tared=True), local=True),
        Fault("gain of an upper wire 1 % off", wired=_gain(upper, 0.01), local=True),
        Fault("gain of a lower wire 1 % off", wired=_gain(lower, 0.01), local=True),
        Fault("upper wire noisy", read=_noisy(upper), local=True),
        Fault("lower wire noisy", read=_noisy(lower), local=True),
        Fault("wires placed 0.01 pitch off", made=_placed(0.01), ordinary=True, group="place"),
        Fault("wires placed 0.02 pitch off", made=_placed(0.02), ordinary=True, group="place"),
        Fault("wires placed 0.05 pitch off", made=_placed(0.05), ordinary=True, group="place"),
        Fault("5 % thicker", made=_thick(0.05), ordinary=True, group="thickness"),
        Fault("5 % thinner", made=_thick(-0.05), ordinary=True, group="thickness"),
        Fault("electrodes of 0.05 pitch", made=_wide(0.05), ordinary=True),
        Fault("touched at start-up", timeline=_touched_at_start, group="noise"),
        _noise_stated("noise stated 10 times too low", 0.1),
        _noise_stated("noise stated 10 times too high", 10.0),
    ]
