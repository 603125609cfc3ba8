"""What a node with faults puts on the bus, and what an assembler makes of it, on a clock that is a number:
what was injected is what is counted, to the frame, whatever happens at once.

Every reading has its own resistance, the same for all wire pairs, so a scan of two readings shows itself.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import numpy as np
import pytest

from skinnode.host.accounting import frames_counted
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import Pacing
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.codes import Codes
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import AssemblerStats, Scan
from tests.lanes import some_long
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

    def __init__(self, **profile_options: Any) -> None:
        layout = PatchLayout.preset(
            "staggered", upper_wires=4, lower_wires=12, upper_electrodes=4, lower_electrodes=4
        )
        profile = dataclasses.replace(PatchProfile.from_layout(layout), **profile_options)
        self._rest_ohm = resistance_ohm(layout, layout.upper_m)
        self.readings = self.syncs = 0
        self._tare_left = 16  # the node's own at power-on
        self.t_ns = 1_000 * MS
        self.scans: list[Scan] = []
        self.chunks = 0
        """That the node sent, or would have."""
        self._jitter = np.random.default_rng(5)
        self.profile = profile
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

    @property
    def mixed_and_complete(self) -> int:
        """Scans published as complete of more than one reading."""
        return sum(scan.complete and self._readings(scan.codes) > 1 for scan in self.scans)

    def _readings(self, codes: Codes) -> int:
        """How many readings there are in codes; those of one may differ by a rounding error of REAL32."""
        step = 1 << self.profile.code_bits - 16
        return len(np.unique((codes + step // 2) // step))

    def suffer(self, faults: Faults, scans: int) -> None:
        """Every other scan suffers, so that two faults do not meet."""
        for number in range(scans):
            self.node.faults = NO_FAULTS if number % 2 else faults
            self.run(1)
        self.node.faults = NO_FAULTS
        self.run(5)

    def assert_none_is_mixed(self) -> None:
        for scan in self.scans:
            assert self._readings(scan.codes[scan.valid]) <= 1, f"scan {scan.counter}"

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


@pytest.mark.long
def test_a_healthy_stream_is_whole() -> None:
    stream = Stream()
    stream.run(500)
    assert stream.readings == len(stream.scans) == stream.counted.scans_complete == 500
    assert [scan.scan for scan in stream.scans] == list(range(1, 501))
    stream.assert_none_is_mixed()


@pytest.mark.long
@pytest.mark.parametrize("seed", some_long(range(4), 0))
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
    assert counted.scans_unchecked <= injected.summary_lost  # some of them lack chunks as well
    published = counted.scans_complete + counted.scans_unchecked + counted.scans_torn
    assert published + 2 * injected.torn == stream.readings
    assert counted.scans_corrupt == counted.bad_form == 0
    stream.assert_none_is_mixed()


@pytest.mark.long
@pytest.mark.parametrize("place", some_long([0, 1, 7, 15], 7))
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


@pytest.mark.long
@pytest.mark.parametrize("place", some_long([0, 1, 7, 14, 15], 7))
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


# --- what neither counters nor numbers show


WIRES = [{}, {"code_bits": 24}, {"bus": "fd"}]
IDS = ["u16", "u24", "fd"]


@pytest.mark.parametrize("wire", some_long(WIRES, WIRES[0]), ids=IDS)
@pytest.mark.parametrize("attack", ["displaced", "understated"])
def test_a_scan_with_a_chunk_of_another_is_never_complete(attack: str, wire: dict[str, Any]) -> None:
    """A chunk with the counter of the next scan, whose own chunk is lost; a summary that says that only
    changed chunks were sent, one less than were, of which one is lost. Every chunk of five scans: without a
    check all of them are published as complete; with it none is."""
    complete, injected = {}, {}
    for checked in (False, True):
        stream = Stream(checked=checked, **wire)
        stream.run(3)
        for chunk in range(stream.profile.n_chunks):
            stream.suffer(Faults(struck=chunk, **{attack: 1.0}), 10)
        complete[checked] = stream.mixed_and_complete
        injected[checked] = getattr(stream.node.injected, attack)
        if checked:
            counted = stream.counted
            assert counted.scans_corrupt == injected[True]
            assert counted.scans_mixed == counted.conflicts == counted.bad_form == 0
            stream.assert_none_is_mixed()  # nor in part
        assert stream.scans[-1].complete
        assert frames_counted(stream.counted) == stream.node.injected.pdos
    assert injected[False] == injected[True] == 5 * stream.profile.n_chunks
    assert complete == {False: injected[False], True: 0}


@pytest.mark.parametrize("wire", some_long(WIRES, WIRES[0]), ids=IDS)
def test_a_code_changed_after_it_was_packed_is_never_complete(wire: dict[str, Any]) -> None:
    stream = Stream(**wire)
    stream.run(3)
    stream.suffer(Faults(corrupted=0.1), 300)
    injected, counted = stream.node.injected, stream.counted
    assert injected.corrupted > 20
    assert counted.scans_corrupt == injected.scans_spoilt
    assert counted.scans_complete == stream.readings - injected.scans_spoilt
    assert counted.scans_torn == counted.chunks_lost == counted.scans_unchecked == 0
    assert frames_counted(counted) == injected.pdos
    stream.assert_none_is_mixed()


def test_a_summary_without_its_check_makes_no_scan_complete() -> None:
    stream = Stream()
    stream.run(3)
    stream.suffer(Faults(unchecked=1.0), 40)
    injected, counted = stream.node.injected, stream.counted
    assert injected.unchecked == 20
    assert counted.bad_form == counted.summaries_lost == counted.scans_unchecked == 20
    assert counted.scans_complete == stream.readings - 20
    assert frames_counted(counted) == injected.pdos


@pytest.mark.long
@pytest.mark.parametrize("wire", some_long(WIRES, WIRES[0]), ids=IDS)
@pytest.mark.parametrize("seed", some_long(range(2), 0))
def test_what_a_check_finds_among_all_other_faults(wire: dict[str, Any], seed: int) -> None:
    """Frames are lost, repeated, late and falsified, and only changed chunks are sent: nothing complete is
    mixed."""
    stream = Stream(**wire)
    stream.node._random = np.random.default_rng(seed)
    stream._sdo(0x2F, 0x2020, 1, 1)
    chunks = dict.fromkeys(
        ("lost", "duplicated", "reordered", "late", "short", "miscounted", "corrupted"), 0.01
    )
    scans = dict.fromkeys(("torn", "summary_lost", "displaced", "understated", "unchecked"), 0.03)
    stream.node.faults = Faults(sync_lost=0.03, **chunks, **scans)
    stream.run(600)
    stream.node.faults = NO_FAULTS
    stream.run(25)
    assert stream.mixed_and_complete == 0
    assert stream.counted.scans_complete > 100
    assert stream.scans[-1].complete
    assert frames_counted(stream.counted) == stream.node.injected.pdos


def test_codes_that_stay_below_the_threshold_are_checked_as_they_were_sent() -> None:
    """What a receiver holds is not the newest reading, by design: the check is over the former."""
    stream = Stream()
    stream._sdo(0x2B, 0x2020, 2, 10)
    stream._sdo(0x2B, 0x2020, 3, 0)  # no refresh
    stream._sdo(0x2F, 0x2020, 1, 1)
    stream.run(100)  # each reading is one code above the one before
    assert stream.counted.scans_complete == len(stream.scans) == 100
    sent = [scan.chunks_received for scan in stream.scans]
    assert set(sent) == {0, CHUNKS}
    assert sent.count(CHUNKS) == 10


def test_device_time_is_that_of_the_node() -> None:
    """To 64 µs, of a clock that host and node share."""
    stream = Stream()
    begun: list[int] = []
    for _ in range(300):
        begun.append(stream.t_ns // 1000)
        stream.run(1)
    assert [scan.device_time_us for scan in stream.scans] == [t_us // 64 * 64 for t_us in begun]


def test_a_node_reset_mid_scan_leaves_a_part_of_it() -> None:
    stream = Stream()
    stream.run(3)
    stream.node.faults = Faults(reset=1.0)
    stream.run(1)
    stream.node.faults = NO_FAULTS
    stream.run(4)
    assert stream.node.injected.reset == 1
    assert [scan.complete for scan in stream.scans] == [True] * 3 + [False]
    assert stream.counted.scans_torn == 1


def test_a_single_scan_is_checked() -> None:
    stream = Stream()
    stream._sdo(0x2F, 0x1019, 0, 0)  # otherwise it would be taken for the scan of the next SYNC
    stream._sdo(0x2F, 0x1801, 2, 254)
    stream.assembler = ScanAssembler(stream.profile, period_ns=PERIOD_MS * MS)
    for number in range(3):
        stream._frame(0x205, bytes((0, 0, 0, 0, 1, 0)))
        stream._until(stream.t_ns + PERIOD_MS * MS)
        assert [(scan.complete, scan.flags) for scan in stream.scans[number:]] == [(True, 0x20)]
