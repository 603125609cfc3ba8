"""Determine from the conversion phase and from repeated codes whether a patch's converter is running.

**Phase.** Some patches count their conversions and send the conversion phase
(:attr:`~skinnode.protocol.summary.SummaryFlag.CONVERSIONS`). A new phase proves that a conversion has taken
place. Two successive scans with the same phase and the same codes contain the same conversion. If a scan or
summary was lost in between, an unchanged phase proves nothing.

**Repeats.** Without a phase, only the codes show whether the converter is running. A run is a sequence of
scans in which no code changes. A converter counts as stopped if all of these conditions hold:

- With the noise stated in the hand file, a running converter would produce such a run with a probability of
  at most ``FALSE_ALARM``.
- With lower noise, the probability is at most ``FALSE_ALARM_QUIET``. The lower noise is the stated noise
  divided by ``QUIETER``, or half the noise measured by :mod:`skinnode.host.noisy_and_drifting_wires` if that
  is larger.
- The codes are known to be noisy: in at least ``FLICKERS`` earlier scans, a code has returned to the value it
  had before its last change.
- The run is at least ``LONGER`` times as long as any earlier run while the converter was running. Runs at
  rest and runs under a press are compared separately: a converter that repeats its codes for minutes at rest
  may repeat them for only two or three scans under a press.

**Doubt.** A few repeated scans do not prove that a converter has stopped, but the fields may still show a
press that has ended. If all codes stop changing in the middle of a movement, the next ``DOUBT_RUN`` fields
are therefore not trusted. This rule applies only to patches that send no phase and whose codes are noisy and
have never all repeated before.

If neither the phase nor the codes are conclusive and no code has changed for a second, the state is unknown
(:attr:`Alive.CANNOT_TELL`).
"""

from __future__ import annotations

import enum
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.host.repeat_odds import deviations_of, log_stay, log_stay_anywhere
from skinnode.host.repeated_codes import LEAST_RUN
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.scan import Scan
from skinnode.protocol.summary import SummaryFlag
from skinnode.text.words import counted

_SOURCE_FAILED: Final = int(SummaryFlag.SOURCE_FAILED)
_CHANGED_ONLY: Final = int(SummaryFlag.CHANGED_ONLY)

FALSE_ALARM: Final = 1e-12
"""False alarm probability of each test for a frozen crossing, wire or patch. A patch with 10 × 30 wires
requires 341 tests per scan: 300 crossings, 40 wires and the patch. Ten hours at 100 scans/s result in 1.2e9
tests and about 0.001 false alarms.
"""
FALSE_ALARM_QUIET: Final = 1e-8
"""False alarm probability of the frozen-patch test if the noise is only 1/``QUIETER`` of the stated noise. In
ten hours (3.6e6 scans), such a patch causes about 0.04 false alarms.
"""
QUIETER: Final = 10.0
"""Factor by which the noise stated in the hand file may exceed a converter's actual noise."""
ABRUPT: Final = 16
"""Threshold (codes) for detecting the abrupt end of a movement. It applies to the largest code change in the
last scan before the codes stop changing. The value has not been tuned.
"""
DOUBT_RUN: Final = 64
"""Number of untrusted fields after the abrupt end of a movement. Most simulated converters that stopped
mid-press were detected within 11 scans, a few after more than 16.
"""
FLICKERS: Final = 5
"""Number of scans in which a code must return to the value it had before its last change for a patch's codes
to count as noisy.
"""
LONGER: Final = 4
"""Minimum length of a run that counts as frozen, as a multiple of the longest run while the converter was
running.
"""
PROOF_NS: Final = 1_000_000_000
"""Time (ns) for which a change in a code or in the phase counts as proof that the converter is running."""
PHASES_REPEATED: Final = 3
"""Number of scans without a new conversion after which a patch is reported as frozen. A patch also becomes
stale after this number of missed scans. Even the field of the first such scan is not trusted.
"""
_MOVED: Final = 16
"""Minimum distance (codes) from the rest code at which a resistance is assumed to be uniformly distributed
within its quantization step.
"""
_SPREAD: Final = 30
"""Minimum number of distinct codes that differ from the rest code by at least ``_MOVED`` on a pressed patch.
"""


class Alive(enum.StrEnum):
    """State of a patch's converter: running, stopped or unknown."""

    YES = "yes"
    NO = "no"
    CANNOT_TELL = "cannot tell"
    """No scan has arrived yet, or no code has changed for a second and the cause is unknown.

    One such case is a patch that does not count its conversions and whose converter has so little noise that
    it repeats its codes even while running.
    """


class ConverterLiveness:
    """Stopped-converter detector for one patch. Used only by the mainline.

    Args:
        scale: Scale of the codes.
        relative_noise: Converter noise stated in the hand file, relative to the resistance.
    """

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._stated = scale, relative_noise / scale.step
        self._rest = round((1.0 - scale.lo) / scale.step)
        self.measured_noise = 0.0
        """Noise (codes) measured in the recent windows of scans; 0 if not measurable."""
        self._log_p = 0.0  # log probability of an improbable run; 0 otherwise
        self._abrupt = False  # whether a movement ended abruptly when this run began
        self._improbable = False  # whether this run is improbable for a running converter
        self._largest = 0  # largest code change in the last scan with a change
        self._run = self._codes = self._flickers = self._check_at = 0
        self._pressed = False
        self._longest = {False: 0, True: 0}
        # noise measured before the current run, because constant codes show none
        self._noise_before = 0.0
        self._phase = self._phase_scan = self._same_phase = self._missing = 0
        self._t_ns = 0
        self._t_proof_ns: int | None = None

    @property
    def stopped(self) -> bool:
        """Whether the phase or the codes of the newest scan show that the converter has stopped."""
        return self._same_phase > 0 or self._improbable

    @property
    def doubtful(self) -> bool:
        """Whether a movement ended abruptly within the last ``DOUBT_RUN`` scans."""
        return self._abrupt and self._run <= DOUBT_RUN

    @property
    def deviations(self) -> float:
        """Significance (standard deviations) of the evidence that the converter has stopped."""
        return math.inf if self._same_phase else deviations_of(self._log_p)

    @property
    def alive(self) -> Alive:
        """State of the converter as of the newest scan."""
        if self._same_phase >= PHASES_REPEATED or self._repeats_frozen():
            return Alive.NO
        if self._t_proof_ns is None or self._t_ns - self._t_proof_ns > PROOF_NS:
            return Alive.CANNOT_TELL
        return Alive.YES

    @property
    def words(self) -> str:
        """Human-readable reason to doubt that the converter is running; empty if there is none."""
        if self._same_phase:
            return f"its converter has completed no conversion for {counted(self._same_phase, 'scan')}"
        if self.stopped:
            return f"its codes have not changed for {counted(self._run, 'scan')}"
        if self.doubtful:
            return (
                "cannot tell whether its converter is running: its codes stopped changing mid-movement, "
                f"{counted(self._run, 'scan')} ago"
            )
        if self.alive is Alive.YES:
            return ""
        if self._t_proof_ns is None:
            return "cannot tell whether its converter is running: no code has changed yet"
        still_s = (self._t_ns - self._t_proof_ns) * 1e-9
        return f"cannot tell whether its converter is running: no code has changed for {still_s:.0f} s"

    def on_scan(
        self, scan: Scan, counts: tuple[int, int, int, int, int], last: NDArray[Any], run: NDArray[Any]
    ) -> None:
        """Evaluate the next scan of the patch.

        Args:
            scan: Scan to evaluate.
            counts: Results of :func:`~skinnode.host.repeated_codes.follow`: ``MEASURED``, ``CHANGED``,
                ``RETURNED``, ``LARGEST`` and ``LEAST``.
            last: (U, K) newest code of each crossing.
            run: (U, K) number of scans since the code last changed.
        """
        measured, changed, returned, largest, least = counts
        self._t_ns = scan.t_last_ns
        if changed:
            self._end_run(returned, largest)
        # codes missing from the previous scan may count as changed
        self._compare_phase(scan, unchanged=measured > 0 and changed <= self._missing)
        self._missing = 0 if scan.flags & _CHANGED_ONLY else scan.codes.size - measured
        if changed or not measured or scan.flags & _CHANGED_ONLY:
            return
        self._run += 1
        self._codes += measured
        if self._run == 1:
            unheard = not self._phase and not any(self._longest.values())
            self._abrupt = unheard and self._largest >= ABRUPT and self._flickers >= FLICKERS
        if self._run >= self._check_at and not self._improbable:
            # the probability changes little from scan to scan, so evaluate at growing intervals
            self._check_at = self._run + 1 + self._run // 4
            self._evaluate_run(last, run, least)

    def _repeats_frozen(self) -> bool:
        return self._improbable and self._run >= LEAST_RUN

    def _compare_phase(self, scan: Scan, *, unchanged: bool) -> None:
        phase = scan.phase
        if not phase:
            # a summary without a phase means that the patch does not count its conversions
            if scan.device_time_us is not None:
                self._phase = self._same_phase = 0
            return
        if self._phase and phase != self._phase:
            self._t_proof_ns, self._same_phase = scan.t_last_ns, 0
        elif self._phase and unchanged and scan.scan == self._phase_scan + 1:
            self._same_phase += not scan.flags & _SOURCE_FAILED
        self._phase, self._phase_scan = phase, scan.scan

    def _end_run(self, returned: int, largest: int) -> None:
        self._t_proof_ns = self._t_ns
        self._flickers += returned > 0
        if self._run and (not self._repeats_frozen() or largest <= 1):  # the converter was running
            self._longest[self._pressed] = max(self._longest[self._pressed], self._run)
        self._run = self._codes = self._check_at = self._same_phase = 0
        self._pressed = self._abrupt = self._improbable = False
        self._largest = largest
        self._log_p, self._noise_before = 0.0, self.measured_noise

    def _evaluate_run(self, last: NDArray[Any], run: NDArray[Any], least: int) -> None:
        moved = last[(run >= self._run) & (last >= 0) & (last <= self._scale.steps)]
        different = np.unique(moved[np.abs(moved - self._rest) >= _MOVED]).size
        self._pressed = different >= _SPREAD
        if self._flickers < FLICKERS or self._run < LONGER * self._longest[self._pressed]:
            return
        ratio = max(self._scale.lo + least * self._scale.step, self._scale.step)

        def log_p(sigma: float) -> float:
            bound = self._codes * log_stay(sigma * ratio)
            return min(bound, different * log_stay_anywhere(sigma * ratio, self._run))

        quiet = max(self._stated / QUIETER, 0.5 * self._noise_before)
        probable = log_p(quiet)
        if log_p(self._stated) <= math.log(FALSE_ALARM) and probable <= math.log(FALSE_ALARM_QUIET):
            self._improbable, self._log_p = True, probable
