"""Detect a frozen converter and faulty wires from the codes of a patch, scan by scan. No thread, one owner.

**Frozen.** A converter whose noise is visible in the codes cannot repeat the same codes for long. If the
noise has a standard deviation of σ codes, a reading repeats its code with a probability of at most 2Φ(1/2σ) −
1 (the value for a true resistance in the middle of a step), and the probability that n scans of m codes are
all equal is at most that value raised to the power n·m. For a run of equal scans to count as frozen, this
bound must be below ``FALSE_ALARM``, with σ from the hand file. A converter quieter than the file states may
repeat its codes for hours. Therefore the stream itself must also have shown noise, that is, ``FLICKERS``
scans in which a code returned to its previous value (a touch or creeping rubber moves codes in one direction
only), and the run must be ``LONGER`` times as long as any earlier run that ended on its own. A converter that
never flickers is never reported as frozen. Scans that contain only the changed chunks, or lack chunks, are
ignored. One false alarm remains possible: if a converter has only a third of the noise stated in the hand
file, its codes flicker while rubber creeps and are constant afterwards, so the converter may be reported
once.

**Wires.** A wire is open or shorted if all its crossings are open or shorted in a complete scan. Noise and
drift are evaluated over windows of ``WINDOW`` scans, and their criteria must be met in ``WINDOWS``
consecutive windows. Taking the second difference of a code over time removes steady movement; a wire is noisy
if the mean square of this difference exceeds ``NOISY`` times the value for the median wire on its side, and
``NOISY`` times the value for the expected noise. A wire drifts if the resistances of all its crossings have
changed by the same fraction of R0, if this change exceeds ``DRIFT`` relative to both the median wire and the
rest state, and if its neighbours have not followed. A touch, in contrast, changes the crossings of a wire
unevenly, and the rubber spreads the change to the adjacent wires. Simulated touches (spheres of 2 mm to 0.3 m
pressed in by 10 to 60 %) changed a wire by more than ``DRIFT`` at 780,000 instants; none was mistaken for
drift. Consequently, two neighbours that drift alike are not reported, nor is a wire while it is touched.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.codes import Codes, CodeScale
from skinnode.protocol.scan import Scan
from skinnode.protocol.summary import SummaryFlag

_CHANGED_ONLY: Final = int(SummaryFlag.CHANGED_ONLY)

FALSE_ALARM: Final = 1e-12
"""Maximum probability of a false alarm per run of equal scans: one alarm in 25 years for a hand of 16 patches
at 80 scans/s."""
FLICKERS: Final = 10
"""Number of scans in which a code must return to its previous value to prove that the codes contain noise."""
LONGER: Final = 4
"""Minimum ratio of the length of a frozen run to that of the longest run that ended on its own."""
LEAST_RUN: Final = 5
"""Minimum length of a frozen run, in scans."""
WINDOW: Final = 16
"""Number of scans in a window."""
WINDOWS: Final = 3
"""Number of consecutive windows in which a wire must be noisy or drift before it is reported."""
NOISY: Final = 25.0
"""Minimum ratio of a noisy wire's noise power to the median wire's: five times the amplitude."""
DRIFT: Final = 1e-3
"""Minimum drift as a fraction of R0: a tenth of the change that a light touch causes in the wire pairs below
it."""
UNEVEN: Final = 0.05
"""Maximum deviation of a crossing from the median of its wire, as a fraction of the drift."""
APART: Final = 0.3
"""Minimum difference in R / R0 between a wire and the more similar of its neighbours, as a fraction of the
drift."""


class WireState(enum.StrEnum):
    """Fault of a wire."""

    OPEN = "open"
    SHORT = "short"
    NOISY = "noisy"
    DRIFTING = "drifting"


@dataclass(frozen=True, slots=True, order=True)
class WireFault:
    """A wire and its fault."""

    side: str
    """``upper`` or ``lower``."""
    number: int
    state: WireState


class CodeWatch:
    """Fault detector for the scans of one patch. Owned by the mainline.

    Args:
        scale: Scale of the codes.
        relative_noise: Converter noise stated in the hand file, as a fraction of the resistance.
    """

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._relative_noise = scale, relative_noise
        self.frozen = False
        self.wires: tuple[WireFault, ...] = ()
        self._last: Codes | None = None
        self._before: Codes | None = None  # for each code, the value before its last change
        self._run = self._longest = self._flickers = 0
        self._needed: float = math.inf
        self._broken: tuple[WireFault, ...] = ()
        self._odd: dict[WireFault, int] = {}  # consecutive windows in which a wire was noisy or drifted
        self._window: list[Codes] = []
        self._measured: NDArray[np.bool_] | None = None  # codes present in all scans of the window; None: all

    def on_scan(self, scan: Scan) -> None:
        """Evaluate the next scan."""
        if not scan.complete or scan.flags & _CHANGED_ONLY:
            return
        codes, last = scan.codes, self._last
        self._last = codes
        if last is None or self._before is None:
            self._before = codes
            return
        self._compare(codes, last, self._before)
        whole = bool(scan.valid.all())
        broken = () if whole else self._find_broken(codes)
        if not whole:
            self._measured = scan.valid if self._measured is None else self._measured & scan.valid
        self._accumulate(codes)
        if broken != self._broken:
            self._broken = broken
            self._update_wires()

    # --- frozen

    def _compare(self, codes: Codes, last: Codes, before: Codes) -> None:
        changed = codes != last
        if changed.any():
            if self._flickers < FLICKERS:  # beyond this number, noise is proven
                self._flickers += bool((changed & (codes == before)).any())
                self._before = np.where(changed, last, before)
            by_itself = not self.frozen or np.abs(codes.astype(np.int64) - last).max() <= 1
            self._longest = max(self._longest, self._run if by_itself else 0)
            self._run, self.frozen = 0, False
            return
        self._run += 1
        if self._run == LEAST_RUN:
            shown = self._flickers >= FLICKERS
            self._needed = max(LONGER * self._longest, self._impossible(codes)) if shown else math.inf
        self.frozen = self._run >= LEAST_RUN and self._run >= self._needed

    def _impossible(self, codes: Codes) -> float:
        """Return the number of consecutive scans with the same codes that the expected noise rules out."""
        measured = codes[codes <= self._scale.steps]
        if not measured.size or not self._relative_noise:
            return math.inf
        least_ratio = self._scale.lo + float(measured.min()) * self._scale.step
        sigma = self._relative_noise * max(least_ratio, self._scale.step) / self._scale.step
        leaves = math.erfc(0.5 / (sigma * math.sqrt(2.0)))  # minimum probability that a code changes
        if leaves >= 1.0:
            return LEAST_RUN
        stays = -math.log1p(-leaves) * measured.size
        return math.log(1.0 / FALSE_ALARM) / stays if stays > 0.0 else math.inf

    # --- wires

    def _find_broken(self, codes: Codes) -> tuple[WireFault, ...]:
        found = []
        for state, code in ((WireState.OPEN, self._scale.open), (WireState.SHORT, self._scale.short)):
            is_so = codes == code
            for side, axis in (("upper", 1), ("lower", 0)):
                found += [WireFault(side, int(i), state) for i in np.flatnonzero(is_so.all(axis=axis))]
        return tuple(sorted(found))

    def _accumulate(self, codes: Codes) -> None:
        self._window.append(codes)
        if len(self._window) == WINDOW:
            self._evaluate_window()
            self._window, self._measured = [], None

    def _evaluate_window(self) -> None:
        scale, every = self._scale, np.ones(self._window[0].shape, np.bool_)
        measured = every if self._measured is None else self._measured
        if not measured.any():
            self._odd = {}
            return
        codes = np.array(self._window, dtype=np.float64)
        ratio = np.where(measured, scale.lo + codes.mean(axis=0) * scale.step, np.nan)
        # A second difference has six times the variance of a value: 1 + 4 + 1.
        roughness = (np.diff(codes, 2, axis=0) ** 2).sum(axis=0)
        noise = np.where(measured, roughness / (6.0 * (WINDOW - 2)), np.nan)
        expected = (self._relative_noise / scale.step) ** 2 + 1.0 / 12.0
        odd: set[WireFault] = set()
        for side, axis in (("upper", 1), ("lower", 0)):
            whole = np.asarray(measured.any(axis=axis))
            level = _of_wires(noise, axis, whole, np.mean, np.nanmean)
            gain = _of_wires(ratio, axis, whole, _median, np.nanmedian)
            off = np.abs(ratio - (gain[:, None] if axis else gain))
            spread = _of_wires(off, axis, whole, np.max, np.nanmax)
            quiet = max(expected, _median_of_known(level))
            # The distance from rest also matters: if a touch moved the median wire, the untouched wires
            # deviate from the median.
            away = np.minimum(np.abs(gain - _median_of_known(gain)), np.abs(gain - 1.0))
            step = np.concatenate(([np.inf], np.abs(np.diff(gain)), [np.inf]))
            apart = np.fmin(step[:-1], step[1:])
            for state, is_so in (
                (WireState.NOISY, level > NOISY * quiet),
                (WireState.DRIFTING, (away > DRIFT) & (spread < UNEVEN * away) & (apart > APART * away)),
            ):
                odd |= {WireFault(side, int(i), state) for i in np.flatnonzero(is_so)}
        self._odd = {fault: self._odd.get(fault, 0) + 1 for fault in odd}
        self._update_wires()

    def _update_wires(self) -> None:
        lasting = (fault for fault, windows in self._odd.items() if windows >= WINDOWS)
        self.wires = tuple(sorted({*self._broken, *lasting}))


def _median(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the median of values that contain no NaN; for a patch, three times as fast as ``np.median``."""
    ordered, count = np.sort(values, axis=axis), values.shape[axis]
    middle: NDArray[np.float64] = ordered.take([(count - 1) // 2, count // 2], axis=axis).sum(axis=axis)
    return 0.5 * middle


def _median_of_known(values: NDArray[np.float64]) -> float:
    """Return the median of the values that are not NaN; NaN if all are NaN."""
    known = values[~np.isnan(values)]
    return float(_median(known, 0)) if known.size else math.nan


def _of_wires(
    values: NDArray[np.float64], axis: int, whole: NDArray[np.bool_], plain: Any, without_nan: Any
) -> NDArray[np.float64]:
    """Reduce each wire's crossings to one number, ignoring NaN (not measured); NaN if all are NaN.

    The branch for patches without faults is ten times as fast as the other branch.
    """
    if not np.isnan(values).any():
        return np.asarray(plain(values, axis=axis))
    found = np.full(len(whole), np.nan)
    if whole.any():
        found[whole] = without_nan(np.compress(whole, values, axis=1 - axis), axis=axis)
    return found
