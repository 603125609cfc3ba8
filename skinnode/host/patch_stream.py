"""From a chunk on the bus to a field: assemble on the mainline, decode and solve on the worker pool.

The mainline assembles scans and leaves the newest in a box of one; a worker takes it and solves it. A scan
that is overtaken while the worker is busy is skipped and counted. The stream's token makes sure that at most
one worker is in it.
"""

from __future__ import annotations

import bisect
import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from skinnode.config import Partial, PatchConfig, SolverConfig
from skinnode.errors import ConfigError, SkinError
from skinnode.host.configurator import NodeFacts
from skinnode.host.containment import Defects, one_line
from skinnode.host.publish import Publisher
from skinnode.host.sync import Tick
from skinnode.host.workers import Inline, Workers
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame, ResistanceFrame, ScanStamp, sealed
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.codes import Decoder, as_baseline
from skinnode.protocol.scan import AssemblerStats, Scan
from skinnode.protocol.summary import SummaryFlag
from skinnode.solve.inputs import CodeMap
from skinnode.solve.tracker import Tracker

_log = logging.getLogger(__name__)


_BASELINE_CHANGED: Final = int(SummaryFlag.BASELINE_CHANGED)

WATCH_AFTER_NS: Final = 5_000_000
"""How long after its last frame a scan is looked at for what is wrong with it: the fields that a program
waits for come first, and those of all patches of one SYNC are due together."""


class Solver:
    """Scans of one patch to fields. Owned by one thread at a time. ``clock`` says when a field is ready."""

    def __init__(
        self, facts: NodeFacts, config: SolverConfig, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.facts = facts
        self._clock = clock
        calibration = facts.config.calibration
        gain = None if calibration.upper_gain is None else np.array(calibration.upper_gain)[:, None]
        scale = facts.scale
        self._codes = CodeMap(
            baseline_ohm=as_baseline(facts.baseline_ohm),
            lo=scale.lo,
            step=scale.step,
            steps=scale.steps,
            rounding_ohm=scale.relative_std * facts.baseline_ohm,
            relative_noise=facts.config.relative_noise,
            gain=gain,
        )
        self._tracker = Tracker(
            facts.layout,
            method=config.method,
            operator=config.operator,
            relative_noise=facts.config.relative_noise,
            baseline_ohm=facts.baseline_ohm,
            stiffness_n_per_m=calibration.stiffness_n_per_m or config.stiffness_n_per_m,
            rubber=calibration.rubber,
            deadline_us=config.deadline_us,
            estimate_noise=config.estimate_noise,
            drift=config.drift,
            normal_only=config.normal_only,
            codes=self._codes,
        )
        self._decoder = Decoder(facts.baseline_ohm, scale)

    def decode(self, scan: Scan, stamp: ScanStamp) -> ResistanceFrame:
        """Resistances of a scan, NaN where there is none."""
        resistance_ohm, valid = self._decoder.decode(scan.codes)
        if self._codes.gain is not None:
            resistance_ohm *= self._codes.gain
        return ResistanceFrame(resistance_ohm, valid, stamp)

    def solve(self, scan: Scan, stamp: ScanStamp) -> tuple[FieldFrame, int]:
        """Field of a scan, stamped, its arrays read-only, and how many codes were no measurement. The noise
        is that of the front end and of the codes together."""
        if self._tracker.method == "posterior":
            frame, codes = self.decode(scan, stamp), self._codes
            noise = np.hypot(codes.relative_noise, codes.rounding_ohm / frame.resistance_ohm)
            field = self._tracker.update(frame.resistance_ohm, frame.valid, noise)
            invalid = frame.valid.size - int(np.count_nonzero(frame.valid))
        else:
            field, invalid = self._tracker.update_codes(scan.codes)
        contacts = tuple(sealed(contact) for contact in field.contacts)
        return sealed(field, contacts=contacts, stamp=stamp.solved_at(self._clock())), invalid


def check_solvable(patch: PatchConfig, config: SolverConfig) -> None:
    """Raise ConfigError for a layout that can be sensed but not solved. The first call compiles the kernels,
    or reads them from the cache: not while a node waits."""
    layout = patch.layout.build()
    try:
        Tracker(layout, method=config.method, operator=config.operator).update(
            resistance_ohm(layout, layout.upper_m)
        )
    except ValueError as error:
        raise ConfigError(f"patch {patch.name!r}", layout.name, str(error)) from None


@dataclass(frozen=True, slots=True)
class StreamStats:
    """What became of a patch's scans: those assembled = ``offered`` + ``withheld`` + ``partial``, and
    ``offered`` = ``solved`` + ``failed`` + ``skipped`` + at most two in work."""

    frames: int
    """Chunks and summaries handed to the stream, whatever became of them."""
    offered: int
    withheld: int
    """Came while the patch was being brought up or its baseline being read: nobody could decode them."""
    partial: int
    """Scans that were not complete and therefore withheld, as ``stream.partial`` of the hand file demands."""
    solved: int
    skipped: int
    """Overtaken by a newer scan before a worker was free."""
    untrusted: int
    """Fields in which a wire did not converge."""
    invalid_codes: int
    """Codes that were over range, short, open or missing, over all scans solved."""
    assembler: AssemblerStats
    failed: int = 0
    """Scans whose decoding or solving raised an exception: a defect."""


class StreamTap(Protocol):
    """Who writes down what, beside the frames, decides which scans a stream makes of them. Mainline."""

    def resumed(self, patch: str, solver: Solver, *, anew: bool) -> None:
        """:meth:`PatchStream.resume` let scans through."""

    def withheld(self, patch: str) -> None:
        """:meth:`PatchStream.withhold` was called."""

    def polled(self, patch: str, t_ns: int) -> None:
        """:meth:`PatchStream.poll` ended a scan."""

    def overtaken(self, patch: str, scan: int, t_receive_ns: int) -> None:
        """A scan, of this number and whose last frame came then, was overtaken by a newer one before a worker
        was free."""


class PatchStream:
    """One patch on its way through the host. Scans are withheld until :meth:`resume` says how to decode
    them. ``on_scan`` is told of each at once, ``watch`` a while later. ``under_way``: others start the node,
    which may be sending already whenever its scans are let through. A scan whose decoding or solving
    raises is lost, and the exception is reported to ``defects``; without ``defects`` the publisher fails."""

    def __init__(
        self,
        patch: str,
        assembler: ScanAssembler,
        workers: Workers | Inline,
        publisher: Publisher,
        tick: Callable[[int], Tick | None],
        on_scan: Callable[[Scan], None],
        partial: Partial = "pass",
        watch: Callable[[Scan], None] = lambda scan: None,
        *,
        under_way: bool = False,
        defects: Defects | None = None,
    ) -> None:
        self._patch, self._passes_partial = patch, partial == "pass"
        self._solver: Solver | None = None  # None: withhold
        self._assembler, self._workers, self._publisher = assembler, workers, publisher
        assembler.on_discarded = self._doubt
        self._tick, self._on_scan = tick, on_scan
        self._watch, self._under_way, self._defects = watch, under_way, defects
        self._unwatched: deque[tuple[int, Scan]] = deque()
        self._box: deque[tuple[Scan, ScanStamp, Solver]] = deque()  # one at most; both ends are atomic
        self._token: deque[None] = deque([None])
        self.tap: StreamTap | None = None
        self._left_out: list[int] = []
        self._left_out_within_ns = 0
        self.withholdings = 0
        """How often scans began to be withheld."""
        self.doubtful = False
        """Whether a summary was lost, or discarded with its scan, that may have announced a new baseline."""
        self._frames = self._withheld = self._partial = 0
        self._offered = self._taken = self._solved = self._failed = self._untrusted = self._invalid = 0
        self._newest = 0
        self._solving = 0
        """Number of the scan that the worker in the stream is solving."""
        self.t_passed_ns = 0
        """Monotonic time at which the newest scan that was not withheld was received; 0 before the first."""

    # --- mainline

    def on_chunk(self, data: bytes, t_ns: int) -> None:
        """TPDO1."""
        self._frames += 1
        scan = self._assembler.on_chunk(data, t_ns)
        if scan is not None:
            self._offer(scan)

    def on_summary(self, data: bytes, t_ns: int) -> None:
        """TPDO2."""
        self._frames += 1
        scan = self._assembler.on_summary(data, t_ns)
        if scan is not None:
            self._offer(scan)

    def poll(self, t_ns: int) -> None:
        """Let a scan go that has waited long enough for what it lacks."""
        while self._unwatched and t_ns >= self._unwatched[0][0]:
            self._watch(self._unwatched.popleft()[1])
        deadline_ns = self._assembler.next_deadline_ns()
        if deadline_ns is None or t_ns < deadline_ns:
            return
        if self.tap is not None:
            self.tap.polled(self._patch, t_ns)
        scan = self._assembler.poll(t_ns)
        if scan is not None:  # it may have been thrown away
            self._offer(scan)

    def withhold(self) -> int:
        """Let no scan through from now on, the one under way included. Returns ``withholdings``."""
        self._solver = None
        self.withholdings += 1
        if self.tap is not None:
            self.tap.withheld(self._patch)
        return self.withholdings

    @property
    def withholding(self) -> bool:
        """Whether no scan is let through."""
        return self._solver is None

    def resume(self, solver: Solver, withholdings: int, *, anew: bool) -> None:
        """Let scans through from now on, decoded and solved by ``solver``; unless there was another reason to
        withhold them since there were ``withholdings``. ``anew``: the node was started, and what was
        assembled before belongs to another stream."""
        if withholdings != self.withholdings:
            return
        self._solver = solver
        self.doubtful = False
        checked = solver.facts.checked
        if anew:
            self._assembler.reset(under_way=self._under_way, checked=checked)
        elif checked:
            self._assembler.expect_check()
        if self.tap is not None:
            self.tap.resumed(self._patch, solver, anew=anew)

    def tell_tap(self) -> None:
        """Tell a tap that has come late whether scans are let through."""
        if self.tap is not None and self._solver is not None:
            self.tap.resumed(self._patch, self._solver, anew=False)

    def close(self) -> None:
        """Take no scan that is still in the box. Called when the mainline has ended."""
        self._box.clear()
        while self._unwatched:
            scan = self._unwatched.popleft()[1]
            with contextlib.suppress(Exception):  # no caller is left
                self._watch(scan)

    def _doubt(self) -> None:
        self.doubtful = True

    def _offer(self, scan: Scan) -> None:
        self._on_scan(scan)
        self._unwatched.append((scan.t_last_ns + WATCH_AFTER_NS, scan))
        if scan.flags & _BASELINE_CHANGED:  # this scan is the first with the new baseline
            self.withhold()
        elif scan.device_time_us is None:
            self.doubtful = True
        solver = self._solver
        if solver is None:
            self._withheld += 1
            return
        if not scan.empty:
            self.t_passed_ns = scan.t_last_ns
        tick = self._tick(scan.counter)
        stamp = ScanStamp(
            patch=self._patch,
            scan=scan.scan if tick is None else tick.number,
            counter=scan.counter,
            device_time_us=scan.device_time_us or 0,  # None: the summary was lost
            t_sync_ns=0 if tick is None else tick.t_ns,
            t_receive_ns=scan.t_last_ns,
        )
        self._newest = stamp.scan
        if not (scan.complete or self._passes_partial):
            self._partial += 1
            return
        self._offered += 1
        if self._is_left_out(stamp.t_receive_ns):
            return
        with contextlib.suppress(IndexError):
            _, older, _ = self._box.popleft()
            if self.tap is not None:
                self.tap.overtaken(self._patch, older.scan, older.t_receive_ns)
        self._box.append((scan, stamp, solver))
        self._call_worker()

    def leave_out(self, times_ns: Sequence[int], within_ns: int) -> None:
        """Skip the scans whose last frames came at these times, or so little off, as those that were
        overtaken when a recording was made. Their numbers would not do: after a pause the halves of a scan
        may be two of one number."""
        self._left_out, self._left_out_within_ns = sorted(times_ns), within_ns

    def _is_left_out(self, t_ns: int) -> bool:
        if not self._left_out:
            return False
        i = bisect.bisect_left(self._left_out, t_ns - self._left_out_within_ns)
        return i < len(self._left_out) and self._left_out[i] <= t_ns + self._left_out_within_ns

    def settled(self, scan: int) -> bool:
        """Whether ``scan`` or a newer one has come, or none is let through, and nothing is left to solve."""
        return (self._newest >= scan or self._solver is None) and not self._box and bool(self._token)

    # --- worker

    def _call_worker(self) -> None:
        try:
            self._token.pop()
        except IndexError:
            return  # a worker is in the stream and looks into the box when it is done
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
        self._taken += 1  # before it leaves the box, so that no reader of the counters sees it nowhere
        try:
            scan, stamp, solver = self._box.popleft()
        except IndexError:  # the stream was closed
            self._taken -= 1
            return
        self._solving = stamp.scan
        try:
            field, invalid = solver.solve(scan, stamp)
        except Exception:
            self._failed += 1
            raise
        self._solved += 1
        self._untrusted += not field.trusted
        self._invalid += invalid
        self._publisher.publish(field, stamp.patch)

    def _work_failed(self, error: Exception) -> None:
        """Handle a worker that could not start."""
        self._report(error)
        self._leave()

    def _leave(self) -> None:
        """Release the stream to the next worker, at once if a scan is waiting. Never raises: the holder must
        return the token exactly once."""
        self._token.append(None)
        try:
            if self._box:
                self._call_worker()
        except Exception as error:  # the scan waits for the next
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
        """Counters. Read in this order, no scan counts as skipped that may still be solved."""
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
