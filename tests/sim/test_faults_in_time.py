"""What a node with faults puts on the bus, and what an assembler makes of it, on a clock that is a number:
what was injected is what is counted, to the frame, whatever happens at once.

Every reading has its own resistance, the same for all wire pairs, so a scan of two readings shows itself.
"""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest

from skinnode.host.accounting import frames_counted
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import Pacing
from skinnode.wire.assembler import AssemblerStats, Scan, ScanAssembler
from skinnode.wire.profile import PatchProfile
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.faulty_node import FaultyNode

MS = 1_000_000
NODE_ID = 5
PERIOD_MS = 25
CHUNKS = 16
COUNTERS = 240
TAGS = 4000
STEP = 1.0 / 65532
"""Of R/R0: one code of 16 bits."""


class Stream:
    """A node with faults and the assembler that hears it, one SYNC after the other."""

    def __init__(self) -> None:
        layout = PatchLayout.preset(
            "staggered", upper_wires=4, lower_wires=12, upper_electrodes=4, lower_electrodes=4
        )
        profile = PatchProfile.from_layout(layout)
        self._rest_ohm = resistance_ohm(layout, layout.upper_m)
        self.readings = self.syncs = 0
        self._tare_left = 16  # the node's own at power-on
        self.t_ns = 1_000 * MS
        self.scans: list[Scan] = []
        self.chunks = 0
        """That the node sent, or would have."""
        self._jitter = np.random.default_rng(5)
        self.assembler = ScanAssembler(profile, counter_overflow=COUNTERS, period_ns=PERIOD_MS * MS)
        self.node = FaultyNode(
            NODE_ID, layout, self, emit=self._emit, on_sent=self._on_sent, serial=1, profile=profile
        )
        self.node.pacing = Pacing(slack_ns=0, catch_up_ns=0)
        self.hit: int | None = None
        """Number of the one chunk of the next scan that suffers ``fault``."""
        self.fault = NO_FAULTS
        self.node.power_on(self.t_ns)
        self._sdo(0x2F, 0x1019, 0, COUNTERS)
        self._sdo(0x23, 0x1800, 1, 0x8000_0185)
        self._sdo(0x2B, 0x1800, 3, 10)  # a chunk each millisecond: a scan takes two thirds of the period
        self._sdo(0x23, 0x1800, 1, 0x185)
        self._frame(0x000, bytes((1, NODE_ID)))

    def read(self, t_ns: int) -> Float:
        if self._tare_left:
            self._tare_left -= 1
            return self._rest_ohm
        self.readings += 1
        return self._rest_ohm * (1.0 + self.readings % TAGS * STEP)

    def run(self, scans: int) -> None:
        """Let that many SYNC come, each early or late by up to half a millisecond."""
        for _ in range(scans):
            if self.hit == 0:
                self.node.faults = self.fault
            self._begun = self.chunks
            self.syncs += 1
            begin_ns = self.t_ns
            self._frame(0x080, bytes(((self.syncs - 1) % COUNTERS + 1,)))
            self._until(begin_ns + PERIOD_MS * MS + int(self._jitter.integers(-500_000, 500_000)))

    @property
    def counted(self) -> AssemblerStats:
        return self.assembler.stats

    def assert_none_is_mixed(self) -> None:
        for scan in self.scans:
            assert len(np.unique(scan.codes[scan.valid])) <= 1, f"scan {scan.counter}"

    # --- the clock

    def _frame(self, can_id: int, data: bytes) -> None:
        self.node.on_frame(can_id, data, self.t_ns)

    def _sdo(self, command: int, index: int, subindex: int, value: int) -> None:
        address = index.to_bytes(2, "little") + bytes((subindex,))
        self._frame(0x605, bytes((command,)) + address + value.to_bytes(4, "little"))

    def _until(self, end_ns: int) -> None:
        while True:
            dues = (self.node.next_deadline_ns(), self.assembler.next_deadline_ns(), end_ns)
            self.t_ns = max(self.t_ns, min(due for due in dues if due is not None))
            if self.t_ns >= end_ns:
                return
            self.node.on_timer(self.t_ns)
            self._keep(self.assembler.poll(self.t_ns))

    # --- the bus

    def _emit(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        if remote:
            return
        if can_id == 0x185:
            self._keep(self.assembler.on_chunk(data, self.t_ns))
        elif can_id == 0x285:
            self._keep(self.assembler.on_summary(data, self.t_ns))

    def _on_sent(self, can_id: int) -> None:
        if can_id == 0x185:
            self.chunks += 1
            if self.hit is not None:
                self.node.faults = self.fault if self.chunks - self._begun == self.hit else NO_FAULTS

    def _keep(self, scan: Scan | None) -> None:
        if scan is not None:
            self.scans.append(scan)


def test_a_healthy_stream_is_whole() -> None:
    stream = Stream()
    stream.run(500)
    assert stream.readings == len(stream.scans) == stream.counted.scans_complete == 500
    assert [scan.scan for scan in stream.scans] == list(range(1, 501))
    stream.assert_none_is_mixed()


@pytest.mark.parametrize("seed", range(4))
def test_all_faults_at_once_are_counted_to_the_frame(seed: int) -> None:
    stream = Stream()
    stream.node._random = np.random.default_rng(seed)
    stream.node.faults = Faults(
        lost=0.02,
        duplicated=0.02,
        reordered=0.02,
        late=0.02,
        short=0.02,
        remote=0.02,
        miscounted=0.02,
        miscounted_by=-10,
        torn=0.05,
        summary_lost=0.05,
        sync_lost=0.05,
    )
    stream.run(1000)
    stream.node.faults = NO_FAULTS
    stream.run(5)
    counted, injected = stream.counted, stream.node.injected
    told = {name: count for name, count in dataclasses.asdict(injected).items() if count}
    assert len(told) == 13  # each of the eleven, the chunks of torn scans, scans spoilt, and PDOs
    gone = injected.lost + injected.late + injected.short + injected.remote + injected.miscounted
    assert counted.chunks_lost == gone
    assert counted.scans_torn == injected.scans_spoilt
    assert counted.duplicates == injected.duplicated
    assert counted.late + counted.bad_counter == injected.late + injected.miscounted
    assert counted.bad_length == injected.short
    assert counted.scans_mixed == injected.torn
    assert counted.conflicts == injected.torn_chunks
    assert counted.summaries_lost == injected.summary_lost
    assert counted.scans_missed == injected.torn + injected.sync_lost
    assert counted.scans_discarded == counted.bad_index == counted.resyncs == 0
    assert frames_counted(counted) == injected.pdos
    assert counted.scans_complete + injected.scans_spoilt + 2 * injected.torn == stream.readings
    stream.assert_none_is_mixed()


@pytest.mark.parametrize("place", [0, 1, 7, 15])
def test_one_wrong_counter_of_any_value(place: int) -> None:
    """One of a scan long past or of none costs its chunk. One of a scan to come ends the present one, and
    either spoils that scan too, or the stream begins anew after three periods."""
    stream = Stream()
    outcomes: Counter[str] = Counter()
    stream.run(8)
    for off in range(1, 256):
        before, seen = stream.counted, len(stream.scans)
        counter = stream.syncs % COUNTERS + 1  # of the scan that suffers
        wrong = (counter + off) & 0xFF
        ahead = (wrong - counter) % COUNTERS + (place == 0)  # of the last scan heard of
        stream.hit, stream.fault = place, Faults(miscounted=1.0, miscounted_by=off)
        stream.run(1)
        stream.hit, stream.node.faults = None, NO_FAULTS
        stream.run(8)
        after = dataclasses.asdict(stream.counted)
        grown = {name: after[name] - count for name, count in dataclasses.asdict(before).items()}
        if not 1 <= wrong <= COUNTERS:
            outcome = "none"
            assert (grown["bad_counter"], grown["chunks_lost"], grown["scans_torn"]) == (1, 1, 1)
            assert grown["late"] == 0
        elif ahead > COUNTERS // 2:
            outcome = "past"
            assert (grown["late"], grown["chunks_lost"], grown["scans_torn"]) == (1, 1, 1)
        else:
            outcome = "to come"
            half_round = (
                wrong - counter
            ) % COUNTERS == COUNTERS // 2  # then what follows is half a round ahead too
            assert grown["scans_missed"] == (2 * (ahead - 1) if half_round else ahead - 1)
            meets = (wrong - counter) % COUNTERS <= 3  # frames of the scan that has it by right
            assert grown["scans_mixed"] == meets
            if not meets:
                assert grown["resyncs"] == (not half_round)
        outcomes[outcome] += 1
        assert [scan.complete for scan in stream.scans[seen:]][-4:] == [True] * 4  # within a second by far
        assert frames_counted(stream.counted) == stream.node.injected.pdos
    assert stream.node.injected.miscounted == sum(outcomes.values()) == 255
    assert len(outcomes) == 3
    stream.assert_none_is_mixed()


@pytest.mark.parametrize("place", [0, 1, 7, 14, 15])
def test_counter_of_the_scan_that_comes_as_the_timeout_ends(place: int) -> None:
    """Three scans ahead: its own frame of that place comes a little before or a little after the timeout."""
    stream = Stream()
    stream.run(8)
    for times in range(1, 41):
        stream.hit, stream.fault = place, Faults(miscounted=1.0, miscounted_by=3)
        stream.run(1)
        stream.hit, stream.node.faults = None, NO_FAULTS
        while stream.syncs % COUNTERS > COUNTERS - 12:  # where three more would be no counter, or past zero
            stream.run(1)
        stream.run(8)
        stream.assert_none_is_mixed()
        assert place == 0 or stream.counted.scans_mixed == times
