"""Detect noisy and drifting wires, and measure the noise of the codes.

The tests for noise and drift evaluate windows of ``WINDOW`` successive scans. A wire is reported once it has
been noisy, or drifting, in ``WINDOWS`` consecutive windows.

**Noise.** The noise power of a wire is estimated from the second differences of its codes over time, which
are zero for a steady change. A wire is noisy if its noise power exceeds both ``NOISY`` times the expected
noise power and ``NOISY`` times the median over all wires of its kind (upper or lower).

**Drift.** A wire drifts if the resistances of all its crossings have changed by the same fraction of R0 but
those of the adjacent wires have not. The change must exceed ``DRIFT`` both relative to R0 and relative to the
median wire. A touch does not meet these conditions: it changes the crossings of a wire unevenly, and the
rubber carries the change to the adjacent wires. None of 780,000 simulated touches that changed a wire by more
than ``DRIFT`` was mistaken for drift. The test misses drift that affects adjacent wires equally, and drift of
a wire that is being touched.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.host.open_and_shorted_wires import WireFault, WireState
from skinnode.protocol.codes import Codes, CodeScale
from skinnode.protocol.scan import Scan

WINDOW: Final = 16
"""Number of scans in a window."""
WINDOWS: Final = 3
"""Number of consecutive windows in which a wire must be noisy, or drifting, to be reported."""
NOISY: Final = 25.0
"""Minimum noise power of a noisy wire, relative to the median over all upper or all lower wires. This
corresponds to 5 times the median noise amplitude.
"""
DRIFT: Final = 1e-3
"""Minimum change in a drifting wire, as a fraction of R0. Even a light touch changes a crossing ten times as
much.
"""
UNEVEN: Final = 0.05
"""Maximum deviation of a drifting wire's crossings from their median, as a fraction of the drift."""
APART: Final = 0.3
"""Minimum difference in R/R0 between a drifting wire and each adjacent wire, as a fraction of the drift."""
_SHOWN: Final = 8
"""Number of recent windows used to determine :attr:`WireWindows.shown_noise`."""


class WireWindows:
    """Detector for noise and drift in one patch's wires. Used only by the mainline.

    Args:
        scale: Mapping of R/R0 to codes.
        relative_noise: Converter noise stated in the hand file, relative to the resistance.
    """

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._relative_noise = scale, relative_noise
        self.wires: tuple[WireFault, ...] = ()
        """Wires currently reported as noisy or drifting."""
        self.windows = 0
        """Number of windows evaluated so far."""
        self._odd: dict[WireFault, int] = {}  # number of consecutive windows with each fault
        self._window: list[Codes] = []
        # mask of the crossings measured in every scan of the window; None if all were measured
        self._measured: NDArray[np.bool_] | None = None
        self._shown: deque[float] = deque(maxlen=_SHOWN)

    @property
    def shown_noise(self) -> float:
        """Smallest noise (codes) in the recent windows; 0 if the noise was not measurable in one of them."""
        return min(self._shown) if len(self._shown) == _SHOWN else 0.0

    def on_scan(self, scan: Scan) -> None:
        """Add the next scan, which must contain the codes of all crossings."""
        if not scan.valid.all():
            self._measured = scan.valid if self._measured is None else self._measured & scan.valid
        self._window.append(scan.codes)
        if len(self._window) == WINDOW:
            self._evaluate_window()
            self._window, self._measured = [], None
            self.windows += 1

    def _evaluate_window(self) -> None:
        scale, every = self._scale, np.ones(self._window[0].shape, np.bool_)
        measured = every if self._measured is None else self._measured
        if not measured.any():
            self._odd, self.wires = {}, ()
            self._shown.append(0.0)
            return
        codes = np.array(self._window, dtype=np.float64)
        ratio = np.where(measured, scale.lo + codes.mean(axis=0) * scale.step, np.nan)
        # A second difference has 1 + 4 + 1 = 6 times the variance of a value.
        roughness = (np.diff(codes, 2, axis=0) ** 2).sum(axis=0)
        noise = np.where(measured, roughness / (6.0 * (WINDOW - 2)), np.nan)
        self._shown.append(_shown_noise(codes, noise))
        expected = (self._relative_noise / scale.step) ** 2 + 1.0 / 12.0
        odd: set[WireFault] = set()
        for side, axis in (("upper", 1), ("lower", 0)):
            whole = np.asarray(measured.any(axis=axis))
            level = _of_wires(noise, axis, whole, np.mean, np.nanmean)
            gain = _of_wires(ratio, axis, whole, _median, np.nanmedian)
            off = np.abs(ratio - (gain[:, None] if axis else gain))
            spread = _of_wires(off, axis, whole, np.max, np.nanmax)
            quiet = max(expected, _median_of_known(level))
            # The deviation from the median alone is misleading: if a touch changes the median wire, the
            # untouched wires deviate from it.
            away = np.minimum(np.abs(gain - _median_of_known(gain)), np.abs(gain - 1.0))
            step = np.concatenate(([np.inf], np.abs(np.diff(gain)), [np.inf]))
            apart = np.fmin(step[:-1], step[1:])
            for state, is_so in (
                (WireState.NOISY, level > NOISY * quiet),
                (WireState.DRIFTING, (away > DRIFT) & (spread < UNEVEN * away) & (apart > APART * away)),
            ):
                odd |= {WireFault(side, int(i), state) for i in np.flatnonzero(is_so)}
        self._odd = {fault: self._odd.get(fault, 0) + 1 for fault in odd}
        self.wires = tuple(sorted(fault for fault, windows in self._odd.items() if windows >= WINDOWS))


def _shown_noise(codes: NDArray[np.float64], power: NDArray[np.float64]) -> float:
    """Return the lower quartile (codes) of the noise over the crossings; 0 if it is not measurable.

    A crossing counts as noiseless if its codes span fewer than three values. Two values are not enough,
    because even without noise a resistance at the edge of a quantization step may alternate between two
    codes. A crossing also counts as noiseless if its mean code changes significantly between the first and
    second halves of the window.

    Args:
        codes: (WINDOW, U, K) codes of a window.
        power: (U, K) mean square of the noise, in codes²; NaN where a code is not a measurement.
    """
    half = WINDOW // 2
    moved = np.abs(codes[half:].mean(axis=0) - codes[:half].mean(axis=0))
    rests = (codes.max(axis=0) - codes.min(axis=0) >= 2.0) & (moved <= 1.0 + np.sqrt(power))
    shown = np.where(rests, power, 0.0)[~np.isnan(power)]
    return float(np.sqrt(np.partition(shown, shown.size // 4)[shown.size // 4]))


def _median(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the median of values without NaN; three times as fast as ``np.median`` for small arrays."""
    ordered, count = np.sort(values, axis=axis), values.shape[axis]
    middle: NDArray[np.float64] = ordered.take([(count - 1) // 2, count // 2], axis=axis).sum(axis=axis)
    return 0.5 * middle


def _median_of_known(values: NDArray[np.float64]) -> float:
    """Return the median of the values that are not NaN; NaN if there are none."""
    known = values[~np.isnan(values)]
    return float(_median(known, 0)) if known.size else math.nan


def _of_wires(
    values: NDArray[np.float64], axis: int, whole: NDArray[np.bool_], plain: Any, without_nan: Any
) -> NDArray[np.float64]:
    """Reduce the values of the crossings on each wire to one value; NaN if none was measured.

    NaN in ``values`` marks a crossing that was not measured. If there is no NaN, ``plain`` is used instead of
    ``without_nan``, because it takes a tenth of the time.
    """
    if not np.isnan(values).any():
        return np.asarray(plain(values, axis=axis))
    found = np.full(len(whole), np.nan)
    if whole.any():
        found[whole] = without_nan(np.compress(whole, values, axis=1 - axis), axis=axis)
    return found
