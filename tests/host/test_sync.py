"""SYNC: counter, order, buses side by side, and what happens when the timer thread is held up."""

from __future__ import annotations

import queue

import pytest

from skinnode.errors import BusError
from skinnode.host.sync import SyncFollower, SyncProducer, Ticks
from skinnode.process import clock
from vcan_sim.virtual_time import VirtualClock


def test_counter_runs_from_one_and_wraps() -> None:
    sent: queue.SimpleQueue[tuple[int, bytes]] = clock.simple_queue()
    ticks = Ticks(3)
    with SyncProducer([(lambda cob_id, data: sent.put((cob_id, data)), ticks)], 0.002):
        frames = [sent.get(timeout=10) for _ in range(8)]
    assert frames == [(0x80, bytes([counter])) for counter in (1, 2, 3, 1, 2, 3, 1, 2)]


def test_ticks_name_the_newest_sync_of_a_counter() -> None:
    ticks = Ticks(240)
    assert ticks.find(1) is None
    assert [ticks.note(number, 1000 * number) for number in (1, 240, 241, 242)] == [1, 240, 1, 2]
    assert ticks.find(1) == (241, 241_000)
    assert ticks.find(2) == (242, 242_000)
    assert ticks.find(240) == (240, 240_000)
    assert ticks.find(0) is None
    assert ticks.find(241) is None


@pytest.mark.parametrize(
    ("overflow", "lost"), [(240, (290,)), (240, (299, 300)), (8, (20,)), (2, ()), (3, ())]
)
def test_a_scan_whose_sync_was_lost_has_its_own_number(overflow: int, lost: tuple[int, ...]) -> None:
    """Not that of the SYNC one round of the counter before, whose counter it has."""
    ticks = Ticks(overflow)
    follower = SyncFollower(ticks)
    for number in range(1, 3 * overflow):
        if number not in lost:
            follower.on_sync(bytes([ticks.counter_of(number)]), 1000 * number)
        for scan in {number, number - 1, number - overflow // 2}:  # scans may arrive after later SYNCs
            if scan > 0:
                assert ticks.find(ticks.counter_of(scan)) == (scan, 0 if scan in lost else 1000 * scan)


def test_the_tick_is_known_before_the_frame_is_out() -> None:
    """A node may answer before send() returns."""
    ticks = Ticks(240)
    known: queue.SimpleQueue[bool] = clock.simple_queue()
    with SyncProducer([(lambda _, data: known.put(ticks.find(data[0]) is not None), ticks)], 0.002):
        assert [known.get(timeout=10) for _ in range(5)] == [True] * 5


def test_a_bus_that_refuses_does_not_silence_the_others() -> None:
    sent: queue.SimpleQueue[int] = clock.simple_queue()

    def broken(cob_id: int, data: bytes) -> None:
        raise BusError("can0: 0x080 not sent (no buffer space)")

    with SyncProducer(
        [(broken, Ticks(240)), (lambda _, data: sent.put(data[0]), Ticks(240))], 0.002
    ) as running:
        assert [sent.get(timeout=10) for _ in range(3)] == [1, 2, 3]
    stats = running.stats()
    assert stats.failed == stats.sent >= 3


def test_missed_periods_are_skipped_and_counted_not_sent_in_a_burst() -> None:
    period_s = 0.02
    sent: queue.SimpleQueue[int] = clock.simple_queue()
    hold = clock.event()

    def send(cob_id: int, data: bytes) -> None:
        sent.put(data[0])
        if data[0] == 1:
            hold.wait(5.5 * period_s)

    ticks = Ticks(240)
    with SyncProducer([(send, ticks)], period_s) as running:
        assert [sent.get(timeout=10) for _ in range(4)] == [1, 2, 3, 4]
    assert running.stats().missed >= 4
    second, third, fourth = (ticks.find(counter) for counter in (2, 3, 4))
    assert second is not None
    assert third is not None
    assert fourth is not None
    # No burst: what follows keeps to the raster of the periods. Lateness only makes the first gap shorter.
    assert fourth.t_ns - second.t_ns > period_s * 1e9


@pytest.mark.parametrize("period_ms", [1, 25, 80, 1000, 60_000])
def test_no_drift_builds_up(period_ms: int) -> None:
    """SYNC number n is due n periods after the first, to the nanosecond, however many there were."""
    sent_ns: list[int] = []
    with VirtualClock() as clock:
        begin_ns = clock.monotonic_ns()
        send = (lambda _, data: sent_ns.append(clock.monotonic_ns()), Ticks(240))
        with SyncProducer([send], period_ms * 1e-3) as running:
            clock.sleep(999.5 * period_ms * 1e-3)
    assert sent_ns == [begin_ns + n * period_ms * 1_000_000 for n in range(1000)]
    assert running.stats().missed == 0


def test_nothing_is_sent_after_close() -> None:
    sent: queue.SimpleQueue[int] = clock.simple_queue()
    with SyncProducer([(lambda _, data: sent.put(data[0]), Ticks(240))], 0.001):
        sent.get(timeout=10)
    while not sent.empty():
        sent.get()
    clock.sleep(0.02)
    assert sent.empty()


def test_buses_are_staggered_and_each_has_its_own_time() -> None:
    """The SYNC of a bus is as much later as was asked; a SYNC that has begun reaches all buses, even at the
    end."""
    sent: queue.SimpleQueue[tuple[str, int]] = clock.simple_queue()
    ticks = [Ticks(240) for _ in range(3)]
    senders = [lambda _, data, name=name: sent.put((name, data[0])) for name in "abc"]
    with SyncProducer(list(zip(senders, ticks, strict=True)), 0.8, 0.3):
        assert [sent.get(timeout=10) for _ in range(4)] == [("a", 1), ("b", 1), ("c", 1), ("a", 2)]
    assert [sent.get(timeout=10) for _ in range(2)] == [("b", 2), ("c", 2)]
    times = [each.find(1) for each in ticks]
    first, second, third = (tick.t_ns for tick in times if tick is not None)
    assert first < second < third
    assert third - first > 0.3e9  # it would be 0.6, were the first punctual
