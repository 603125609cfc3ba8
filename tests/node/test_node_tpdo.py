"""TPDOs of every transmission type: raw bytes and times of CiA 301 v4.2, 7.2.2 and 7.5.2.37."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable

import pytest

from skinnode.protocol.profile import PatchProfile

PDO = 0x384  # TPDO3, spare from the start
COUNTER = 0x2011_0108  # scan counter of the summary, a byte that changes with every scan
REGISTER = 0x1001_0008
FIRST_CODE = 0x2100_0110
MODE = 0x2020_0108
MANY = PatchProfile(2, 6, 2, 2, rpdos=512, tpdos=512)


@pytest.fixture
def tpdo3(operational):
    """An OPERATIONAL node with nothing but TPDO3: error register and scan counter, told as asked for."""
    operational.write(0x1800, 1, 0x80000184, 4)  # scans without chunks end at once
    operational.write(0x1801, 1, 0x80000284, 4)

    def make(*entries: int, cob_id: int = PDO, **values: int):
        operational.configure_pdo(0x1802, *(entries or (REGISTER, COUNTER)), cob_id=cob_id, **values)
        return operational

    return make


def sync(desk, counter: int) -> list[tuple[int, str]]:
    return desk.frame(0x80, f"{counter:02x}")


class TestSynchronous:
    @pytest.mark.parametrize(
        ("kind", "at"),
        [(1, [1, 2, 3, 4, 5, 6, 7]), (2, [2, 4, 6]), (3, [3, 6]), (7, [7]), (240, [])],
    )
    def test_cyclic(self, tpdo3, kind: int, at: list[int]) -> None:
        desk = tpdo3(kind=kind)
        assert [n for n in range(1, 8) if sync(desk, n)] == at

    def test_240_is_every_240th(self, tpdo3) -> None:
        desk = tpdo3(kind=240)
        assert [n for n in range(500) if sync(desk, n % 240 + 1)] == [239, 479]

    def test_carries_what_was_sampled_at_this_very_sync(self, tpdo3) -> None:
        desk = tpdo3(kind=1)
        assert sync(desk, 0x17) == [(PDO, "00 17")]

    def test_acyclic_only_after_a_change(self, tpdo3) -> None:
        desk = tpdo3(REGISTER, kind=0)
        assert [sync(desk, n) for n in (1, 2)] == [[(PDO, "00")], []]
        desk.frame(0x204, "00")  # an RPDO too short: an error that lasts
        assert desk.take() == []
        assert [sync(desk, n) for n in (3, 4)] == [[(PDO, "11")], []]

    @pytest.mark.parametrize(
        ("start", "kind", "at"), [(5, 3, [5, 8, 11]), (2, 1, [2, 3, 4, 5]), (1, 4, [1, 5])]
    )
    def test_start_value(self, tpdo3, start: int, kind: int, at: list[int]) -> None:
        desk = tpdo3(kind=kind, start=start)
        assert [n for n in range(1, at[-1] + 1) if sync(desk, n)] == at

    def test_start_value_is_nothing_without_a_counter(self, desk) -> None:
        desk.configure_pdo(0x1802, REGISTER, cob_id=PDO, kind=2, start=7)
        desk.write(0x1800, 1, 0x80000184, 4)
        desk.write(0x1801, 1, 0x80000284, 4)
        desk.start()
        assert [desk.frame(0x80) for _ in range(4)] == [[], [(PDO, "00")], [], [(PDO, "00")]]

    def test_counting_begins_anew_with_operational(self, tpdo3) -> None:
        desk = tpdo3(kind=3)
        sync(desk, 1)
        sync(desk, 2)
        desk.frame(0, "80 00")
        assert sync(desk, 3) == []
        desk.start()
        assert [n for n in range(4, 8) if sync(desk, n)] == [6]

    def test_a_new_type_counts_anew(self, tpdo3) -> None:
        desk = tpdo3(kind=3)
        sync(desk, 1)
        sync(desk, 2)
        desk.write(0x1802, 2, 2, 1)
        assert [n for n in range(3, 7) if sync(desk, n)] == [4, 6]

    def test_all_in_the_order_of_their_numbers(self, tpdo3) -> None:
        desk = tpdo3(kind=1)
        desk.configure_pdo(0x1803, REGISTER, cob_id=0x1F0, kind=1)
        desk.configure_pdo(0x1801, FIRST_CODE, cob_id=0x284, kind=2)
        assert [can_id for can_id, _ in sync(desk, 1)] == [PDO, 0x1F0]
        assert [can_id for can_id, _ in sync(desk, 2)] == [0x284, PDO, 0x1F0]


class TestEventDriven:
    @pytest.mark.parametrize("kind", [254, 255])
    def test_event_timer(self, tpdo3, kind: int) -> None:
        desk = tpdo3(kind=kind, timer=25)
        start_ns = desk.t_ns
        desk.run(100)
        assert desk.times(PDO, start_ns) == [25, 50, 75, 100]

    def test_event_timer_served_late_keeps_its_beat_without_bursts(self, tpdo3) -> None:
        desk = tpdo3(kind=254, timer=10)
        start_ns = desk.t_ns
        for late_ms in (13, 20, 57):
            desk.t_ns = start_ns + late_ms * 1_000_000
            desk.node.on_timer(desk.t_ns)
        desk.run(10)
        assert desk.times(PDO, start_ns) == [13, 20, 57, 67]

    def test_an_event_starts_the_timer_anew(self, tpdo3) -> None:
        desk = tpdo3(kind=255, timer=20)
        start_ns = desk.t_ns
        desk.run(15)
        desk.node.on_frame(0x80, b"\x01", desk.t_ns)  # a scan: the event
        desk.run(30)
        assert desk.times(PDO, start_ns) == [15, 35]

    def test_every_scan_is_an_event(self, tpdo3) -> None:
        desk = tpdo3(kind=254)
        assert [sync(desk, n) for n in (1, 2, 3)] == [[(PDO, "00 01")], [(PDO, "00 02")], [(PDO, "00 03")]]

    def test_inhibit_time(self, tpdo3) -> None:
        """Events within it are one frame at its end, with the values of then."""
        desk = tpdo3(kind=254, inhibit=300)
        start_ns = desk.t_ns
        for n in range(1, 8):
            desk.node.on_frame(0x80, bytes((n,)), desk.t_ns)
            desk.run(10)
        assert desk.times(PDO, start_ns) == [0, 30, 60]
        assert [data[1] for can_id, data, _ in desk.sent if can_id == PDO] == [1, 3, 6]

    @pytest.mark.parametrize(("inhibit", "at_ms"), [(0, 10), (200, 20)])
    def test_inhibit_time_that_is_shortened_is_over_sooner(self, tpdo3, inhibit: int, at_ms: int) -> None:
        desk = tpdo3(kind=254, inhibit=0xFFFF)  # 6.5 s
        start_ns = desk.t_ns
        sync(desk, 1)
        desk.write(0x1802, 1, 0x80000000 | PDO, 4)
        desk.write(0x1802, 3, inhibit, 2)
        desk.write(0x1802, 1, PDO, 4)
        desk.run(10)
        desk.take()
        desk.node.on_frame(0x80, b"\x02", desk.t_ns)
        desk.run(100)
        assert desk.times(PDO, start_ns) == [at_ms]

    def test_inhibit_time_from_before_a_reset_is_over(self, operational) -> None:
        desk = operational
        desk.write(0x1800, 1, 0x80000184, 4)
        desk.write(0x1800, 3, 0xFFFF, 2)
        desk.write(0x1800, 1, 0x184, 4)
        assert sync(desk, 1)[0][0] == 0x184
        desk.frame(0, "82 04")
        desk.start()
        desk.node.on_frame(0x80, b"", desk.t_ns)
        desk.run(80)
        assert [can_id for can_id, _ in desk.take()] == [0x184] * 4 + [0x284]

    def test_inhibit_time_is_nothing_to_a_synchronous_one(self, tpdo3) -> None:
        desk = tpdo3(kind=1, inhibit=10_000)
        assert [sync(desk, n) for n in (1, 2)] == [[(PDO, "00 01")], [(PDO, "00 02")]]

    def test_event_timer_is_nothing_to_a_synchronous_one(self, tpdo3) -> None:
        desk = tpdo3(kind=1, timer=10)
        desk.run(100)
        assert desk.take() == []

    def test_switched_off_while_held_back_forgets_the_event(self, tpdo3) -> None:
        desk = tpdo3(kind=254, inhibit=300)
        sync(desk, 1)
        sync(desk, 2)
        desk.write(0x1802, 1, 0x80000000 | PDO, 4)
        desk.write(0x1802, 1, PDO, 4)
        desk.take()
        desk.run(100)
        assert desk.take() == []

    def test_set_while_running(self, tpdo3) -> None:
        desk = tpdo3(kind=254)
        for timer_ms, at in ((40, [40]), (10, [10, 20, 30, 40, 50]), (0, [])):
            desk.write(0x1802, 5, timer_ms, 2)
            start_ns = desk.t_ns
            desk.run(55)
            assert desk.times(PDO, start_ns) == at


class TestRemoteRequest:
    def ask(self, desk, cob_id: int = PDO) -> list[tuple[int, str]]:
        return desk.frame(cob_id, remote=True)

    def test_253_samples_when_asked(self, tpdo3) -> None:
        desk = tpdo3(kind=253)
        assert self.ask(desk) == [(PDO, "00 00")]
        assert sync(desk, 9) == []
        assert self.ask(desk) == [(PDO, "00 09")]
        desk.run(100)
        assert desk.take() == []

    def test_252_samples_at_sync(self, tpdo3) -> None:
        desk = tpdo3(REGISTER, kind=252)
        assert self.ask(desk) == []  # nothing has been sampled yet
        assert sync(desk, 1) == []
        assert self.ask(desk) == [(PDO, "00")]
        desk.frame(0x204, "00")
        desk.take()
        assert self.ask(desk) == [(PDO, "00")]  # the error came after the SYNC
        assert sync(desk, 2) == []
        assert self.ask(desk) == [(PDO, "11")]
        assert self.ask(desk) == [(PDO, "11")]

    @pytest.mark.parametrize("kind", [254, 255])
    def test_event_driven_ones_answer_within_the_inhibit_time(self, tpdo3, kind: int) -> None:
        desk = tpdo3(kind=kind, inhibit=100)
        start_ns = desk.t_ns
        for _ in range(3):
            desk.node.on_frame(PDO, b"", desk.t_ns, True)
            desk.run(1)
        desk.run(50)
        assert desk.times(PDO, start_ns) == [0, 10]

    @pytest.mark.parametrize("kind", [0, 1, 240])
    def test_synchronous_ones_do_not_answer(self, tpdo3, kind: int) -> None:
        desk = tpdo3(kind=kind)
        sync(desk, 1)
        assert self.ask(desk) == []

    @pytest.mark.parametrize("kind", [252, 253, 254, 255])
    def test_not_allowed_by_bit_30(self, tpdo3, kind: int) -> None:
        desk = tpdo3(kind=kind, cob_id=0x4000_0000 | PDO)
        sync(desk, 1)
        assert self.ask(desk) == []
        desk.write(0x1802, 1, 0x8000_0000 | PDO, 4)
        desk.write(0x1802, 1, PDO, 4)
        sync(desk, 2)
        assert self.ask(desk) == [(PDO, "00 02")]

    @pytest.mark.parametrize("state", ["80 00", "02 00"])
    def test_not_outside_operational(self, tpdo3, state: str) -> None:
        desk = tpdo3(kind=253)
        desk.frame(0, state)
        assert self.ask(desk) == []

    @pytest.mark.parametrize("cob_id", [0x080, 0x184, 0x204, 0x383, 0x604, 0x000])
    def test_nobody_else_answers(self, tpdo3, cob_id: int) -> None:
        assert self.ask(tpdo3(kind=253), cob_id) == []

    def test_chunks_on_their_way_are_the_answer(self, operational) -> None:
        desk = operational
        assert [data[:5] for _, data in self.ask(desk, 0x184)] == ["00 00"]
        desk.run(1)
        desk.node.on_frame(0x80, b"\x01", desk.t_ns)
        desk.node.on_frame(0x184, b"", desk.t_ns, True)
        desk.run(10)
        chunks = [data for can_id, data in desk.take() if can_id == 0x184]
        assert [data[:5] for data in chunks] == ["00 01", "01 01", "02 01", "03 01"]
        assert self.ask(desk, 0x184) == [(0x184, chunks[-1])]

    def test_before_the_first_scan_codes_are_those_of_no_resistance(self, tpdo3) -> None:
        assert self.ask(tpdo3(FIRST_CODE, kind=253)) == [(PDO, "ff ff")]


@pytest.mark.parametrize(("kind", "at"), [(1, [1, 2, 3, 4]), (2, [2, 4])])
def test_chunks_of_a_synchronous_tpdo_are_sent_at_its_turns(operational, kind: int, at: list[int]) -> None:
    desk = operational
    desk.write(0x1800, 2, kind, 1)
    scans = []
    for n in (1, 2, 3, 4):
        desk.node.on_frame(0x80, bytes((n,)), desk.t_ns)
        desk.run(10)
        scans += [n] * (sum(can_id == 0x184 for can_id, _ in desk.take()) == 4)
    assert scans == at


def test_fixed_pdos_of_four_codes_each(make: Callable, layout) -> None:
    """The encoding without chunks: every code has a place of its own in some PDO."""
    profile = dataclasses.replace(PatchProfile.from_layout(layout), tpdos=5)
    desk = make(profile=profile)
    desk.write(0x1800, 1, 0x80000184, 4)
    desk.write(0x1801, 1, 0x80000284, 4)
    for number in range(3):
        places = [divmod(4 * number + i, 6) for i in range(4)]
        entries = [0x2100_0010 + (row << 16) + (column + 1 << 8) for row, column in places]
        desk.configure_pdo(0x1802 + number, *entries, cob_id=0x1E0 + number, kind=1)
    desk.start()
    frames = desk.frame(0x80)
    codes = [desk.read(0x2100 + row, column + 1) for row in range(2) for column in range(6)]
    assert [can_id for can_id, _ in frames] == [0x1E0, 0x1E1, 0x1E2]
    assert bytes.fromhex("".join(data for _, data in frames)) == b"".join(
        c.to_bytes(2, "little") for c in codes
    )
    assert 0xFFFF not in codes


class TestMany:
    @pytest.mark.long
    def test_the_last_ones_work(self, make: Callable) -> None:
        desk = make(profile=MANY)
        desk.configure_pdo(0x19FF, REGISTER, cob_id=0x3F0, kind=255, timer=10)
        desk.configure_pdo(0x15FF, MODE, cob_id=0x3F1, kind=255)
        desk.start()
        desk.run(25)
        assert desk.take() == [(0x3F0, "00")] * 2
        desk.frame(0x3F1, "01")
        assert desk.read(0x2020, 1) == 1
        # EMCY 0x8210 names RPDO 512 = 0x200, the length and the one wanted
        assert desk.frame(0x3F1) == [(0x084, "10 82 11 00 00 01 02 00")]

    @pytest.mark.long
    def test_idle_ones_cost_nothing(self, make: Callable) -> None:
        """Calls made for a foreign frame, a remote one, a SYNC and a turn of the timer with one TPDO due: the
        same among 2 enabled ones as among 300."""

        def calls(idle: int) -> int:
            desk = make(profile=MANY)
            desk.write(0x2021, 1, 60_000, 2)  # no scans
            desk.write(0x1801, 1, 0x80000284, 4)
            for number in range(idle):
                desk.configure_pdo(0x1880 + number, REGISTER, cob_id=0x400 + number, kind=254, timer=60_000)
                desk.configure_pdo(0x1480 + number, MODE, cob_id=0x200 + number, kind=254, timer=60_000)
            desk.configure_pdo(0x1802, REGISTER, cob_id=PDO, kind=254, timer=10)
            desk.start()
            desk.run(5)
            made = 0

            def count(_frame: object, event: str, _argument: object) -> None:
                nonlocal made
                made += event in ("call", "c_call")

            sys.setprofile(count)
            try:
                for can_id in (0x6FF, 0x080):
                    desk.node.on_frame(can_id, b"", desk.t_ns)
                desk.node.on_frame(0x6FE, b"", desk.t_ns, True)
                desk.run(10)
            finally:
                sys.setprofile(None)
            assert desk.take() == [(PDO, "00")]
            return made

        assert calls(300) <= calls(2) + 20  # heaps are a little deeper
