"""Turn a patch's chunks into fields.

The mainline assembles each scan and puts it into a one-element buffer, the *box*. A worker thread takes the
scan from the box, decodes it and solves it. If a newer scan replaces it in the box, the older scan is counted
as skipped. A token limits each stream to one worker at a time.
"""

from __future__ import annotations

import bisect
import contextlib
import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from skinnode.config import Partial
from skinnode.errors import SkinError
from skinnode.host.code_watch import FAULTLESS, Verdict
from skinnode.host.containment import Defects, one_line
from skinnode.host.publish import Publisher
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.sync import Tick
from skinnode.host.workers import Inline, Workers
from skinnode.model.frames import ScanStamp
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.scan import AssemblerStats, Scan
from skinnode.protocol.summary import SummaryFlag

_log = logging.getLogger(__name__)


_BASELINE_CHANGED: Final = int(SummaryFlag.BASELINE_CHANGED)

_EVER_NS: Final = 2**63
WATCH_AFTER_NS: Final = 5_000_000
"""Delay (ns) between the last frame of a scan and the search for noisy and drifting wires. Solving has
priority, because applications are waiting for the fields of all patches.
"""


@dataclass(frozen=True, slots=True)
class StreamStats:
    """Counters of a patch's scans.

    Every assembled scan counts as ``offered``, ``withheld`` or ``partial``. Every offered scan eventually
    counts as ``solved``, ``failed`` or ``skipped``; up to two may still be in progress.
    """

    frames: int
    """Number of chunks and summaries passed to the stream."""
    offered: int
    withheld: int
    """Number of scans withheld because the patch was being brought up or its baseline was being read."""
    partial: int
    """Number of incomplete scans withheld because ``stream.partial`` is ``withhold``."""
    solved: int
    skipped: int
    """Number of scans replaced by a newer scan before a worker was free."""
    untrusted: int
    """Number of untrusted fields."""
    invalid_codes: int
    """Number of codes, over all solved scans, that mark a crossing as over range, shorted, open or
    missing."""
    assembler: AssemblerStats
    failed: int = 0
    """Number of scans whose decoding or solving raised an exception."""


class StreamTap(Protocol):
    """Recorder of the events, apart from received frames, that determine which scans are solved.

    All methods are called on the mainline.
    """

    def resumed(self, patch: str, solver: ScanSolver, *, anew: bool) -> None:
        """Record that :meth:`PatchStream.resume` has set a solver."""

    def withheld(self, patch: str) -> None:
        """Record that :meth:`PatchStream.withhold` was called."""

    def polled(self, patch: str, t_ns: int) -> None:
        """Record that :meth:`PatchStream.poll` has ended an incomplete scan."""

    def overtaken(self, patch: str, scan: int, t_receive_ns: int) -> None:
        """Record that a newer scan has replaced ``scan``, whose last frame arrived at ``t_receive_ns``."""


def _ignore(scan: Scan) -> None:
    """Do nothing; default for the callbacks in :class:`StreamOptions`."""


def _find_nothing(scan: Scan, number: int) -> Verdict:
    """Return a fault-free verdict; default for :attr:`StreamOptions.judge`."""
    return FAULTLESS


@dataclass(frozen=True, slots=True)
class StreamOutput:
    """Destinations for a stream's scans, fields and exceptions."""

    workers: Workers | Inline
    publisher: Publisher
    defects: Defects | None = None
    """Collector of exceptions from decoding and solving. If None, the first exception stops the publisher."""


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """Settings of a patch stream."""

    tick: Callable[[int], Tick | None]
    """Function that returns the newest SYNC with a given counter value."""
    on_scan: Callable[[Scan], None] = _ignore
    """Function called with each assembled scan."""
    judge: Callable[[Scan, int], Verdict] = _find_nothing
    """Function called with each assembled scan and its number before the scan is solved. By then, ``watch``
    has been called with all earlier scans, so a replay produces the same verdicts as the host.
    """
    watch: Callable[[Scan], None] = _ignore
    """Function called with each assembled scan after :data:`WATCH_AFTER_NS`, or when the next scan
    arrives.
    """
    partial: Partial = "pass"
    """Treatment of incomplete scans: ``pass`` or ``withhold``."""
    under_way: bool = False
    """Whether another master starts the node. If so, scans may be under way when the stream is resumed."""


class PatchStream:
    """Stream of one patch's scans, from received frames to published fields.

    Scans are withheld until :meth:`resume` sets a solver. If decoding or solving raises an exception, only
    the current scan is lost.

    Threads: any thread may call :meth:`settled` and :meth:`stats`. Only the mainline may call the other
    public methods.
    """

    def __init__(
        self, patch: str, assembler: ScanAssembler, output: StreamOutput, options: StreamOptions
    ) -> None:
        self._patch, self._options = patch, options
        self._solver: ScanSolver | None = None  # None while scans are withheld
        self._assembler = assembler
        self._workers, self._publisher, self._defects = output.workers, output.publisher, output.defects
        assembler.on_discarded = self._doubt
        self._unwatched: deque[tuple[int, Scan]] = deque()
        # one-element buffer; thread-safe
        self._box: deque[tuple[Scan, ScanStamp, ScanSolver, Verdict]] = deque()
        self._token: deque[None] = deque([None])
        self.tap: StreamTap | None = None
        self._left_out: list[int] = []
        self._left_out_within_ns = 0
        self.withholdings = 0
        """Number of calls to :meth:`withhold`."""
        self.doubtful = False
        """Whether a lost or discarded summary, or a missed scan, may have announced a new baseline."""
        self._next_scan: int | None = None  # number of the next scan if none is missed; None before the first
        self._frames = self._withheld = self._partial = 0
        self._offered = self._taken = self._solved = self._failed = self._untrusted = self._invalid = 0
        self._newest = 0
        self._solving = 0
        """Number of the scan being solved."""
        self.t_passed_ns = 0
        """Monotonic arrival time (ns) of the newest scan that was not withheld; 0 if there is none."""

    # --- mainline

    def on_chunk(self, data: bytes, t_ns: int) -> None:
        """Process a chunk (TPDO1)."""
        self._frames += 1
        scan = self._assembler.on_chunk(data, t_ns)
        if scan is not None:
            self._offer(scan)

    def on_summary(self, data: bytes, t_ns: int) -> None:
        """Process a summary (TPDO2)."""
        self._frames += 1
        scan = self._assembler.on_summary(data, t_ns)
        if scan is not None:
            self._offer(scan)

    def poll(self, t_ns: int) -> None:
        """End the current scan at its deadline, and check earlier scans for faulty wires."""
        self._watch_until(t_ns)
        deadline_ns = self._assembler.next_deadline_ns()
        if deadline_ns is None or t_ns < deadline_ns:
            return
        if self.tap is not None:
            self.tap.polled(self._patch, t_ns)
        scan = self._assembler.poll(t_ns)
        if scan is not None:  # None if the assembler discarded the scan
            self._offer(scan)

    def _watch_until(self, t_ns: int) -> None:
        """Check the scans due by ``t_ns`` for faulty wires."""
        while self._unwatched and t_ns >= self._unwatched[0][0]:
            self._options.watch(self._unwatched.popleft()[1])

    def withhold(self) -> int:
        """Withhold all scans from now on, including the one being assembled. Return ``withholdings``."""
        self._solver = None
        self.withholdings += 1
        if self.tap is not None:
            self.tap.withheld(self._patch)
        return self.withholdings

    @property
    def conflicts(self) -> int:
        """Number of frames that contradict another frame of the same scan."""
        return self._assembler.conflicts

    @property
    def withholding(self) -> bool:
        """Whether scans are being withheld."""
        return self._solver is None

    def resume(self, solver: ScanSolver, withholdings: int, *, anew: bool) -> None:
        """Decode and solve subsequent scans with ``solver``.

        Args:
            solver: Solver for the scans.
            withholdings: Value of ``withholdings`` last seen by the caller. If :meth:`withhold` has been
                called since then, :meth:`resume` has no effect.
            anew: Whether the node has restarted. If so, the frames received so far are discarded.
        """
        if withholdings != self.withholdings:
            return
        self._solver = solver
        self.doubtful, self._next_scan = False, None
        checked = solver.facts.checked
        if anew:
            self._assembler.reset(under_way=self._options.under_way, checked=checked)
        elif checked:
            self._assembler.expect_check()
        if self.tap is not None:
            self.tap.resumed(self._patch, solver, anew=anew)

    def inform_tap(self) -> None:
        """Report the current solver, if any, to a newly added tap."""
        if self.tap is not None and self._solver is not None:
            self.tap.resumed(self._patch, self._solver, anew=False)

    def close(self) -> None:
        """Discard the scan in the box. Call only after the mainline has ended."""
        self._box.clear()
        while self._unwatched:
            scan = self._unwatched.popleft()[1]
            with contextlib.suppress(Exception):  # no caller is left to handle the exception
                self._options.watch(scan)

    def _doubt(self) -> None:
        self.doubtful = True

    def _offer(self, scan: Scan) -> None:
        self._options.on_scan(scan)
        tick = self._options.tick(scan.counter)
        number = scan.scan if tick is None else tick.number
        self._watch_until(_EVER_NS)
        verdict = self._options.judge(scan, number)
        self._unwatched.append((scan.t_last_ns + WATCH_AFTER_NS, scan))
        if scan.flags & _BASELINE_CHANGED:  # the first scan encoded with the new baseline
            self.withhold()
        elif scan.device_time_us is None or (self._next_scan is not None and scan.scan > self._next_scan):
            self.doubtful = True
        self._next_scan = scan.scan + 1
        solver = self._solver
        if solver is None:
            self._withheld += 1
            return
        if not scan.empty:
            self.t_passed_ns = scan.t_last_ns
        stamp = ScanStamp(
            patch=self._patch,
            scan=number,
            counter=scan.counter,
            device_time_us=scan.device_time_us or 0,  # None if the summary was lost
            t_sync_ns=0 if tick is None else tick.t_ns,
            t_receive_ns=scan.t_last_ns,
        )
        self._newest = stamp.scan
        if not (scan.complete or self._options.partial == "pass"):
            self._partial += 1
            return
        self._offered += 1
        if self._is_left_out(stamp.t_receive_ns):
            return
        with contextlib.suppress(IndexError):
            _, older, _, _ = self._box.popleft()
            if self.tap is not None:
                self.tap.overtaken(self._patch, older.scan, older.t_receive_ns)
        self._box.append((scan, stamp, solver, verdict))
        self._call_worker()

    def leave_out(self, times_ns: Sequence[int], within_ns: int) -> None:
        """Skip the scans that were skipped when the recording was made.

        Arrival times identify these scans, because scan numbers are not unique: a scan interrupted by a gap
        in reception may be assembled as two scans with the same number.

        Args:
            times_ns: Monotonic arrival times (ns) of the last frames of the skipped scans.
            within_ns: Tolerance (ns) for the comparison.
        """
        self._left_out, self._left_out_within_ns = sorted(times_ns), within_ns

    def _is_left_out(self, t_ns: int) -> bool:
        if not self._left_out:
            return False
        i = bisect.bisect_left(self._left_out, t_ns - self._left_out_within_ns)
        return i < len(self._left_out) and self._left_out[i] <= t_ns + self._left_out_within_ns

    def settled(self, scan: int) -> bool:
        """Return whether ``scan`` has arrived and no scan is waiting or being solved.

        While scans are withheld, ``scan`` need not have arrived.
        """
        return (self._newest >= scan or self._solver is None) and not self._box and bool(self._token)

    # --- worker

    def _call_worker(self) -> None:
        try:
            self._token.pop()
        except IndexError:
            return  # the busy worker checks the box after its current scan
        try:
            self._workers.submit(self._work, self._work_failed)
        except Exception:
            self._token.append(None)
            raise

    def _work(self) -> None:
        try:
            self._solve_next()
        except Exception as error:
            self._report(error)
        self._leave()

    def _solve_next(self) -> None:
        self._taken += 1  # before the scan leaves the box: the counters must always include it
        try:
            scan, stamp, solver, verdict = self._box.popleft()
        except IndexError:  # the stream was closed
            self._taken -= 1
            return
        self._solving = stamp.scan
        try:
            field, invalid = solver.solve(scan, stamp, verdict)
        except Exception:
            self._failed += 1
            raise
        self._solved += 1
        self._untrusted += not field.trusted
        self._invalid += invalid
        self._publisher.publish(field, stamp.patch)

    def _work_failed(self, error: Exception) -> None:
        """Handle an exception that a worker raised before or after solving a scan."""
        self._report(error)
        self._leave()

    def _leave(self) -> None:
        """Put back the token, and call a worker if a scan is waiting.

        Never raises, because the token must be put back exactly once.
        """
        self._token.append(None)
        try:
            if self._box:
                self._call_worker()
        except Exception as error:  # the waiting scan is solved when the next scan arrives
            self._report(error)

    def _report(self, error: Exception) -> None:
        if self._defects is not None:
            self._defects.report("solving", error)
            return
        _log.debug("patch %s", self._patch, exc_info=error)
        failure = SkinError(f"patch {self._patch!r}, scan {self._solving}: {one_line(error)}")
        failure.__cause__ = error
        self._publisher.fail(failure)

    def stats(self) -> StreamStats:
        """Return all counters of the stream.

        The counters are read in such an order that a scan in progress is never counted as skipped.
        """
        offered, waiting = self._offered, len(self._box)
        return StreamStats(
            frames=self._frames,
            offered=offered,
            withheld=self._withheld,
            partial=self._partial,
            solved=self._solved,
            skipped=max(0, offered - waiting - self._taken),
            untrusted=self._untrusted,
            invalid_codes=self._invalid,
            assembler=self._assembler.stats,
            failed=self._failed,
        )
