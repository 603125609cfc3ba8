"""What a node is for: scans of the patch, at SYNC, by its own timer or on command; tare; wire faults.

Connects the manufacturer's objects (0x2000 to 0x2301) with the acquisition behind them and the stream of
scans before them. The communication around it is in :mod:`skinnode.node.device`.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.emergency import TOO_SLOW, EmcyCode
from skinnode.model.layout import PRESET_IDS, Float, PatchLayout
from skinnode.node.clock import NO_DEADLINE_NS, Pacing
from skinnode.node.device import Services
from skinnode.node.memory import Fault
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.patch.acquisition import Acquisition, Mask, WireFaults
from skinnode.node.patch.scan_stream import OutgoingScan, ScanStream
from skinnode.node.patch.self_test import self_test
from skinnode.node.patch.source import SourceFailed, SourceFault
from skinnode.protocol.chunk import pack_scan
from skinnode.protocol.codes import Codes
from skinnode.protocol.command import SendMode
from skinnode.protocol.coordinates import pack_coordinates
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan_check import check_of_codes
from skinnode.protocol.self_test import SELF_TEST_NEVER_RUN, pack_self_test
from skinnode.protocol.summary import SummaryFlag


class PatchApplication:
    """Scans of one patch; an :class:`~skinnode.node.device.Application`."""

    def __init__(
        self,
        layout: PatchLayout,
        profile: PatchProfile,
        serial: int,
        acquisition: Acquisition,
        services: Services,
        pacing: Pacing,
    ) -> None:
        self._profile, self._acquisition = profile, acquisition
        self._store, self._now = services.store, services.now
        self._emcy = services.emcy
        unknown = np.full((profile.rows, profile.columns), acquisition.scale.open, dtype=np.uint32)
        first_chunk = pack_scan(unknown, 0, profile)[0]
        self.stream = ScanStream(services.store, services.tpdos, first_chunk, pacing.catch_up_ns)
        self._storage = services.storage
        self._storage.baseline_ohm = lambda: tuple(map(tuple, acquisition.baseline_ohm.tolist()))
        self._operational = False
        self._counter = -1
        self._period_ns = 0
        self._faults_told: WireFaults = acquisition.faults
        self._source_fault: SourceFault | None = None
        self._late = False
        self._baseline_changed = False
        self._test = SELF_TEST_NEVER_RUN
        self.source_failures = 0
        """Readings, tares and self-tests that the source failed."""
        self.source_error = ""
        """What it failed of last."""
        self.overruns = 0
        """Scans skipped because two others were still to be sent."""
        self.slow_overruns = 0
        """Overruns because the computer or the bus was too slow, not because the scan period is too short."""
        self._scan_ns = NO_DEADLINE_NS  # when the node's own timer has a scan to take
        self._describe(layout, serial)
        self._connect()

    # --- events

    @property
    def deadline_ns(self) -> int:
        """When :meth:`on_timer` has a scan to take or to send."""
        return min(self._scan_ns, self.stream.deadline_ns)

    def power_on(self, t_ns: int) -> None:
        """Take the baseline from the memory, or tare, unless there is one from before."""
        remembered = self._remembered()
        if remembered is not None:
            self._acquisition.set_baselines(remembered)
        elif not self._acquisition.tared:
            with contextlib.suppress(SourceFailed):
                self._tare(t_ns)
                self._storage.keep_baseline()

    def reset(self) -> None:
        """The node was reset: scans are numbered anew and nothing has been told."""
        self._counter, self._late = -1, False
        self._faults_told = WireFaults.none(self._profile)
        self._test = SELF_TEST_NEVER_RUN
        if self._source_fault is not None:  # it has not gone away
            self._tell_source(self._source_fault, self._now())

    def enter(self, *, operational: bool) -> None:
        """The node entered another state."""
        self._operational = operational
        if operational:
            self._acquisition.forget_sent()
        else:
            self.stream.stop()
            self._catch_up(self._now())
        self._plan()

    def on_sync(self, counter: int | None, turns: frozenset[int], t_ns: int) -> None:
        """A SYNC came, in OPERATIONAL; ``turns`` are the synchronous TPDOs whose turn it is."""
        scans = not self._period_ns
        if not scans or self.stream.full:  # otherwise the summary of this scan comes, and no other before it
            self.stream.on_sync(turns, t_ns)
        if scans:
            self._scan(self._following() if counter is None else counter, turns, t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send what is due of the scans taken, and take the one that is due, if one is."""
        self.stream.on_timer(t_ns)
        if t_ns >= self._scan_ns:
            self._scan_ns = max(self._scan_ns + self._period_ns, t_ns)
            self._scan(self._following(), frozenset(), t_ns)

    # --- baseline

    def _remembered(self) -> NDArray[np.float32] | None:
        rows = self._storage.kept.baseline_ohm
        if not rows:
            return None
        try:
            values = np.array(rows, dtype=np.float32)
        except ValueError:  # rows of several lengths
            values = np.full((), np.nan, np.float32)
        shape = self._profile.rows, self._profile.columns
        if values.shape == shape and np.isfinite(values).all() and (values >= 0).all():
            return values
        self._storage.note(Fault.REFUSED, od.BASELINE_DOMAIN)
        return None

    def _new_baseline(self) -> None:
        """A baseline as a whole, measured or written, is kept without a command."""
        self._baseline_changed = True
        self._storage.keep_baseline()
        self._storage.tell(self._now())

    # --- scans

    def _following(self) -> int:
        return self._counter + 1 & 0xFF

    def _scan(self, counter: int, turns: frozenset[int], t_ns: int) -> None:
        """Sample now; the engine sends. Skipped, and counted, when a sampled scan waits to be sent
        already."""
        self._counter = counter
        if self.stream.full:
            self.overruns += 1
            held_up = self.stream.is_held_up(t_ns)
            self.slow_overruns += held_up
            if not self._late:
                self._late = True
                detail = struct.pack("<HB", self.overruns & 0xFFFF, TOO_SLOW if held_up else 0)
                self._emcy.present(EmcyCode.CAN_OVERRUN, detail, t_ns)
            return
        profile, time_us = self._profile, t_ns // 1000 & 0xFFFF_FFFF
        try:
            chunks, flags, codes = self._sample(counter, t_ns)
        except SourceFailed:
            chunks, flags, codes = [], SummaryFlag.SOURCE_FAILED, self._acquisition.codes
        check = check_of_codes(codes, profile) if profile.checked else None
        self.stream.offer(OutgoingScan(counter, chunks, flags, time_us, check, turns), t_ns)
        if not self.stream.full:
            self._catch_up(t_ns)

    def _catch_up(self, t_ns: int) -> None:
        """There is room for the next scan, or none is owed: an overrun is over."""
        self._late = False
        self._emcy.over(EmcyCode.CAN_OVERRUN, t_ns)

    def _sample(self, counter: int, t_ns: int) -> tuple[list[bytes], SummaryFlag, Codes]:
        """Take a scan. Returns its chunks to be sent, its flags, and the codes (U, K) that a receiver of all
        chunks then holds. Raises SourceFailed if the source raises."""
        store, acquisition = self._store, self._acquisition
        if not acquisition.tared:  # the source failed when it was to be done
            self._tare(t_ns)
            self._new_baseline()
        with self._source_watched(t_ns):
            acquisition.sample(t_ns, store.integer(od.ACQUISITION, od.ACQUISITION_AVERAGING))
        self._tell_faults(acquisition.faults, t_ns)
        flags = SummaryFlag.WIRE_FAULT if acquisition.faults.any else SummaryFlag(0)
        if self._baseline_changed:
            flags |= SummaryFlag.BASELINE_CHANGED
            self._baseline_changed = False
        codes = acquisition.codes
        chunks = pack_scan(codes, counter, self._profile)
        if store.integer(od.SEND_POLICY, od.SEND_MODE) == SendMode.CHANGED:
            changed = acquisition.changed_chunks(
                store.integer(od.SEND_POLICY, od.SEND_THRESHOLD),
                store.integer(od.SEND_POLICY, od.SEND_REFRESH),
            )
            if changed is not None:
                flags |= SummaryFlag.CHANGED_ONLY
                chunks, codes = [chunks[index] for index in changed], acquisition.sent
        return chunks, flags, codes

    def _tare(self, t_ns: int) -> None:
        with self._source_watched(t_ns):
            self._acquisition.tare(t_ns)

    @contextlib.contextmanager
    def _source_watched(self, t_ns: int) -> Iterator[None]:
        """Count and tell a failure of the source, and that it is over; the failure goes on to the caller."""
        try:
            yield
        except SourceFailed as failure:
            self.source_failures += 1
            self.source_error = str(failure)
            if failure.fault is not self._source_fault:  # once, not with every scan
                self._tell_source(failure.fault, t_ns)
            self._acquisition.forget_sent()
            raise
        if self._source_fault is not None:
            self._source_fault = None
            self._emcy.over(EmcyCode.SOURCE, t_ns)

    def _tell_source(self, fault: SourceFault, t_ns: int) -> None:
        self._source_fault = fault
        self._emcy.present(EmcyCode.SOURCE, struct.pack("<BH", fault, self.source_failures & 0xFFFF), t_ns)

    def _tell_faults(self, faults: WireFaults, t_ns: int) -> None:
        """One message when wires fail, with the kind and number of the first and how many there are: a pulled
        connector is one event."""
        told, self._faults_told = self._faults_told, faults
        if not faults.any:
            self._emcy.over(EmcyCode.HARDWARE, t_ns)
            return
        count = sum(int(mask.sum()) for mask in faults.masks)
        for kind, (now, before) in enumerate(zip(faults.masks, told.masks, strict=True)):
            new = now & ~before
            if new.any():
                detail = struct.pack("<BBH", kind, int(new.argmax()), count)
                self._emcy.present(EmcyCode.HARDWARE, detail, t_ns)
                return

    # --- object dictionary

    def _describe(self, layout: PatchLayout, serial: int) -> None:
        put, scale = self._store.put, self._acquisition.scale
        put(od.DESCRIPTOR, od.CODE_LO, scale.lo)
        put(od.DESCRIPTOR, od.CODE_HI, scale.hi)
        put(od.DESCRIPTOR, od.RESISTIVITY, layout.resistivity_ohm_per_m)
        put(od.DESCRIPTOR, od.LAYOUT_ID, PRESET_IDS.get(layout.name, PRESET_IDS["custom"]))
        put(od.DESCRIPTOR, od.LAYOUT_HASH, layout.layout_hash)
        put(od.DESCRIPTOR, od.SERIAL, serial)
        put(od.COORDINATES, 0, pack_coordinates(layout))

    def _connect(self) -> None:
        store, acquisition, stream = self._store, self._acquisition, self.stream
        chunk, summary = _fields(store, od.CHUNK), _fields(store, od.SUMMARY)
        result = _fields(store, od.SELF_TEST_RESULT)
        store.bind(od.SELF_TEST_RESULT, lambda sub: self._test[result[sub]])
        store.bind(od.CHUNK, lambda sub: stream.chunk[chunk[sub]])
        store.bind(od.SUMMARY, lambda sub: stream.summary[summary[sub]])
        store.watch(od.SEND_POLICY, lambda _: acquisition.forget_sent())
        store.guard(od.ACQUISITION, self._guard_acquisition)
        store.watch(od.ACQUISITION, self._on_acquisition)
        store.bind(od.UPPER_WIRE_FAULTS, lambda sub: _fault_word(acquisition.faults.masks[:2], sub))
        store.bind(od.LOWER_WIRE_FAULTS, lambda sub: _fault_word(acquisition.faults.masks[2:], sub))
        for row in range(self._profile.rows):
            self._connect_row(row)
        length = 4 * self._profile.n_codes
        store.bind_domain(od.BASELINE_DOMAIN, length, self._read_baseline, self._write_baseline)

    def _read_baseline(self, _: int) -> bytes:
        return self._acquisition.baseline_ohm.astype("<f4").tobytes()

    def _write_baseline(self, data: bytes) -> None:
        values = np.frombuffer(data, dtype="<f4").reshape(self._profile.rows, self._profile.columns)
        if not ((values > 0) & np.isfinite(values)).all():
            raise Refused(AbortCode.INVALID_VALUE)
        self._acquisition.set_baselines(values.astype(np.float32))
        self._new_baseline()

    def _connect_row(self, row: int) -> None:
        store, acquisition, width = self._store, self._acquisition, self._profile.code_bits // 8
        codes, baseline = od.CODES + row, od.BASELINE + row

        def set_baseline(subindex: int) -> None:
            if subindex:
                (value,) = struct.unpack("<f", store.written(baseline, subindex))
                acquisition.set_baseline(row, subindex - 1, value)
                self._baseline_changed = True

        store.bind(codes, lambda sub: int(acquisition.codes[row, sub - 1]).to_bytes(width, "little"))
        store.bind(baseline, lambda sub: struct.pack("<f", acquisition.baseline_ohm[row, sub - 1]))
        store.guard(baseline, _only_resistance)
        store.watch(baseline, set_baseline)

    def _guard_acquisition(self, subindex: int, value: int) -> None:
        match subindex:
            case od.TARE if value not in (0, od.TARE_SIGNATURE):
                raise Refused(AbortCode.CANNOT_STORE)
            case od.SELF_TEST if value not in (0, od.SELF_TEST_SIGNATURE):
                raise Refused(AbortCode.CANNOT_STORE)
            case od.SINGLE_SCAN if value:
                # Where SYNC numbers the scans, this one would be taken for the next.
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
            self._scan(self._following(), frozenset(), self._now())

    def _run_self_test(self, t_ns: int) -> None:
        acquisition = self._acquisition

        def read() -> Float:
            with self._source_watched(t_ns):
                return acquisition.read(t_ns)

        self._test = pack_self_test(
            self_test(read, acquisition.baseline_ohm.astype(np.float64), acquisition.scale)
        )

    def _plan(self) -> None:
        self._period_ns = self._store.integer(od.ACQUISITION, od.ACQUISITION_PERIOD) * 1_000_000
        runs = self._operational and self._period_ns
        self._scan_ns = self._now() + self._period_ns if runs else NO_DEADLINE_NS


def _fields(store: ObjectStore, index: int) -> dict[int, slice]:
    """Where the sub-objects of a record stand in the payload that carries it whole."""
    fields, at = {}, 0
    for subindex in range(1, store.integer(index) + 1):
        size = store.find(index, subindex).data_type.bits // 8
        fields[subindex] = slice(at, at + size)
        at += size
    return fields


def _fault_word(masks: tuple[Mask, ...], subindex: int) -> bytes:
    """A word of 32 wires: open ones at odd sub-indices, shorted ones at even ones."""
    first = (subindex - 1) // 2 * 32
    bits = masks[(subindex - 1) % 2][first : first + 32]
    return np.packbits(bits, bitorder="little").tobytes().ljust(4, b"\0")


def _only_resistance(_: int, pattern: int) -> None:
    (value,) = struct.unpack("<f", pattern.to_bytes(4, "little"))
    if not 0 < value < math.inf:
        raise Refused(AbortCode.INVALID_VALUE)
