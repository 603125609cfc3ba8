"""Application of a patch: takes scans, measures the baseline and runs self-tests.

Most manufacturer objects (0x2000 to 0x2301) are connected to the application in
:mod:`skinnode.node.patch.objects`.
"""

from __future__ import annotations

import contextlib
import struct

import numpy as np
from numpy.typing import NDArray

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.emergency import TOO_SLOW, EmcyCode
from skinnode.model.layout import Float, PatchLayout
from skinnode.node.application import ApplicationServices
from skinnode.node.memory import Fault
from skinnode.node.pacing import NO_DEADLINE_NS, Pacing
from skinnode.node.patch.acquisition import Acquisition
from skinnode.node.patch.objects import bind_baseline, bind_scan, describe, fields_of
from skinnode.node.patch.scan_stream import OutgoingScan, ScanStream
from skinnode.node.patch.self_test import self_test
from skinnode.node.patch.source import SourceFailed
from skinnode.node.patch.source_monitor import SourceMonitor
from skinnode.node.patch.wire_faults import WireFaultReporter
from skinnode.protocol.chunk import pack_scan
from skinnode.protocol.codes import Codes
from skinnode.protocol.command import SendMode
from skinnode.protocol.scan_check import check_of_codes
from skinnode.protocol.self_test import SELF_TEST_NEVER_RUN, pack_self_test
from skinnode.protocol.summary import SummaryFlag, conversion_flags

# as integers, which are ten times as fast as enum flags
_WIRE_FAULT, _SOURCE_FAILED = int(SummaryFlag.WIRE_FAULT), int(SummaryFlag.SOURCE_FAILED)
_BASELINE_CHANGED, _CHANGED_ONLY = int(SummaryFlag.BASELINE_CHANGED), int(SummaryFlag.CHANGED_ONLY)


class PatchApplication:
    """Application of one patch; implements :class:`~skinnode.node.application.Application`.

    Args:
        layout: Electrodes of the patch.
        serial: Serial number (0x2000:11), u32.
        acquisition: Source of the codes and the baseline.
        services: Services of the device.
        pacing: Timer precision of the node, which determines how chunks are paced.
    """

    def __init__(
        self,
        layout: PatchLayout,
        serial: int,
        acquisition: Acquisition,
        services: ApplicationServices,
        pacing: Pacing,
    ) -> None:
        profile = acquisition.profile
        self._profile, self._acquisition = profile, acquisition
        self._store, self._now = services.store, services.now
        self._emcy = services.emcy
        unknown = np.full((profile.rows, profile.columns), acquisition.scale.open, dtype=np.uint32)
        first_chunk = pack_scan(unknown, 0, profile)[0]
        self.stream = ScanStream(
            services.store, services.tpdos, first_chunk, pacing.catch_up_ns, acquisition.selection.forget
        )
        """Sender of the scans."""
        self._storage = services.storage
        self._storage.baseline_ohm = lambda: tuple(map(tuple, acquisition.baseline_ohm.tolist()))
        self._operational = False
        self._counter = -1
        # The receiver's codes and their CRC. The array of codes is never modified in place.
        self._checked: Codes | None = None
        self._check = 0
        self._period_ns = 0
        self._wire_faults = WireFaultReporter(profile, services.emcy)
        self.source = SourceMonitor(services.emcy, acquisition.selection.forget)
        """Monitor of source failures."""
        self._late = False
        self._baseline_changed = False
        self._test = SELF_TEST_NEVER_RUN
        self.overruns = 0
        """Number of scans skipped because one scan was still being sent and another was waiting."""
        self.slow_overruns = 0
        """Number of scans skipped because the computer or the bus was too slow, not because the scan period
        is too short."""
        self._scan_ns = NO_DEADLINE_NS  # time of the next timer-driven scan
        describe(services.store, layout, acquisition.scale, serial)
        self._connect()

    # --- events

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which :meth:`on_timer` must be called next."""
        return min(self._scan_ns, self.stream.deadline_ns)

    @property
    def baseline_ohm(self) -> Float:
        """(U, K) baseline R0 in ohms; 0 where unknown."""
        return self._acquisition.baseline_ohm.astype(np.float64)

    def power_on(self, t_ns: int) -> None:
        """Load the baseline from the memory, or tare if there is no baseline.

        Args:
            t_ns: Current time, in ns.
        """
        remembered = self._remembered()
        if remembered is not None:
            self._acquisition.set_baselines(remembered)
        elif not self._acquisition.tared:
            with contextlib.suppress(SourceFailed):
                self._tare(t_ns)
                self._storage.keep_baseline()

    def reset(self, *, everything: bool) -> None:
        """Restart the scan counter. Persistent faults are reported again.

        If ``everything`` is true, also forget the result of the self-test.
        """
        self._counter, self._late = -1, False
        self._wire_faults.reset()
        if everything:
            self._test = SELF_TEST_NEVER_RUN
        self.source.reset(self._now())

    def enter(self, *, operational: bool) -> None:
        """Handle a change in the NMT state."""
        self._operational = operational
        if operational:
            self._acquisition.selection.forget()
        else:
            self.stream.stop()
            self._end_overrun(self._now())
        self._plan()

    def on_sync(self, counter: int | None, turns: frozenset[int], t_ns: int) -> None:
        """Take a scan on a SYNC in OPERATIONAL, unless scans are timer-driven.

        Args:
            counter: SYNC counter; None if the SYNC contains no counter.
            turns: Numbers of the synchronous TPDOs that are due.
            t_ns: Arrival time of the SYNC, ns.
        """
        scans = not self._period_ns
        self.stream.on_sync(turns, t_ns, starts_scan=scans and not self.stream.full)
        if scans:
            self._scan(self._following() if counter is None else counter, turns, t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send the chunks and summaries due at ``t_ns``, and take a timer-driven scan if it is due."""
        self.stream.on_timer(t_ns)
        if t_ns >= self._scan_ns:
            self._scan_ns = max(self._scan_ns + self._period_ns, t_ns)
            self._scan(self._following(), None, t_ns)

    # --- baseline

    def _remembered(self) -> NDArray[np.float32] | None:
        rows = self._storage.kept.baseline_ohm
        if not rows:
            return None
        try:
            values = np.array(rows, dtype=np.float32)
        except ValueError:  # rows of different lengths
            values = np.full((), np.nan, np.float32)
        shape = self._profile.rows, self._profile.columns
        if values.shape == shape and np.isfinite(values).all() and (values >= 0).all():
            return values
        self._storage.note(Fault.REFUSED, od.BASELINE_DOMAIN)
        return None

    def _new_baseline(self) -> None:
        """Announce a new baseline and save it."""
        self._mark_baseline()
        self._storage.keep_baseline()
        self._storage.report(self._now())

    def _mark_baseline(self) -> None:
        """Announce a new baseline in the next summary."""
        self._baseline_changed = True

    # --- scans

    def _following(self) -> int:
        return self._counter + 1 & 0xFF

    def _scan(self, counter: int, turns: frozenset[int] | None, t_ns: int) -> None:
        """Take a scan and queue it, or skip it if another scan is already waiting.

        Args:
            counter: Scan counter.
            turns: Numbers of the synchronous TPDOs that are due at the SYNC; None if no SYNC starts the scan.
            t_ns: Current time, in ns.
        """
        self._counter = counter
        if self.stream.full:
            self._acquisition.selection.forget()  # receivers notice the gap
            self.overruns += 1
            held_up = self.stream.is_held_up(t_ns)
            self.slow_overruns += held_up
            if not self._late:
                self._late = True
                detail = struct.pack("<HB", self.overruns & 0xFFFF, TOO_SLOW if held_up else 0)
                self._emcy.report(EmcyCode.CAN_OVERRUN, detail, t_ns)
            return
        profile, time_us = self._profile, t_ns // 1000 & 0xFFFF_FFFF
        try:
            chunks, flags, codes = self._sample(counter, t_ns)
        except SourceFailed:
            chunks, flags, codes = [], _SOURCE_FAILED, self._acquisition.codes
        check = None
        if profile.checked:
            if codes is not self._checked:
                self._checked, self._check = codes, check_of_codes(codes, profile)
            check = self._check
            flags |= conversion_flags(self._acquisition.phase)
        self.stream.offer(OutgoingScan(counter, chunks, flags, time_us, check, turns), t_ns)
        if not self.stream.full:
            self._end_overrun(t_ns)

    def _end_overrun(self, t_ns: int) -> None:
        """Report the end of an overrun once scans are no longer skipped."""
        self._late = False
        self._emcy.clear(EmcyCode.CAN_OVERRUN, t_ns)

    def _sample(self, counter: int, t_ns: int) -> tuple[list[bytes], int, Codes]:
        """Take a scan.

        Returns the chunks to send, the summary flags, and the (U, K) codes that the receiver will have after
        this scan. Raises SourceFailed if the source returns no valid reading.
        """
        store, acquisition = self._store, self._acquisition
        if not acquisition.tared:  # taring failed at power-on
            self._tare(t_ns)
            self._new_baseline()
        with self.source.watch(t_ns):
            acquisition.sample(t_ns, store.integer(od.ACQUISITION, od.ACQUISITION_AVERAGING))
        self._wire_faults.report(acquisition.faults, t_ns)
        flags = _WIRE_FAULT if acquisition.faults.any else 0
        if self._baseline_changed:
            flags |= _BASELINE_CHANGED
            self._baseline_changed = False
        codes, changed = acquisition.codes, None
        if store.integer(od.SEND_POLICY, od.SEND_MODE) == SendMode.CHANGED:
            changed = acquisition.selection.changed_chunks(
                codes,
                store.integer(od.SEND_POLICY, od.SEND_THRESHOLD),
                store.integer(od.SEND_POLICY, od.SEND_REFRESH),
            )
        chunks = pack_scan(codes, counter, self._profile, changed)
        if changed is not None:
            flags |= _CHANGED_ONLY
            codes = acquisition.selection.sent
        return chunks, flags, codes

    def _tare(self, t_ns: int) -> None:
        with self.source.watch(t_ns):
            self._acquisition.tare(t_ns)

    # --- object dictionary

    def _connect(self) -> None:
        store, acquisition = self._store, self._acquisition
        result = fields_of(store, od.SELF_TEST_RESULT)
        store.bind(od.SELF_TEST_RESULT, lambda sub: self._test[result[sub]])
        bind_scan(store, acquisition, self.stream)
        bind_baseline(store, acquisition, self._mark_baseline, self._new_baseline)
        store.watch(od.SEND_POLICY, lambda _: acquisition.selection.forget())
        store.guard(od.ACQUISITION, self._guard_acquisition)
        store.watch(od.ACQUISITION, self._on_acquisition)

    def _guard_acquisition(self, subindex: int, value: int) -> None:
        match subindex:
            case od.TARE if value not in (0, od.TARE_SIGNATURE):
                raise Refused(AbortCode.CANNOT_STORE)
            case od.SELF_TEST if value not in (0, od.SELF_TEST_SIGNATURE):
                raise Refused(AbortCode.CANNOT_STORE)
            case od.SINGLE_SCAN if value:
                # With SYNC counters, a single scan would have the same counter as the scan for the next SYNC.
                numbered_by_sync = not self._period_ns and self._store.integer(od.SYNC_COUNTER_OVERFLOW)
                if numbered_by_sync or not self._operational:
                    raise Refused(AbortCode.DEVICE_STATE)

    def _on_acquisition(self, subindex: int) -> None:
        store = self._store
        if subindex == od.ACQUISITION_PERIOD:
            self._plan()
        elif subindex == od.TARE and store.integer(od.ACQUISITION, od.TARE):
            store.put(od.ACQUISITION, od.TARE, 0)
            try:
                self._tare(self._now())
            except SourceFailed:
                raise Refused(AbortCode.HARDWARE) from None
            self._new_baseline()
        elif subindex == od.SELF_TEST and store.integer(od.ACQUISITION, od.SELF_TEST):
            store.put(od.ACQUISITION, od.SELF_TEST, 0)
            self._run_self_test(self._now())
        elif subindex == od.SINGLE_SCAN and store.integer(od.ACQUISITION, od.SINGLE_SCAN):
            store.put(od.ACQUISITION, od.SINGLE_SCAN, 0)
            self._scan(self._following(), None, self._now())

    def _run_self_test(self, t_ns: int) -> None:
        acquisition = self._acquisition

        def read() -> Float:
            with self.source.watch(t_ns):
                return acquisition.read(t_ns)

        self._test = pack_self_test(
            self_test(read, acquisition.baseline_ohm.astype(np.float64), acquisition.scale)
        )

    def _plan(self) -> None:
        self._period_ns = self._store.integer(od.ACQUISITION, od.ACQUISITION_PERIOD) * 1_000_000
        runs = self._operational and self._period_ns
        self._scan_ns = self._now() + self._period_ns if runs else NO_DEADLINE_NS
