"""Detect whether a patch's converter is running, from the conversion phase and from repeated codes.

**Phase.** Some patches count their conversions and send the conversion phase
(:attr:`~skinnode.protocol.summary.SummaryFlag.CONVERSIONS`). If two successive scans of a patch have the same
phase and the same codes, they contain the same conversion. After missed scans or a lost summary, an equal
phase proves nothing, because any phase may follow. A different phase always proves that a conversion took
place.

**Repeats.** Without a phase, the decision must be based on the codes. A run is a sequence of scans in which
no code changes. A run counts as frozen if a live converter would produce the run with a probability below
``FALSE_ALARM`` at the noise stated in the hand file. The probability must also be below ``FALSE_ALARM_QUIET``
at a noise that is ``QUIETER`` times smaller, or at the noise found by :mod:`skinnode.host.wire_windows` if
that noise is larger. In addition, the stream must have shown noise before: ``FLICKERS`` scans in which a code
returned to its previous value. Finally, the run must be ``LONGER`` times as long as any earlier run that
ended with a live converter. Runs at rest and runs under a press are compared separately, because the same
converter repeats its codes for minutes at rest, but only for two or three scans under a press.

**Doubt.** Repeated codes cannot prove within a few scans that a patch is frozen, but a press may change in
that time. If the codes of a patch suddenly stop changing in mid-movement, the first ``DOUBT_RUN`` fields are
therefore not trusted. This rule applies to patches that send no phase, have shown noise and have never
repeated their codes.

If neither the phase nor the codes decide, and no code has changed for a second, the result is *cannot tell*.
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
"""Maximum probability that a live part (crossing, wire or patch) repeats its codes as often as observed, at
the assumed noise. A patch of 10 × 30 wires has 341 parts. At 100 scans/s, all parts together are tested 1.2e9
times in ten hours, so 0.001 false alarms are expected; the requirement is at most one false alarm."""
FALSE_ALARM_QUIET: Final = 1e-8
"""Maximum probability that a live patch repeats its codes as often as observed, at a noise ``QUIETER`` times
smaller than stated. For the 3.6e6 scans of ten hours, this limit corresponds to 0.04 false alarms, and few
converters have so little noise."""
QUIETER: Final = 10.0
"""Maximum ratio of the noise stated in the hand file to a converter's actual noise."""
ABRUPT: Final = 16
"""Minimum change of a code in the last scan of a movement that ended abruptly, codes. This value is not
tuned."""
DOUBT_RUN: Final = 64
"""Number of scans after an abruptly ended movement whose fields are not trusted; after these scans, only the
probability of the repeats decides. For most simulated patches that froze in mid-press, the decision took up
to 11 scans, for some more than 16."""
FLICKERS: Final = 5
"""Minimum number of scans in which a code returns to its previous value, as proof that the codes contain
noise."""
LONGER: Final = 4
"""Minimum ratio of the length of a frozen run to the length of the longest run of the live converter."""
PROOF_NS: Final = 1_000_000_000
"""Time for which the converter counts as running after a change of a code or of the phase, ns."""
PHASES_REPEATED: Final = 3
"""Number of scans without a new conversion after which a patch counts as frozen; a patch counts as stale
after the same number of missed scans. Fields are not trusted from the first scan without a new conversion."""
_MOVED: Final = 16
"""Minimum distance from the code at rest at which the quantization error of a code is random, codes."""
_SPREAD: Final = 30
"""Minimum number of different codes at least ``_MOVED`` away from the code at rest in a pressed patch."""


class Alive(enum.StrEnum):
    """Whether the converter of a patch is running."""

    YES = "yes"
    NO = "no"
    CANNOT_TELL = "cannot tell"
    """No code has changed for a second, but the patch does not count its conversions, and its converter has
    so little noise that repeated codes prove nothing; or no scan has been received yet."""


class ConverterLiveness:
    """Tracker of the state of one patch's converter. Owned by the mainline.

    Args:
        scale: Scale of the codes.
        relative_noise: Converter noise stated in the hand file, as a fraction of the resistance.
    """

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._stated = scale, relative_noise / scale.step
        self._rest = round((1.0 - scale.lo) / scale.step)
        self.measured_noise = 0.0
        """Noise measured over recent windows of scans, codes; 0 if none was measurable."""
        self._log_p = 0.0  # log probability of the current run, if the run counts as frozen
        self._abrupt = False  # whether a movement ended abruptly at the start of the current run
        self._improbable = False  # whether the current run counts as frozen
        self._largest = 0  # largest change of a code in the last scan with changes, codes
        self._run = self._codes = self._flickers = self._check_at = 0
        self._pressed = False
        self._longest = {False: 0, True: 0}
        # noise measured before the current run, because constant codes have no noise
        self._noise_before = 0.0
        self._phase = self._phase_scan = self._same_phase = self._missing = 0
        self._t_ns = 0
        self._t_proof_ns: int | None = None

    @property
    def stopped(self) -> bool:
        """Whether the newest scan repeats a conversion, or codes that a live converter would have changed."""
        return self._same_phase > 0 or self._improbable

    @property
    def doubtful(self) -> bool:
        """Whether a movement ended abruptly within the last ``DOUBT_RUN`` scans."""
        return self._abrupt and self._run <= DOUBT_RUN

    @property
    def deviations(self) -> float:
        """Improbability of the current run for a live converter, in standard deviations."""
        return math.inf if self._same_phase else deviations_of(self._log_p)

    @property
    def alive(self) -> Alive:
        """Whether the converter was running at the newest scan."""
        if self._same_phase >= PHASES_REPEATED or self._repeats_frozen():
            return Alive.NO
        if self._t_proof_ns is None or self._t_ns - self._t_proof_ns > PROOF_NS:
            return Alive.CANNOT_TELL
        return Alive.YES

    @property
    def words(self) -> str:
        """Reason why the converter may not be running, in words; empty if it is running."""
        if self._same_phase:
            return f"its converter has completed no conversion for {counted(self._same_phase, 'scan')}"
        if self.stopped:
            return f"its codes have not changed for {counted(self._run, 'scan')}"
        if self.doubtful:
            return (
                "cannot tell whether its converter runs: its codes stopped in mid-movement, "
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
            counts: Numbers of crossings measured, changed, and returned to their previous code; largest
                change, codes; smallest code.
            last: (U, K) last code of each crossing.
            run: (U, K) number of scans since each crossing's code last changed.
        """
        measured, changed, returned, largest, least = counts
        self._t_ns = scan.t_last_ns
        if changed:
            self._end_run(returned, largest)
        # up to `_missing` codes may have changed because the previous scan lacked them
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
            # the probability falls slowly, so evaluate at increasing intervals
            self._check_at = self._run + 1 + self._run // 4
            self._evaluate_run(last, run, least)

    def _repeats_frozen(self) -> bool:
        return self._improbable and self._run >= LEAST_RUN

    def _compare_phase(self, scan: Scan, *, unchanged: bool) -> None:
        phase = scan.phase
        if not phase:
            # the patch does not count its conversions, because the summary arrived without a phase
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
        if self._run and (not self._repeats_frozen() or largest <= 1):  # otherwise a frozen run has ended
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
