"""Scans and PDOs: what goes out after a SYNC, in which order and when."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable

import numpy as np
import pytest

from skinnode.errors import BusError
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout
from skinnode.node import THRIFTY, Pacing
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.profile import PatchProfile

from ..scan_crc import check_of_scan

CHUNK, SUMMARY, EMCY = 0x184, 0x284, 0x084
STEPS = 65532  # 2**16 - 4
REST = round((1.0 - 0.25) * STEPS)
PERIOD_MS = 80


def scan(desk, counter: str, ms: float = PERIOD_MS) -> list[tuple[int, str]]:
    """All frames from a SYNC to the end of its period."""
    desk.take()
    desk.node.on_frame(0x80, bytes.fromhex(counter), desk.t_ns)
    desk.run(ms)
    return desk.take()


def codes_of(frames: list[tuple[int, str]]) -> dict[int, list[int]]:
    """Chunk index to codes."""
    chunks = [bytes.fromhex(data) for can_id, data in frames if can_id == CHUNK]
    return {chunk[0]: list(struct.unpack("<3H", chunk[2:])) for chunk in chunks}


def test_scan_at_sync_bit_by_bit(operational) -> None:
    desk = operational
    desk.source.ohm = desk.source.ohm * np.linspace(0.5, 1.0, 12).reshape(2, 6)
    t_us = desk.t_ns // 1000
    frames = scan(desk, "11")
    ratio = np.linspace(0.5, 1.0, 12)
    codes = [round((r - 0.25) * STEPS) for r in ratio]
    expected = [
        (CHUNK, struct.pack("<BB3H", index, 0x11, *codes[3 * index : 3 * index + 3]).hex(" "))
        for index in range(4)
    ]
    head = struct.pack("<BBHH", 0x11, 0x20, 4, t_us >> 6 & 0xFFFF)  # CHECKED, time in steps of 64 µs
    sent = [code for chunk in codes_of(frames).values() for code in chunk]
    expected.append((SUMMARY, (head + struct.pack("<H", check_of_scan(sent, 16, head))).hex(" ")))
    assert [desk.read(0x2011, sub) for sub in range(1, 7)] == [
        *(0x11, 0x20, 4, t_us, t_us >> 6 & 0xFFFF),
        check_of_scan(sent, 16, head),
    ]
    # R0 is kept as REAL32 and R/R0 may round to the neighbouring code: compare within one step.
    assert [frame[0] for frame in frames] == [frame[0] for frame in expected]
    assert frames[-1] == expected[-1]
    got = [code for chunk in codes_of(frames).values() for code in chunk]
    assert np.abs(np.array(got) - codes).max() <= 1
    assert [bytes.fromhex(data)[:2] for _, data in frames[:4]] == [bytes((i, 0x11)) for i in range(4)]


def test_codes_and_baseline_can_be_read_back(operational, rest_ohm) -> None:
    desk = operational
    desk.source.ohm = rest_ohm * 0.8
    scan(desk, "01")
    baseline = [[_float(desk.read(0x2200 + r, k + 1)) for k in range(6)] for r in range(2)]
    np.testing.assert_allclose(baseline, rest_ohm, rtol=1e-7)
    codes = np.array([[desk.read(0x2100 + r, k + 1) for k in range(6)] for r in range(2)])
    assert np.abs(codes - round(0.55 * STEPS)).max() <= 1
    assert desk.read(0x2010, 1) == 3  # the chunk last sent
    assert desk.read(0x2010, 5) == codes[1, 5]
    assert desk.read(0x2011, 3) == 4


def test_24_bit_codes_are_two_a_chunk(make: Callable, layout: PatchLayout, rest_ohm) -> None:
    desk = make(profile=PatchProfile.from_layout(layout, 24))
    desk.start()
    frames = scan(desk, "")
    assert len(frames) == 7
    rest = round(0.75 * (2**24 - 4))
    for _, data in frames[:6]:
        chunk = bytes.fromhex(data)
        for at in (2, 5):
            assert abs(int.from_bytes(chunk[at : at + 3], "little") - rest) <= 2
    assert desk.read(0x2000, 5) == 24


def test_inhibit_time_paces_the_chunks(operational) -> None:
    desk = operational
    start_ns = desk.t_ns
    desk.node.on_frame(0x80, b"\x01", desk.t_ns)
    desk.run(20)
    times = [(can_id, t_ns - start_ns) for can_id, _, t_ns in desk.sent]
    assert times == [
        (CHUNK, 0),
        (CHUNK, 500_000),
        (CHUNK, 1_000_000),
        (CHUNK, 1_500_000),
        (SUMMARY, 1_500_000),
    ]


@pytest.mark.parametrize(
    ("catch_up_ms", "distances_us"),
    [
        (0, [0, 2500, 500, 500]),  # strict: never closer than the inhibit time
        (10, [0, 2500, 0, 0]),  # the pace is kept on the whole
        (1, [0, 2500, 0, 0]),  # two frames of 0.5 ms fit into 1 ms
        (0.5, [0, 2500, 0, 500]),
    ],
)
def test_late_thread(make: Callable, catch_up_ms: float, distances_us: list[int]) -> None:
    desk = make(pacing=Pacing(slack_ns=0, catch_up_ns=round(catch_up_ms * 1e6)))
    desk.write(0x1800, 1, 0x80000184, 4)
    desk.write(0x1800, 3, 5, 2)
    desk.write(0x1800, 1, 0x184, 4)
    desk.start()
    desk.t_ns += 1_000_000_000  # an idle while earns no burst
    desk.sent.clear()
    start_ns = desk.t_ns
    desk.node.on_frame(0x80, b"", desk.t_ns)
    desk.run(0)
    desk.t_ns += 2_500_000
    desk.node.on_timer(desk.t_ns)
    desk.run(10)
    times = [start_ns] + [t_ns for can_id, _, t_ns in desk.sent if can_id == CHUNK]
    assert [int(d) // 1000 for d in np.diff(times)] == distances_us


def test_time_that_sampling_takes_is_kept_from_the_inhibit_time(operational) -> None:
    """The thread hands over a SYNC with the time it came, and is 0.4 ms later when the first chunk is out."""
    desk = operational
    start_ns = desk.t_ns
    desk.node.on_frame(0x80, b"\x01", desk.t_ns)
    desk.t_ns += 400_000
    desk.run(10)
    assert desk.times(CHUNK, start_ns) == [0, 0.9, 1.4, 1.9]


@pytest.mark.parametrize("own", ["timer", "SYNC"])
def test_so_it_is_when_the_node_starts_the_scan_itself(operational, own: str) -> None:
    desk = operational
    desk.write(0x1801, 1, 0x80000284, 4)
    if own == "timer":
        desk.write(0x2021, 1, 20, 2)
    else:
        desk.write(0x1006, 0, 20_000, 4)
        desk.write(0x1005, 0, 0x4000_0080, 4)
    start_ns = desk.t_ns
    desk.t_ns += 20_000_000
    desk.node.on_timer(desk.t_ns)
    desk.t_ns += 400_000
    desk.run(10)
    assert desk.times(CHUNK, start_ns) == [20, 20.9, 21.4, 21.9]


def test_reserved_codes(operational) -> None:
    desk = operational
    ohm = desk.source.ohm.copy()
    ohm[0, :4] = np.inf, 0.0, np.nan, ohm[0, 3] * 2
    desk.source.ohm = ohm
    codes = codes_of(scan(desk, "01"))
    assert codes[0] == [65535, 65534, 65535]  # open, short, open
    assert codes[1][0] == 65533  # over range


def test_without_a_sync_counter_scans_are_numbered_by_the_node(desk) -> None:
    desk.start()
    numbers = []
    for _ in range(258):
        frames = scan(desk, "", 10)
        assert len(frames) == 5
        numbers += [int(data[:2], 16) for can_id, data in frames if can_id == SUMMARY]
    assert numbers == [*range(256), 0, 1]


def test_scan_in_progress_is_finished_before_the_next(operational) -> None:
    """A SYNC one frame too early: sampled then, sent afterwards, nothing lost, nothing mixed."""
    desk = operational
    desk.node.on_frame(0x80, b"\x01", desk.t_ns)
    desk.run(1.2)
    desk.source.ohm = desk.source.ohm * 0.5
    second_us = desk.t_ns // 1000
    desk.node.on_frame(0x80, b"\x02", desk.t_ns)
    desk.source.ohm = desk.source.ohm * 3  # after the SYNC: must not be seen
    desk.run(20)
    frames = desk.take()
    numbers = [int(data[3:5] if can_id == CHUNK else data[:2], 16) for can_id, data in frames]
    assert numbers == [1] * 5 + [2] * 5
    assert abs(codes_of(frames[5:])[0][0] - round(0.25 * STEPS)) <= 1
    assert struct.unpack("<H", bytes.fromhex(frames[-1][1])[4:6]) == (second_us >> 6 & 0xFFFF,)
    assert desk.read(0x2011, 4) == second_us
    assert desk.node.overruns == 0


def test_overrun_skips_scans_and_says_so(operational) -> None:
    desk = operational
    for counter in (1, 2, 3, 4):  # all within the time of one
        desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
        desk.run(0.1)
    desk.run(20)
    frames = desk.take()
    assert [data for can_id, data in frames if can_id == EMCY] == ["10 81 11 01 00 00 00 00"]
    assert [int(data[:2], 16) for can_id, data in frames if can_id == SUMMARY] == [1, 2]
    assert desk.node.overruns == 2
    assert (EMCY, "00 00 00 10 81 00 00 00") in scan(desk, "05")
    assert desk.read(0x1001, 0) == 0
    for counter in (6, 7, 8):
        desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
    assert (EMCY, "10 81 11 03 00 00 00 00") in desk.take()  # told again, the third in all


def test_a_thread_with_a_coarse_timer_keeps_pace_and_an_overrun_ends(make: Callable) -> None:
    """100 ticks a second: the thread wakes at the second tick after what it waited for, now and then two
    ticks later still. Chunks are paced to take 80 % of the SYNC period, as the host sets it."""
    desk = make(pacing=THRIFTY)
    desk.write(0x1019, 0, 240, 1)
    desk.write(0x1800, 1, 0x80000184, 4)
    desk.write(0x1800, 3, 160, 2)  # 5 frames in 80 ms
    desk.write(0x1800, 1, 0x184, 4)
    desk.start()
    desk.take()
    tick_ns, period_ns = 10_000_000, 100_000_000
    begin_ns, wakings = desk.t_ns, 0
    for sync in range(50):
        end_ns = begin_ns + (sync + 1) * period_ns
        desk.node.on_frame(0x80, bytes((sync + 1,)), desk.t_ns)
        stalled = sync in (10, 11, 12)  # the thread does not run at all: an overrun in earnest
        while not stalled and (due_ns := desk.node.next_deadline_ns()) is not None:
            wakings += 1
            late = 2 if wakings % 5 else 4
            woken_ns = (max(due_ns, desk.t_ns) // tick_ns + late) * tick_ns
            if woken_ns >= end_ns:
                break
            desk.t_ns = woken_ns
            desk.node.on_timer(desk.t_ns)
        desk.t_ns = end_ns
    emergencies = [(t_ns, data[:2]) for can_id, data, t_ns in desk.sent if can_id == EMCY]
    assert [code.hex() for _, code in emergencies] == ["1081", "0000"]
    assert emergencies[1][0] < begin_ns + 13 * period_ns + 1_000_000_000
    assert desk.node.overruns <= 3  # those of the stall


def test_an_overrun_of_a_slow_computer_says_so(operational) -> None:
    """SYNCs that come in time, and a thread that does not."""
    desk = operational
    for counter in (1, 2, 3):
        desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
        desk.t_ns += 50_000_000  # nobody drives the node meanwhile
    assert [data for can_id, data in desk.take() if can_id == EMCY] == ["10 81 11 01 00 01 00 00"]
    assert (desk.node.overruns, desk.node.slow_overruns) == (1, 1)
    desk.run(200)
    for counter in (4, 5, 6):
        desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
        desk.run(0.1)  # in time, but a scan takes longer than that
    assert (desk.node.overruns, desk.node.slow_overruns) == (2, 1)


@pytest.mark.parametrize(("command", "told_at_once"), [("80 00", True), ("02 00", False)])
def test_overrun_is_over_when_no_scan_is_owed(operational, command: str, told_at_once: bool) -> None:
    desk = operational
    for counter in (1, 2, 3):
        desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
    assert (EMCY, "10 81 11 01 00 00 00 00") in desk.take()
    over = [(EMCY, "00 00 00 10 81 00 00 00")]
    assert desk.frame(0, command) == (over if told_at_once else [])
    assert desk.frame(0, "80 00") == ([] if told_at_once else over)  # a stopped node sends none
    assert desk.read(0x1001, 0) == 0


def test_leaving_operational_drops_the_scan(operational) -> None:
    desk = operational
    desk.node.on_frame(0x80, b"\x01", desk.t_ns)
    desk.run(0.6)
    assert len(desk.take()) == 2
    desk.frame(0, "80 00")
    assert desk.node.next_deadline_ns() is None
    desk.run(50)
    assert desk.take() == []
    desk.frame(0, "01 00")
    desk.run(50)
    assert desk.take() == []
    assert len(scan(desk, "02")) == 5


def test_disabling_the_chunk_pdo_under_way_is_told_by_the_summary(operational) -> None:
    desk = operational
    desk.node.on_frame(0x80, b"\x01", desk.t_ns)
    desk.run(0.6)
    desk.take()
    desk.node.on_frame(0x604, bytes.fromhex("2300180184010080"), desk.t_ns)
    desk.run(5)
    frames = desk.take()
    assert [can_id for can_id, _ in frames] == [0x584, SUMMARY]
    assert frames[1][1][:11] == "01 22 02 00"  # OVERRUN: chunks left out; two were sent
    assert desk.frame(0x80, "02")[-1][1][:11] == "02 22 00 00"
    desk.write(0x1800, 1, 0x184, 4)
    frames = scan(desk, "03")
    assert [data[:5] for can_id, data in frames if can_id == CHUNK] == ["00 03", "01 03", "02 03", "03 03"]


class Refusing(list[tuple[int, bytes, int]]):
    """What is sent, but for the frame with this number, which the bus refuses."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self._left = number

    def append(self, item: tuple[int, bytes, int]) -> None:
        self._left -= 1
        if self._left == -1:
            raise BusError("can0: no buffer space available")
        super().append(item)


def assembled(assembler: ScanAssembler, desk) -> list[int]:
    """Counters of the complete scans in what was sent."""
    scans = []
    for can_id, data, t_ns in desk.sent:
        if can_id in (CHUNK, SUMMARY):
            scans.append((assembler.on_chunk if can_id == CHUNK else assembler.on_summary)(data, t_ns))
    desk.take()
    scans.append(assembler.poll(desk.t_ns))
    return [each.counter for each in scans if each is not None and each.complete]


class TestChangedOnly:
    @pytest.fixture
    def changed(self, operational):
        operational.write(0x2020, 2, 10, 2)
        operational.write(0x2020, 3, 5, 2)
        operational.write(0x2020, 1, 1, 1)
        return operational

    def test_first_scan_is_full_then_only_what_moved(self, changed) -> None:
        desk = changed
        assert len(scan(desk, "01")) == 5
        frames = scan(desk, "02")
        assert len(frames) == 1
        assert frames[0][1][:11] == "02 21 00 00"  # CHANGED_ONLY, no chunk
        ohm = desk.source.ohm.copy()
        ohm[1, 0] *= 1 - 11.5 / STEPS  # chunk 2, more than ten codes
        ohm[0, 0] *= 1 - 8.5 / STEPS
        desk.source.ohm = ohm
        frames = scan(desk, "03")
        assert list(codes_of(frames)) == [2]
        assert frames[-1][1][:11] == "03 21 01 00"

    def test_slow_drift_is_measured_from_what_was_sent(self, changed) -> None:
        desk = changed
        desk.write(0x2020, 3, 0, 2)  # no refresh
        scan(desk, "01")
        rest = desk.source.ohm
        sent_at = []
        for step in range(1, 31):
            desk.source.ohm = rest * (1 - step / STEPS)
            if codes_of(scan(desk, f"{step + 1:02x}")):
                sent_at.append(step)
        assert len(sent_at) == 2
        assert all(abs(at - want) <= 1 for at, want in zip(sent_at, (11, 22), strict=True))

    def test_full_refresh(self, changed) -> None:
        desk = changed
        lengths = [len(scan(desk, f"{counter:02x}")) for counter in range(1, 12)]
        assert lengths == [5, 1, 1, 1, 1, 5, 1, 1, 1, 1, 5]

    def test_reserved_codes_are_always_a_change(self, changed) -> None:
        desk = changed
        desk.write(0x2020, 2, 65535, 2)
        scan(desk, "01")
        ohm = desk.source.ohm.copy()
        ohm[0, 0] = np.inf
        desk.source.ohm = ohm
        assert list(codes_of(scan(desk, "02"))) == [0]

    @pytest.mark.parametrize("refused", range(5))  # each chunk of a full scan, and the summary
    def test_a_frame_that_the_bus_refuses_costs_one_scan(self, changed, refused: int) -> None:
        """Receivers forget all codes at an incomplete scan, and the node knows that it was one."""
        desk = changed
        desk.write(0x2020, 3, 0, 2)  # no refresh
        assembler = ScanAssembler(desk.node.profile, counter_overflow=240)
        complete = []
        for counter in range(1, 7):
            desk.source.ohm = desk.source.ohm * np.where(np.arange(6) < 3, 0.999, 1.0)
            if counter == 3:
                desk.write(0x2020, 1, 1, 1)  # a full scan
                desk.sent = Refusing(refused)
            end_ns = desk.t_ns + PERIOD_MS * 1_000_000
            with contextlib.suppress(BusError):
                desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
            while desk.t_ns < end_ns:
                with contextlib.suppress(BusError):
                    desk.run((end_ns - desk.t_ns) * 1e-6)
            complete += assembled(assembler, desk)
        assert complete == [1, 2, 4, 5, 6]

    def test_skipped_scans_cost_no_more_than_themselves(self, changed) -> None:
        desk = changed
        desk.write(0x2020, 3, 0, 2)
        assembler = ScanAssembler(desk.node.profile, counter_overflow=240)
        complete = []
        for counter in range(1, 9):
            desk.source.ohm = desk.source.ohm * np.where(np.arange(6) < 3, 0.999, 1.0)
            desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
            desk.run(0 if counter in (3, 4) else PERIOD_MS)
            complete += assembled(assembler, desk)
        assert desk.node.overruns == 1
        assert complete == [1, 2, 3, 4, 6, 7, 8]

    def test_start_tare_and_mode_make_the_next_scan_full(self, changed) -> None:
        desk = changed
        counter = iter(range(1, 100))
        for act in (
            lambda: desk.frame(0, "80 00") + desk.frame(0, "01 00"),
            lambda: desk.write(0x2021, 4, 0x65726174, 4),
            lambda: desk.write(0x2020, 1, 1, 1),
            lambda: desk.write(0x2200, 1, 0x447A0000, 4),
        ):
            scan(desk, f"{next(counter):02x}")
            assert len(scan(desk, f"{next(counter):02x}")) == 1
            act()
            assert len(scan(desk, f"{next(counter):02x}")) == 5


class TestTare:
    def test_at_first_power_on(self, make: Callable, rest_ohm) -> None:
        desk = make()
        assert desk.source.reads > 1
        desk.start()
        assert {abs(code - REST) <= 1 for codes in codes_of(scan(desk, "")).values() for code in codes} == {
            True
        }

    def test_baseline_from_before_is_kept(self, make: Callable, rest_ohm) -> None:
        desk = make(baseline_ohm=rest_ohm * 2)
        assert desk.source.reads == 0
        desk.start()
        codes = codes_of(scan(desk, ""))
        assert abs(codes[0][0] - round(0.25 * STEPS)) <= 1

    @pytest.mark.parametrize("way", ["sdo", "pdo"])
    def test_on_command(self, operational, way: str) -> None:
        desk = operational
        desk.source.ohm = desk.source.ohm * 0.6
        if way == "sdo":
            assert desk.sdo("23 21 20 04 74 61 72 65") == "60 21 20 04 00 00 00 00"
            assert desk.read(0x2021, 4) == 0
        else:
            assert desk.frame(0x204, "74 61 72 65 00 00") == []
        frames = scan(desk, "01")
        assert all(abs(code - REST) <= 1 for codes in codes_of(frames).values() for code in codes)
        assert frames[-1][1][:5] == "01 28"  # BASELINE_CHANGED
        assert scan(desk, "02")[-1][1][:5] == "02 20"

    def test_open_wires_keep_the_baseline_they_have(self, operational, rest_ohm) -> None:
        desk = operational
        ohm = rest_ohm * 0.6
        ohm[0, 0] = np.inf
        ohm[0, 1] = 0.0
        desk.source.ohm = ohm
        desk.sdo("23 21 20 04 74 61 72 65")
        got = [_float(desk.read(0x2200, k)) for k in (1, 2, 3)]
        np.testing.assert_allclose(got, [rest_ohm[0, 0], rest_ohm[0, 1], 0.6 * rest_ohm[0, 2]], rtol=1e-6)

    def test_open_from_the_start_has_no_baseline(self, make: Callable) -> None:
        desk = make(ohm=np.full((2, 6), np.inf))
        assert desk.read(0x2200, 1) == 0

    def test_written_by_a_client(self, operational, rest_ohm) -> None:
        desk = operational
        (pattern,) = struct.unpack("<I", struct.pack("<f", rest_ohm[0, 0] * 2))
        desk.write(0x2200, 1, pattern, 4)
        frames = scan(desk, "01")
        assert abs(codes_of(frames)[0][0] - round(0.25 * STEPS)) <= 1
        assert frames[-1][1][:5] == "01 28"  # BASELINE_CHANGED

    def test_survives_a_power_cycle(self, operational, rest_ohm) -> None:
        desk = operational
        desk.source.ohm = rest_ohm * 0.6
        desk.node.power_off()
        desk.power_on()
        assert abs(_float(desk.read(0x2200, 1)) / rest_ohm[0, 0] - 1) < 1e-6

    def test_only_on_command(self, operational, rest_ohm) -> None:
        desk = operational
        desk.source.ohm = rest_ohm * 0.6
        desk.write(0x2021, 2, 1, 1)
        desk.write(0x2021, 4, 0, 4)
        desk.frame(0x204, "00 00 00 00 00 00")
        assert abs(_float(desk.read(0x2200, 1)) / rest_ohm[0, 0] - 1) < 1e-6


def test_averaging_reads_more_often(operational) -> None:
    desk = operational
    reads = desk.source.reads
    scan(desk, "01")
    assert desk.source.reads == reads + 1
    desk.write(0x2021, 2, 8, 1)
    codes = codes_of(scan(desk, "02"))
    assert desk.source.reads == reads + 9
    assert abs(codes[0][0] - REST) <= 1


class TestOwnTimer:
    def test_scans_without_sync(self, desk) -> None:
        desk.write(0x1801, 2, 254, 1)
        desk.write(0x2021, 1, 20, 2)
        desk.start()
        desk.run(105)
        frames = desk.take()
        assert [int(data[:2], 16) for can_id, data in frames if can_id == SUMMARY] == [0, 1, 2, 3, 4]
        assert desk.frame(0x80) == []  # SYNC no longer starts scans
        desk.frame(0, "80 00")
        desk.run(100)
        assert desk.take() == []

    def test_summary_waits_for_a_sync_if_it_is_synchronous(self, desk) -> None:
        desk.write(0x2021, 1, 20, 2)
        desk.start()
        desk.run(30)
        assert [can_id for can_id, _ in desk.take()] == [CHUNK] * 4
        frames = desk.frame(0x80)
        assert [can_id for can_id, _ in frames] == [SUMMARY]
        assert desk.frame(0x80) == []


class TestSingleScan:
    def test_by_pdo(self, desk) -> None:
        desk.write(0x1801, 2, 255, 1)
        desk.start()
        desk.node.on_frame(0x204, bytes.fromhex("000000000100"), desk.t_ns)
        desk.run(10)
        assert [can_id for can_id, _ in desk.take()] == [CHUNK] * 4 + [SUMMARY]

    @pytest.mark.parametrize("ms", [10, 1])  # the SYNC comes after the chunks, or between them
    def test_its_synchronous_summary_is_sent_before_the_scan_of_the_next_sync(self, desk, ms: int) -> None:
        desk.start()
        desk.node.on_frame(0x204, bytes.fromhex("000000000100"), desk.t_ns)
        desk.run(ms)
        frames = desk.take() + scan(desk, "")
        assert [can_id for can_id, _ in frames] == ([CHUNK] * 4 + [SUMMARY]) * 2
        assert [data[:2] for can_id, data in frames if can_id == SUMMARY] == ["00", "01"]

    def test_is_refused_where_sync_numbers_the_scans(self, operational) -> None:
        assert operational.sdo("2f 21 20 05 01 00 00 00").endswith("22 00 00 08")
        assert operational.frame(0x204, "00 00 00 00 01 00") == []


class TestCommandPdo:
    def test_sets_the_mode(self, operational) -> None:
        operational.frame(0x204, "00 00 00 00 00 01")
        assert operational.read(0x2020, 1) == 1

    def test_value_out_of_range_is_refused_and_harms_nothing(self, operational) -> None:
        assert operational.frame(0x204, "00 00 00 00 00 07") == []
        assert operational.read(0x2020, 1) == 0

    def test_a_scan_that_the_bus_refuses_does_not_cost_the_mode(self, desk) -> None:
        desk.start()
        desk.bus_refuses = True
        with pytest.raises(BusError):  # the caller learns of it
            desk.node.on_frame(0x204, bytes.fromhex("00 00 00 00 01 01"), desk.t_ns)
        desk.bus_refuses = False
        assert desk.read(0x2020, 1) == 1

    def test_too_short_is_told_until_it_is_right(self, operational) -> None:
        desk = operational
        assert desk.frame(0x204, "74 61 72 65 00") == [(EMCY, "10 82 11 01 05 06 00 00")]
        assert desk.read(0x1001, 0) == 0x11
        assert desk.frame(0x204, "00 00 00 00 00 00") == [(EMCY, "00 00 00 10 82 00 00 00")]

    def test_too_long_is_processed_and_told(self, operational) -> None:
        desk = operational
        told = ["20 82 11 01 08 06 00 00", "00 00 00 20 82 00 00 00"]
        assert desk.frame(0x204, "00 00 00 00 00 01 ff ff") == [(EMCY, data) for data in told]
        assert desk.read(0x2020, 1) == 1

    def test_is_ignored_outside_operational(self, desk) -> None:
        assert desk.frame(0x204, "00 00 00 00 00 01") == []
        assert desk.read(0x2020, 1) == 0

    def test_synchronous_takes_effect_at_the_next_sync(self, operational) -> None:
        desk = operational
        desk.write(0x1400, 2, 1, 1)
        desk.frame(0x204, "00 00 00 00 00 01")
        assert desk.read(0x2020, 1) == 0
        desk.frame(0x80, "01")
        assert desk.read(0x2020, 1) == 1

    def test_moved_and_disabled(self, operational) -> None:
        desk = operational
        desk.write(0x1400, 1, 0x80000204, 4)
        assert desk.frame(0x204, "00") == []
        desk.write(0x1400, 1, 0x00000333, 4)
        assert desk.frame(0x204, "00") == []
        assert len(desk.frame(0x333, "00")) == 1


class TestValuePdo:
    """TPDO2 made to carry plain values: the engine obeys its parameters."""

    @pytest.fixture
    def values(self, operational):
        def make(**parameters: int):
            desk = operational
            desk.write(0x1801, 1, 0x80000284, 4)
            desk.write(0x1A01, 0, 0, 1)
            desk.write(0x1A01, 1, 0x10010008, 4)
            desk.write(0x1A01, 2, 0x20110108, 4)
            desk.write(0x1A01, 0, 2, 1)
            for name, (subindex, size) in {
                "kind": (2, 1),
                "inhibit": (3, 2),
                "timer": (5, 2),
                "start": (6, 1),
            }.items():
                if name in parameters:
                    desk.write(0x1801, subindex, parameters[name], size)
            desk.write(0x1801, 1, 0x284, 4)
            desk.take()
            return desk

        return make

    @pytest.mark.parametrize(
        ("kind", "at"), [(1, [1, 2, 3, 4, 5, 6, 7]), (2, [2, 4, 6]), (3, [3, 6]), (240, [])]
    )
    def test_every_nth_sync(self, values, kind: int, at: list[int]) -> None:
        desk = values(kind=kind)
        sent = [n for n in range(1, 8) if any(c == SUMMARY for c, _ in desk.frame(0x80, f"{n:02x}"))]
        assert sent == at

    def test_sync_start_value(self, values) -> None:
        desk = values(kind=2, start=4)
        sent = [n for n in range(1, 10) if any(c == SUMMARY for c, _ in desk.frame(0x80, f"{n:02x}"))]
        assert sent == [4, 6, 8]

    def test_acyclic_is_sent_at_sync_when_it_changed(self, values) -> None:
        desk = values(kind=0)
        desk.write(0x1800, 1, 0x80000184, 4)  # scans of no chunks end at once
        frames = [[d for c, d in scan(desk, f"{n:02x}", 5) if c == SUMMARY] for n in (1, 2, 3)]
        assert frames == [["00 01"], ["00 02"], ["00 03"]]  # what was sampled at this SYNC
        desk.write(0x2021, 1, 60_000, 2)  # no scans any more, so nothing changes
        frames = [[d for c, d in scan(desk, f"{n:02x}", 5) if c == SUMMARY] for n in (4, 5, 6)]
        assert frames == [[], [], []]

    def test_event_timer(self, values) -> None:
        desk = values(kind=255, timer=10)
        start_ns = desk.t_ns
        desk.run(35)
        times = [t_ns - start_ns for c, _, t_ns in desk.sent if c == SUMMARY]
        assert times == [10_000_000, 20_000_000, 30_000_000]
        desk.write(0x1801, 5, 0, 2)
        desk.take()
        desk.run(100)
        assert desk.take() == []

    def test_sent_at_the_end_of_a_scan_by_event(self, values) -> None:
        desk = values(kind=254)
        frames = scan(desk, "09")
        assert [can_id for can_id, _ in frames] == [CHUNK] * 4 + [SUMMARY]
        assert frames[-1][1] == "00 09"

    def test_inhibit_time_holds_events_back(self, values) -> None:
        desk = values(kind=254, inhibit=300, timer=10)  # 30 ms against 10 ms
        desk.run(100)
        times = [t_ns for c, _, t_ns in desk.sent if c == SUMMARY]
        assert len(times) >= 3
        assert np.diff(times).min() >= 30_000_000

    def test_nothing_is_sent_outside_operational(self, values) -> None:
        desk = values(kind=255, timer=10)
        desk.frame(0, "02 00")
        desk.run(100)
        assert desk.take() == []


def test_remapped_chunks_carry_what_is_mapped(operational) -> None:
    desk = operational
    desk.write(0x1800, 1, 0x80000184, 4)
    desk.write(0x1A00, 0, 0, 1)
    for slot, entry in enumerate((0x20100108, 0x20100310, 0x10010008), 1):
        desk.write(0x1A00, slot, entry, 4)
    desk.write(0x1A00, 0, 3, 1)
    desk.write(0x1800, 1, 0x3C4, 4)
    frames = [data for can_id, data in scan(desk, "01") if can_id == 0x3C4]
    assert [data[:2] for data in frames] == ["00", "01", "02", "03"]
    for data in frames:
        _, code, register = struct.unpack("<BHB", bytes.fromhex(data))
        assert abs(code - REST) <= 1
        assert register == 0


def test_sync_on_another_identifier(operational) -> None:
    desk = operational
    desk.write(0x1005, 0, 0x90, 4)
    assert desk.frame(0x80, "01") == []
    assert len(desk.frame(0x90, "01")) == 1


def test_full_size_patch_sends_what_the_codec_makes_of_its_resistances(make: Callable) -> None:
    layout = PatchLayout.preset("staggered")
    rest = resistance_ohm(layout, layout.upper_m)
    desk = make(layout, baseline_ohm=rest)
    desk.start()
    random = np.random.default_rng(5)
    desk.source.ohm = rest * random.uniform(0.3, 1.2, rest.shape)
    frames = scan(desk, "")
    assert len(frames) == 101
    got = np.array([code for codes in codes_of(frames).values() for code in codes]).reshape(10, 30)
    np.testing.assert_array_equal(got, encode(desk.source.ohm, rest, CodeScale()))


def _float(pattern: int) -> float:
    (value,) = struct.unpack("<f", pattern.to_bytes(4, "little"))
    return value


class TestCanFd:
    """PDO over CAN FD: a frame is a part of one upper wire."""

    @pytest.fixture
    def fd(self, make: Callable, layout: PatchLayout):
        profile = PatchProfile.from_layout(layout, 16, "fd")
        desk = make(profile=profile, pacing=Pacing(slack_ns=0, catch_up_ns=0))
        desk.start()
        return desk

    def test_a_wire_is_a_frame(self, fd, rest_ohm) -> None:
        fd.source.ohm = rest_ohm * np.linspace(0.5, 1.0, 12).reshape(2, 6)
        frames = scan(fd, "")
        assert [can_id for can_id, _ in frames] == [CHUNK, CHUNK, SUMMARY]
        for wire, (_, data) in enumerate(frames[:2]):
            raw = bytes.fromhex(data)
            assert len(raw) == 16  # 4 + 12 bytes, a length that CAN FD has
            assert struct.unpack_from("<BBH", raw) == (wire, 0, 0)
            ratio = np.linspace(0.5, 1.0, 12)[6 * wire : 6 * wire + 6]
            got = np.array(struct.unpack_from("<6H", raw, 4))
            assert np.abs(got - np.rint((ratio - 0.25) * STEPS)).max() <= 1
        assert fd.read(0x2010, 1) == 1  # the last wire
        assert fd.read(0x2010, 3) == 0  # its first column
        assert fd.read(0x2010, 9) == fd.read(0x2101, 6)
        assert fd.read(0x2011, 3) == 2

    def test_only_wires_that_changed(self, fd, rest_ohm) -> None:
        fd.write(0x2020, 1, 1, 1)
        assert len(scan(fd, "")) == 3
        fd.source.ohm = rest_ohm.copy()
        fd.source.ohm[1, 2] *= 0.9
        frames = scan(fd, "")
        assert [data[:11] for _, data in frames] == ["01 01 00 00", "01 21 01 00"]

    def test_up_to_64_bytes_are_mapped(self, fd) -> None:
        fd.write(0x1801, 1, 0x80000284, 4)
        fd.write(0x1A01, 0, 0, 1)
        for slot in range(1, 65):
            fd.write(0x1A01, slot, 0x10010008, 4)
        fd.write(0x1A01, 0, 64, 1)
        fd.write(0x1801, 1, 0x284, 4)
        fd.take()
        (frame,) = [data for can_id, data in scan(fd, "") if can_id == SUMMARY]
        assert bytes.fromhex(frame) == bytes(64)
        fd.write(0x1801, 1, 0x80000284, 4)
        fd.write(0x1A01, 0, 0, 1)
        fd.write(0x1A01, 64, 0x20110310, 4)  # one more byte
        assert fd.sdo("2f 01 1a 00 40 00 00 00").endswith("42 00 04 06")

    def test_frames_of_every_length_do_no_harm(self, fd) -> None:
        lengths = (0, 1, 2, 7, 8, 12, 16, 20, 24, 32, 48, 64)
        for length in lengths:
            for can_id in range(0x800):
                fd.node.on_frame(can_id, bytes(length), fd.t_ns)
        fd.run(1000)
        fd.frame(0, "01 00")
        assert [can_id for can_id, _ in scan(fd, "")][-3:] == [CHUNK, CHUNK, SUMMARY]
