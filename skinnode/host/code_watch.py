"""What the codes of a patch say of its converter and its wires, scan by scan. Plain code with one owner.

**Frozen.** A converter whose noise reaches the codes cannot give the same ones again and again. With a noise
of σ codes a reading keeps its code with a probability of at most 2Φ(1/2σ) − 1, when the truth lies in the
middle of a step; so n scans of m codes are all the same with at most that to the power of n·m. That must be
below ``FALSE_ALARM``, with σ from the hand file. A converter quieter than the file says may give the same
codes for hours: so the stream itself must have shown noise, ``FLICKERS`` scans in which a code went back to
where it had been (a touch, or rubber that creeps, goes one way), and the run must be ``LONGER`` times as long
as any that ended by itself. A converter that never flickers is never called frozen. Scans in which only
changed chunks were sent, or chunks are missing, are left out. What remains: a converter of a third of the
noise in the hand file flickers while rubber creeps, and rests then; it may be called frozen once.

**Wires.** Open or shorted: all crossings are, in a whole scan. Noisy and drifting are judged over windows of
``WINDOW`` scans and must hold in ``WINDOWS`` of them running. The second difference in time of a code leaves
out what moves evenly; a wire is noisy if its mean square is ``NOISY`` times that of the median wire of its
side, and of the noise expected. A wire drifts if the resistances of all its crossings went the same share of
R0 away from those of the median wire, and from rest, by more than ``DRIFT``, and its neighbours did not come
along: a touch is uneven along a wire, and the rubber takes the next wires with it. Of 780,000 instants of
simulated touches in which a wire was that far away, spheres of 2 mm to 0.3 m pressed in by 10 to 60 %, none
passes for a drift. So two neighbours that drift alike are not told of, nor a wire while something touches it.
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
"""A hand of 16 patches at 80 scans/s would be called frozen wrongly once in 25 years."""
FLICKERS: Final = 10
LONGER: Final = 4
LEAST_RUN: Final = 5
WINDOW: Final = 16
WINDOWS: Final = 3
NOISY: Final = 25.0
"""Five times the noise."""
DRIFT: Final = 1e-3
"""Of R0; a tenth of what a light touch does to the wire pairs below it."""
UNEVEN: Final = 0.05
"""Of the drift: how far any crossing of a wire may differ from their median."""
APART: Final = 0.3
"""Of the drift: how far the nearer of its neighbours must be."""


class WireState(enum.StrEnum):
    """What is wrong with a wire."""

    OPEN = "open"
    SHORT = "short"
    NOISY = "noisy"
    DRIFTING = "drifting"


@dataclass(frozen=True, slots=True, order=True)
class WireFault:
    """A wire and what is wrong with it."""

    side: str
    """``upper`` or ``lower``."""
    number: int
    state: WireState


class CodeWatch:
    """Watches the scans of one patch; ``relative_noise`` is that of its converter as the hand file says."""

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._relative_noise = scale, relative_noise
        self.frozen = False
        self.wires: tuple[WireFault, ...] = ()
        self._last: Codes | None = None
        self._before: Codes | None = None  # of each code the value it had before the present one
        self._run = self._longest = self._flickers = 0
        self._needed: float = math.inf
        self._broken: tuple[WireFault, ...] = ()
        self._odd: dict[WireFault, int] = {}  # windows running in which a wire was noisy or drifted
        self._window: list[Codes] = []
        self._measured: NDArray[np.bool_] | None = None  # which codes were in all of its scans; None: all

    def on_scan(self, scan: Scan) -> None:
        """The next scan."""
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
            self._tell()

    # --- frozen

    def _compare(self, codes: Codes, last: Codes, before: Codes) -> None:
        changed = codes != last
        if changed.any():
            if self._flickers < FLICKERS:  # more are not asked for
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
        """Scans in which the noise expected cannot keep all these codes the same."""
        measured = codes[codes <= self._scale.steps]
        if not measured.size or not self._relative_noise:
            return math.inf
        least_ratio = self._scale.lo + float(measured.min()) * self._scale.step
        sigma = self._relative_noise * max(least_ratio, self._scale.step) / self._scale.step
        leaves = math.erfc(0.5 / (sigma * math.sqrt(2.0)))  # probability that one code changes, at least
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
            self._judge_window()
            self._window, self._measured = [], None

    def _judge_window(self) -> None:
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
            # Away from rest too: where a touch has moved the median wire, the others are away from that.
            away = np.minimum(np.abs(gain - _median_of_known(gain)), np.abs(gain - 1.0))
            step = np.concatenate(([np.inf], np.abs(np.diff(gain)), [np.inf]))
            apart = np.fmin(step[:-1], step[1:])
            for state, is_so in (
                (WireState.NOISY, level > NOISY * quiet),
                (WireState.DRIFTING, (away > DRIFT) & (spread < UNEVEN * away) & (apart > APART * away)),
            ):
                odd |= {WireFault(side, int(i), state) for i in np.flatnonzero(is_so)}
        self._odd = {fault: self._odd.get(fault, 0) + 1 for fault in odd}
        self._tell()

    def _tell(self) -> None:
        lasting = (fault for fault, windows in self._odd.items() if windows >= WINDOWS)
        self.wires = tuple(sorted({*self._broken, *lasting}))


def _median(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """np.median where no value is NaN, in a third of the time that takes for a patch."""
    ordered, count = np.sort(values, axis=axis), values.shape[axis]
    middle: NDArray[np.float64] = ordered.take([(count - 1) // 2, count // 2], axis=axis).sum(axis=axis)
    return 0.5 * middle


def _median_of_known(values: NDArray[np.float64]) -> float:
    """Of those that are not NaN; NaN where all are."""
    known = values[~np.isnan(values)]
    return float(_median(known, 0)) if known.size else math.nan


def _of_wires(
    values: NDArray[np.float64], axis: int, whole: NDArray[np.bool_], plain: Any, without_nan: Any
) -> NDArray[np.float64]:
    """A number for each wire from its crossings, of which those not measured are NaN; NaN for a wire of which
    none was. The way for patches without a fault takes a tenth of the time of the other."""
    if not np.isnan(values).any():
        return np.asarray(plain(values, axis=axis))
    found = np.full(len(whole), np.nan)
    if whole.any():
        found[whole] = without_nan(np.compress(whole, values, axis=1 - axis), axis=axis)
    return found
