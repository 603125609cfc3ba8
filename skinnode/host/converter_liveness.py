"""Detect whether a patch's converter is running, from the conversion phase and from repeated codes.

**Phase.** Some patches count their conversions and send the conversion phase
(:attr:`~skinnode.protocol.summary.SummaryFlag.CONVERSIONS`). If two successive scans of a patch have the same
phase and the same codes, both scans contain the same conversion. If scans were missed or a summary was lost,
an unchanged phase is inconclusive. A changed phase always proves that a conversion took place.

**Repeats.** If a patch sends no phase, only its codes show whether the converter is running. A run is a
sequence of scans in which no code changes. A converter is considered stopped if all of
these conditions are met:

- At the noise stated in the hand file, the probability of such a long run is at most ``FALSE_ALARM`` for a
  running converter.
- At a lower noise, the probability is at most ``FALSE_ALARM_QUIET``. The lower noise is the larger of two
  values: the stated noise divided by ``QUIETER``, and half of the noise measured by
  :mod:`skinnode.host.wire_windows`.
- In at least ``FLICKERS`` earlier scans, a code has returned to its previous value. Such a return proves that
  the codes are noisy.
- The run is at least ``LONGER`` times as long as any earlier run in which the converter was running. Runs at
  rest and runs under a press are compared separately, because the same converter repeats its codes for
  minutes at rest, but only for two or three scans under a press.

**Doubt.** A few repeated scans do not prove that a converter has stopped, but the fields may already show a
press that has ended. If the codes of a patch suddenly stop changing in mid-movement, the next ``DOUBT_RUN``
fields are therefore not trusted. This rule applies only to patches that send no phase, have noisy codes and
have never repeated all their codes before.

If the phase and the codes are inconclusive and no code has changed for a second, the state of the converter
is unknown (:attr:`Alive.CANNOT_TELL`).
"""

from __future__ import annotations

import enum
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.host.code_runs import LEAST_RUN
from skinnode.host.repeat_odds import deviations_of, log_stay, log_stay_anywhere
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.scan import Scan
from skinnode.protocol.summary import SummaryFlag
from skinnode.text.words import counted

_SOURCE_FAILED: Final = int(SummaryFlag.SOURCE_FAILED)

FALSE_ALARM: Final = 1e-12
"""Significance level of the tests for frozen crossings, wires and patches. A patch of 10 × 30 wires is tested
341 times per scan: 300 crossings, 40 wires and the whole patch. Ten hours at 100 scans/s comprise 1.2e9
tests, so about 0.001 false alarms are expected.
"""
FALSE_ALARM_QUIET: Final = 1e-8
"""Significance level of the same test for a patch whose noise is only 1/``QUIETER`` of the stated noise. In
ten hours (3.6e6 scans), about 0.04 false alarms are expected for such a patch.
"""
QUIETER: Final = 10.0
"""Factor by which the noise stated in the hand file may exceed the actual noise of a converter."""
ABRUPT: Final = 16
"""Minimum change (codes) of at least one code in the last scan before a run, for the run to be considered an
abrupt end of a movement. The value has not been tuned.
"""
DOUBT_RUN: Final = 64
"""Number of scans for which fields are not trusted after a movement has ended abruptly. In simulations, most
converters that stopped in mid-press were detected within 11 scans, and a few after more than 16 scans.
"""
FLICKERS: Final = 5
"""Minimum number of scans in which a code must have returned to its previous value before a patch's codes are
considered noisy.
"""
LONGER: Final = 4
"""Minimum length of a frozen run, as a multiple of the live converter's longest run."""
PROOF_NS: Final = 1_000_000_000
"""Time (ns) for which a converter is considered running after a code or the phase has changed."""
PHASES_REPEATED: Final = 3
"""Number of scans without a new conversion after which a patch is reported as frozen. Even the field of the
first such scan is not trusted. The value equals the number of missed scans after which a patch is reported as
stale.
"""
_MOVED: Final = 16
"""Minimum difference (codes) between a code and the rest code for the resistance to be considered randomly
distributed within its quantization step.
"""
_SPREAD: Final = 30
"""Minimum number of distinct codes that differ from the rest code by at least ``_MOVED``, for a patch to be
considered pressed.
"""


class Alive(enum.StrEnum):
    """State of a patch's converter: running, stopped or unknown."""

    YES = "yes"
    NO = "no"
    CANNOT_TELL = "cannot tell"
    """No scan has been received yet, or no code has changed for a second and the reason is unknown.

    The reason is unknown, for example, if the patch does not count its conversions and its converter has so
    little noise that a running converter would also repeat its codes.
    """


class ConverterLiveness:
    """Tracker of the state of one patch's converter. Used only by the mainline.

    Args:
        scale: Scale of the codes.
        relative_noise: Converter noise stated in the hand file, as a fraction of the resistance.
    """

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._stated = scale, relative_noise / scale.step
        self._rest = round((1.0 - scale.lo) / scale.step)
        self.measured_noise = 0.0
        """Noise (codes) measured over recent windows of scans; 0 if no noise could be measured."""
        self._log_p = 0.0  # log probability of the current run if the run is improbable, else 0
        self._abrupt = False  # whether the current run abruptly ended a movement
        self._improbable = False  # whether a running converter would hardly repeat its codes for so long
        self._largest = 0  # largest change (codes) in the last scan that changed
        self._run = self._codes = self._flickers = self._check_at = 0
        self._pressed = False
        self._longest = {False: 0, True: 0}
        # noise measured before the current run; during the run, the constant codes show no noise
        self._noise_before = 0.0
        self._phase = self._phase_scan = self._same_phase = self._missing = 0
        self._t_ns = 0
        self._t_proof_ns: int | None = None

    @property
    def stopped(self) -> bool:
        """Whether the converter had stopped at the newest scan, according to its phase or codes."""
        return self._same_phase > 0 or self._improbable

    @property
    def doubtful(self) -> bool:
        """Whether all codes stopped changing abruptly, at most ``DOUBT_RUN`` scans ago."""
        return self._abrupt and self._run <= DOUBT_RUN

    @property
    def deviations(self) -> float:
        """Significance of the current run as evidence of a stopped converter, in standard deviations."""
        return math.inf if self._same_phase else deviations_of(self._log_p)

    @property
    def alive(self) -> Alive:
        """State of the converter at the newest scan."""
        if self._same_phase >= PHASES_REPEATED or self._repeats_frozen():
            return Alive.NO
        if self._t_proof_ns is None or self._t_ns - self._t_proof_ns > PROOF_NS:
            return Alive.CANNOT_TELL
        return Alive.YES

    @property
    def words(self) -> str:
        """Human-readable reason why the converter may not be running; empty if it is running."""
        if self._same_phase:
            return f"its converter has completed no conversion for {counted(self._same_phase, 'scan')}"
        if self.stopped:
            return f"its codes have not changed for {counted(self._run, 'scan')}"
        if self.doubtful:
            return (
                "cannot tell whether its converter runs: its codes stopped changing in mid-movement, "
                f"{counted(self._run, 'scan')} ago"
            )
        if self.alive is Alive.YES:
            return ""
        if self._t_proof_ns is None:
            return "cannot tell whether its converter runs: no code has changed yet"
        still_s = (self._t_ns - self._t_proof_ns) * 1e-9
        return f"cannot tell whether its converter runs: no code has changed for {still_s:.0f} s"

    def on_scan(
        self, scan: Scan, counts: tuple[int, int, int, int, int], last: NDArray[Any], run: NDArray[Any]
    ) -> None:
        """Evaluate the next scan of the patch.

        Args:
            scan: Scan to evaluate.
            counts: Results of :func:`~skinnode.host.code_runs.follow`: number of codes that are measurements,
                number of changed codes, number of codes that returned to their previous value, largest change
                of a code, smallest code.
            last: (U, K) last code of each crossing.
            run: (U, K) number of scans since each crossing's code last changed.
        """
        measured, changed, returned, largest, least = counts
        self._t_ns = scan.t_last_ns
        if changed:
            self._end_run(returned, largest)
        # the changed codes may be those that the previous scan did not contain
        self._compare_phase(scan, unchanged=measured > 0 and changed <= self._missing)
        self._missing = 0 if scan.flags & SummaryFlag.CHANGED_ONLY else scan.codes.size - measured
        if changed or not measured or scan.flags & SummaryFlag.CHANGED_ONLY:
            return
        self._run += 1
        self._codes += measured
        if self._run == 1:
            unheard = not self._phase and not any(self._longest.values())
            self._abrupt = unheard and self._largest >= ABRUPT and self._flickers >= FLICKERS
        if self._run >= self._check_at and not self._improbable:
            # the probability of a run decreases slowly, so evaluate at increasing intervals
            self._check_at = self._run + 1 + self._run // 4
            self._evaluate_run(last, run, least)

    def _repeats_frozen(self) -> bool:
        return self._improbable and self._run >= LEAST_RUN

    def _compare_phase(self, scan: Scan, *, unchanged: bool) -> None:
        phase = scan.phase
        if not phase:
            # a summary without a phase shows that the patch does not count its conversions
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
