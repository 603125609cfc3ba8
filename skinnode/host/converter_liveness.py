"""Decide whether the converter of a patch is alive, from the conversion phase and from repeated codes.

**Phase.** If the patch supplies it (:attr:`~skinnode.protocol.summary.SummaryFlag.CONVERSIONS`), two
successive scans with the same phase and the same codes hold the same conversion. After missed scans, or a
lost summary, any phase may follow, so an equal phase then decides nothing; a different phase always proves a
conversion.

**Repeats.** Without a phase, only the codes remain. A run of scans in which no code changes counts as frozen
if a live converter would produce it with a probability below ``FALSE_ALARM`` at the noise stated in the hand
file, and below ``FALSE_ALARM_QUIET`` even if the noise is ``QUIETER`` times smaller, unless recent windows
have shown that it is larger (:mod:`skinnode.host.wire_windows`). In addition, the stream must itself have
shown noise before, that is, ``FLICKERS`` scans in which a code returned to its previous value, and the run
must be ``LONGER`` times as long as any earlier run that ended on its own. Runs of skin at rest and of pressed
skin are counted separately, because the same converter repeats its codes for minutes at rest and for two or
three scans under a press.

**Doubt.** A patch is not frozen after one scan, but a press moves on meanwhile. If a patch that supplies no
phase, has shown noise and has never repeated its codes stops moving from one scan to the next, the first
``DOUBT_RUN`` fields are not trusted.

If neither decides and no code has changed for a second, the answer is *cannot tell*.
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
"""Maximum probability that a live part repeats its codes so often, at the assumed noise. A patch of 10 × 30
wires has 341 parts (crossings, wires, patch): at 100 scans/s, 1.2e9 parts and scans in ten hours, and so
0.001 false alarms. The limit set for all of them together is one."""
FALSE_ALARM_QUIET: Final = 1e-8
"""The same for a whole patch, at a noise ``QUIETER`` times smaller than stated: 3.6e6 scans in ten hours give
0.04 false alarms, and few converters are so much better than stated."""
QUIETER: Final = 10.0
"""Ratio by which the noise may be smaller than stated."""
ABRUPT: Final = 16
"""Minimum change of a code in the last scan of a movement that ends abruptly, codes. Not tuned."""
DOUBT_RUN: Final = 64
"""Number of scans after such a movement whose fields are not trusted; later, probability alone decides. In
most test streams of patches that froze in mid-press, it took up to 11 scans, in some more than 16."""
FLICKERS: Final = 5
"""Number of scans in which a code must return to its previous value to prove that the codes contain noise."""
LONGER: Final = 4
"""Minimum ratio of the length of a frozen run to that of the longest run that ended on its own."""
PROOF_NS: Final = 1_000_000_000
"""Time for which a change of a code or of the phase proves that the converter is alive, ns."""
PHASES_REPEATED: Final = 3
"""Number of scans without a conversion after which the patch counts as frozen, as many as without a scan make
it stale. Fields are not trusted from the first of them on."""
_MOVED: Final = 16
"""Minimum distance, in codes, from the code at rest at which a code's place within its step is random."""
_SPREAD: Final = 30
"""Minimum number of such codes, all different, in a patch that counts as pressed."""


class Alive(enum.StrEnum):
    """Whether the converter of a patch is running."""

    YES = "yes"
    NO = "no"
    CANNOT_TELL = "cannot tell"
    """No code has changed for a second, the patch does not count its conversions, and its converter is so
    quiet that this proves nothing; or no scan has been received yet."""


class ConverterLiveness:
    """State of one patch's converter. Owned by the mainline.

    Args:
        scale: Scale of the codes.
        relative_noise: Converter noise stated in the hand file, as a fraction of the resistance.
    """

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._stated = scale, relative_noise / scale.step
        self._rest = round((1.0 - scale.lo) / scale.step)
        self.measured_noise = 0.0
        """Noise shown by recent windows, codes; 0 if they show none."""
        self._log_p = 0.0  # of the current run, if it counts as frozen
        self._abrupt = False  # whether movement ended abruptly before the current run
        self._improbable = False  # whether a live converter would hardly repeat its codes so often
        self._largest = 0  # change in the last scan with changes
        self._run = self._codes = self._flickers = self._check_at = 0
        self._pressed = False
        self._longest = {False: 0, True: 0}
        self._noise_before = 0.0  # noise shown before the run: the run itself shows none
        self._phase = self._phase_scan = self._same_phase = self._missing = 0
        self._t_ns = 0
        self._t_proof_ns: int | None = None

    @property
    def stopped(self) -> bool:
        """Whether the newest scan repeats a conversion, or codes that no live converter would repeat."""
        return self._same_phase > 0 or self._improbable

    @property
    def doubtful(self) -> bool:
        """Whether movement ended from one scan to the next, so recently that nothing else decides."""
        return self._abrupt and self._run <= DOUBT_RUN

    @property
    def deviations(self) -> float:
        """Number of standard deviations by which a stopped converter differs from a live one."""
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
        """Why the converter is not known to be alive, in words; empty if it is."""
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
        """Evaluate the next scan.

        Args:
            scan: The scan.
            counts: Number of crossings measured, changed and returned; largest change; smallest code.
            last: (U, K) last code of each crossing.
            run: (U, K) run of each crossing.
        """
        measured, changed, returned, largest, least = counts
        self._t_ns = scan.t_last_ns
        if changed:
            self._end_run(returned, largest)
        # a code that was missing from the scan before differs from an older one
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
            self._check_at = self._run + 1 + self._run // 4  # the probability falls slowly: look rarely
            self._evaluate_run(last, run, least)

    def _repeats_frozen(self) -> bool:
        return self._improbable and self._run >= LEAST_RUN

    def _compare_phase(self, scan: Scan, *, unchanged: bool) -> None:
        phase = scan.phase
        if not phase:
            if scan.device_time_us is not None:  # the summary was not lost: the patch does not count
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
        if self._run and (not self._repeats_frozen() or largest <= 1):  # else an end of freezing
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
