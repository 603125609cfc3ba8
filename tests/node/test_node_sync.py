"""SYNC, consumed and produced: raw bytes and times of CiA 301 v4.2, 7.2.5, 7.5.2.5 to 7.5.2.7, 7.5.2.22."""

from __future__ import annotations

import pytest

from skinnode.node import VolatileMemory
from skinnode.protocol.summary import SummaryFlag

SYNC, PDO = 0x080, 0x384
PRODUCE = 0x4000_0080


@pytest.fixture
def producer(desk):
    """A node that may be told to produce SYNC."""

    def make(period_us: int = 10_000, overflow: int = 0):
        desk.write(0x1019, 0, overflow, 1)
        desk.write(0x1006, 0, period_us, 4)
        desk.write(0x1005, 0, PRODUCE, 4)
        desk.take()
        return desk

    return make


def syncs(desk) -> list[tuple[int, bytes]]:
    return [(can_id, data) for can_id, data, _ in desk.sent if can_id == SYNC]


class TestProducer:
    def test_first_after_one_period_then_on_the_beat(self, producer) -> None:
        desk = producer(2_500)
        start_ns = desk.t_ns
        desk.run(11)
        assert desk.times(SYNC, start_ns) == [2.5, 5, 7.5, 10]
        assert {data for _, data in syncs(desk)} == {b""}

    def test_counter_runs_from_1_to_the_overflow_value(self, producer) -> None:
        desk = producer(1_000, overflow=5)
        desk.run(12)
        assert [data[0] for _, data in syncs(desk)] == [1, 2, 3, 4, 5, 1, 2, 3, 4, 5, 1, 2]

    def test_served_late_keeps_the_beat_and_makes_nothing_up(self, producer) -> None:
        desk = producer(10_000)
        start_ns = desk.t_ns
        for late_us in (13_000, 20_001, 57_300):
            desk.t_ns = start_ns + late_us * 1_000
            desk.node.on_timer(desk.t_ns)
        desk.run(15)
        assert desk.times(SYNC, start_ns) == [13, 20.001, 57.3, 60, 70]

    def test_no_drift_in_an_hour(self, producer) -> None:
        desk = producer(1_000_000)
        start_ns = desk.t_ns
        for _ in range(3600):
            desk.t_ns = desk.node.next_deadline_ns() + 123_457
            desk.node.on_timer(desk.t_ns)
        assert desk.node.next_deadline_ns() == start_ns + 3601 * 1_000_000_000
        assert len(syncs(desk)) == 3600

    def test_in_pre_operational_and_operational_only(self, producer) -> None:
        desk = producer(10_000, overflow=240)
        counters = []
        for command in ("01", "80", "02", "80", "02", "01"):
            desk.frame(0, f"{command} 00")
            desk.run(25)
            counters.append([data[0] for _, data in syncs(desk)])
            desk.take()
        # From STOPPED on it counts from 1 again.
        assert counters == [[1, 2], [3, 4, 5], [], [1, 2], [], [1, 2]]

    def test_obeys_its_own_sync(self, producer) -> None:
        desk = producer(20_000, overflow=10)
        desk.configure_pdo(0x1802, 0x1001_0008, 0x2011_0108, cob_id=PDO, kind=2, start=2)
        desk.write(0x1800, 1, 0x80000184, 4)
        desk.start()
        desk.take()
        desk.run(85)
        frames = [(can_id, data[-1]) for can_id, data, _ in desk.sent if can_id in (SYNC, PDO)]
        assert frames == [(SYNC, 1), (SYNC, 2), (PDO, 2), (SYNC, 3), (SYNC, 4), (PDO, 4)]
        summaries = [data[0] for can_id, data, _ in desk.sent if can_id == 0x284]
        assert summaries == [1, 2, 3, 4]  # the scans carry the numbers of its SYNC

    def test_starts_with_the_period_too(self, desk) -> None:
        desk.write(0x1005, 0, PRODUCE, 4)
        desk.run(100)
        assert syncs(desk) == []
        desk.write(0x1006, 0, 30_000, 4)
        start_ns = desk.t_ns
        desk.run(70)
        assert desk.times(SYNC, start_ns) == [30, 60]

    def test_a_new_period_counts_on(self, producer) -> None:
        desk = producer(10_000, overflow=240)
        desk.run(25)
        counters = [data[0] for _, data in syncs(desk)]
        desk.write(0x1006, 0, 4_000, 4)
        desk.run(9)
        assert counters + [data[0] for _, data in syncs(desk)] == [1, 2, 3, 4]

    @pytest.mark.parametrize(("index", "value"), [(0x1005, SYNC), (0x1006, 0)])
    def test_ends(self, producer, index: int, value: int) -> None:
        desk = producer(10_000, overflow=240)
        desk.run(25)
        desk.write(index, 0, value, 4)
        desk.run(100)
        assert syncs(desk) == []
        desk.write(0x1006, 0, 10_000, 4)
        desk.write(0x1005, 0, PRODUCE, 4)
        desk.run(10)
        assert syncs(desk) == [(SYNC, b"\x01")]  # a new start

    def test_reset_communication_ends_it(self, producer) -> None:
        desk = producer()
        desk.frame(0, "82 00")
        desk.run(100)
        assert desk.take() == []

    def test_on_another_identifier(self, desk) -> None:
        desk.write(0x1006, 0, 10_000, 4)
        desk.write(0x1005, 0, 0x4000_00A0, 4)
        desk.run(10)
        assert desk.take() == [(0x0A0, "")]


class TestObjects:
    def test_identifier_may_not_change_while_it_is_produced(self, producer) -> None:
        desk = producer()
        assert desk.sdo("23 05 10 00 81 00 00 40") == "80 05 10 00 30 00 09 06"
        desk.write(0x1005, 0, 0x81, 4)  # no producer any more: that may be

    @pytest.mark.parametrize("value", [0x8000_0101, 0x2000_0080, 0x880, 0x000, 0x101, 0x4000_0601, 0x704])
    def test_identifiers_refused(self, desk, value: int) -> None:
        answer = desk.sdo((b"\x23\x05\x10\x00" + value.to_bytes(4, "little")).hex())
        assert answer == "80 05 10 00 30 00 09 06"

    @pytest.mark.parametrize("value", [0x8000_0080, 0xC000_0080, 0x8000_00A0])
    def test_bit_31_means_nothing(self, desk, value: int) -> None:
        """Not "invalid", as in other COB-IDs: old tools set it for a consumer (CiA 301 v4.2, 7.5.2.5)."""
        desk.write(0x1006, 0, 10_000, 4)
        desk.write(0x1005, 0, value, 4)
        assert desk.read(0x1005, 0) == value
        desk.run(10)
        assert syncs(desk) == ([(SYNC, b"")] if value >> 30 & 1 else [])

    @pytest.mark.parametrize(
        ("value", "code"), [(1, "30 00 09 06"), (241, "31 00 09 06"), (255, "31 00 09 06")]
    )
    def test_overflow_values_refused(self, desk, value: int, code: str) -> None:
        assert desk.sdo(f"2f 19 10 00 {value:02x} 00 00 00") == f"80 19 10 00 {code}"

    def test_overflow_only_without_a_period(self, desk) -> None:
        desk.write(0x1006, 0, 10_000, 4)
        assert desk.sdo("2f 19 10 00 0a 00 00 00") == "80 19 10 00 22 00 00 08"
        desk.write(0x1006, 0, 0, 4)
        for value in (2, 240, 0):
            desk.write(0x1019, 0, value, 1)
            assert desk.read(0x1019, 0) == value

    @pytest.mark.parametrize("value", [1, 99])
    def test_period_too_short(self, desk, value: int) -> None:
        assert desk.sdo(f"23 06 10 00 {value:02x} 00 00 00") == "80 06 10 00 32 00 09 06"
        desk.write(0x1006, 0, 100, 4)


class TestConsumer:
    @pytest.fixture
    def cyclic(self, operational):
        operational.write(0x1800, 1, 0x80000184, 4)
        operational.write(0x1801, 1, 0x80000284, 4)
        operational.configure_pdo(0x1802, 0x1001_0008, cob_id=PDO, kind=1)
        return operational

    def test_moved(self, cyclic) -> None:
        cyclic.write(0x1005, 0, 0x0A0, 4)
        assert cyclic.frame(SYNC, "01") == []
        assert cyclic.frame(0x0A0, "02") == [(PDO, "00")]

    @pytest.mark.parametrize("data", ["", "01 02", "00 " * 8])
    def test_of_the_wrong_length_does_nothing(self, cyclic, data: str) -> None:
        frames = cyclic.frame(SYNC, data)
        assert [(can_id, data[:8]) for can_id, data in frames] == [(0x084, "40 82 11"), (0x084, "00 00 00")]
        assert cyclic.frame(SYNC, data) == []  # told once

    def test_a_remote_frame_is_no_sync(self, cyclic) -> None:
        assert cyclic.frame(SYNC, remote=True) == []


class TestWindow:
    """0x1007, µs after the SYNC (CiA 301 v4.2, 7.5.2.7): synchronous PDOs travel within it or not at all."""

    LATE = (0x084, "00 82 11 02 00 00 00 00")
    IN_TIME_AGAIN = (0x084, "00 00 00 00 82 00 00 00")

    @pytest.fixture
    def windowed(self, operational):
        """Scans of four chunks, 0.5 ms apart: the synchronous summary follows 1.5 ms after SYNC."""
        operational.write(0x1007, 0, 1000, 4)
        return operational

    def summaries(self, desk) -> list[str]:
        return [data for can_id, data in desk.take() if can_id == 0x284]

    def test_there_is_none_by_default(self, operational) -> None:
        assert operational.read(0x1007, 0) == 0
        operational.node.on_frame(SYNC, b"\x01", operational.t_ns)
        operational.run(10)
        assert len(self.summaries(operational)) == 1

    def test_a_tpdo_that_is_late_is_discarded_and_told_once(self, windowed) -> None:
        desk = windowed
        frames = desk.frame(SYNC, "01")
        desk.run(10)
        frames += desk.take()
        assert [can_id for can_id, _ in frames] == [0x184] * 4 + [0x084]  # event-driven chunks know no window
        assert frames[-1] == self.LATE
        assert desk.read(0x1001, 0) == 0x11
        desk.frame(SYNC, "02")
        desk.run(10)
        assert {can_id for can_id, _ in desk.take()} == {0x184}
        desk.write(0x1007, 0, 1500, 4)
        desk.frame(SYNC, "03")
        desk.run(10)
        frames = desk.take()
        assert next(frame for frame in frames if frame[0] != 0x184) == self.IN_TIME_AGAIN
        assert frames[-1] == (0x284, frames[-1][1])
        assert frames[-1][1][:2] == "03"
        assert desk.read(0x1001, 0) == 0

    def test_synchronous_chunks_end_with_it_and_the_summary_says_so(self, windowed) -> None:
        desk = windowed
        desk.write(0x1800, 1, 0x80000184, 4)
        desk.write(0x1800, 2, 1, 1)
        desk.write(0x1800, 1, 0x184, 4)
        desk.write(0x1801, 1, 0x80000284, 4)
        desk.write(0x1801, 2, 254, 1)
        desk.write(0x1801, 1, 0x284, 4)
        frames = desk.frame(SYNC, "01")
        desk.run(10)
        frames += desk.take()
        assert [can_id for can_id, _ in frames] == [0x184] * 3 + [0x084, 0x284]  # at 0, 0.5 and 1 ms
        summary = bytes.fromhex(frames[-1][1])
        assert (SummaryFlag.OVERRUN in SummaryFlag(summary[1]), summary[2]) == (True, 3)

    def test_leaving_operational_ends_the_error(self, windowed) -> None:
        windowed.node.on_frame(SYNC, b"\x01", windowed.t_ns)
        windowed.run(10)
        windowed.take()
        assert windowed.frame(0, "80 00") == [self.IN_TIME_AGAIN]

    def test_an_rpdo_that_is_late_is_discarded_until_the_next_sync(self, windowed) -> None:
        desk = windowed
        desk.configure_pdo(0x1400, 0x2020_0108, cob_id=0x204, kind=1)

        def mode_after(*, late_by_ms: float, mode: int) -> int:
            desk.frame(SYNC, "01")
            desk.run(late_by_ms)
            desk.frame(0x204, f"{mode:02x}")
            desk.run(20)
            desk.frame(SYNC, "02")
            desk.run(20)
            return desk.read(0x2020, 1)

        desk.frame(0x204, "01")  # before the first SYNC none is late
        desk.frame(SYNC, "01")
        desk.run(20)
        assert desk.read(0x2020, 1) == 1
        assert mode_after(late_by_ms=1.1, mode=0) == 1
        assert mode_after(late_by_ms=0.9, mode=0) == 0

    def test_it_is_stored_and_restored(self, make) -> None:
        desk = make(memory=VolatileMemory())
        desk.write(0x1007, 0, 5000, 4)
        desk.write(0x1010, 2, 0x65766173, 4)
        desk.frame(0, "81 00")
        assert desk.read(0x1007, 0) == 5000
        desk.write(0x1011, 2, 0x64616F6C, 4)
        desk.frame(0, "81 00")
        assert desk.read(0x1007, 0) == 0
