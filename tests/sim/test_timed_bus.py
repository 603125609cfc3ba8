"""The timed bus without errors: arbitration, times, queues, load."""

from __future__ import annotations

import itertools
import random
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.errors import ConfigError
from vcan_sim.timed_bus import BitRates, CanFrame, Delivered, NthFrame, StationOptions, TimedBus

from .naive_can import draw, head

US = 1000
BY_PRIORITY = StationOptions(queue="priority")


def bus_of(n: int, rates: BitRates | None = None, options: StationOptions | None = None) -> TimedBus:
    return TimedBus([options or StationOptions()] * n, rates)


def delivered(bus: TimedBus, time_ns: int = 10**12) -> list[Delivered]:
    return [event for event in bus.advance(time_ns) if isinstance(event, Delivered)]


def bits(frame: CanFrame) -> int:
    """Length with the intermission, at the nominal bit rate only."""
    return sum(draw(frame).counts)


def test_frame_on_an_idle_bus_starts_at_once() -> None:
    bus, frame = bus_of(3), CanFrame(0x123, b"\x55\xaa")
    assert bus.next_event_ns is None
    assert bus.send(5_700, 1, frame)
    end = 5_700 + (bits(frame) - 3) * US
    assert bus.advance(end - 1) == []
    assert bus.next_event_ns == end
    assert bus.advance(end) == [Delivered(end, 1, frame, (0, 2), 5_700, 5_700)]
    assert bus.next_event_ns is None
    assert bus.frames == {(0x123, False): 1}


def test_frames_follow_each_other_after_three_bits() -> None:
    bus, frames = bus_of(2, BitRates(125_000)), [CanFrame(0x100 + n, bytes([n] * n)) for n in range(9)]
    for frame in frames:
        bus.send(0, 0, frame)
    starts = [sum(bits(each) for each in frames[:n]) * 8_000 for n in range(9)]
    assert [event.started_ns for event in delivered(bus)] == starts
    late = bus_of(2)
    late.send(0, 0, frames[0])
    (first,) = delivered(late, (bits(frames[0]) - 3) * US)
    late.send(first.time_ns + 2_999, 0, frames[1])  # in the intermission; the next one after it
    late.send(first.time_ns + 300 * US, 1, frames[2])
    assert [event.started_ns - first.time_ns for event in delivered(late, 10**9)] == [3_000, 300_000]


FRAMES = st.builds(
    lambda can_id, data, extended, remote, fd: CanFrame(
        can_id << 18 | can_id % 5 if extended else can_id,
        b"" if remote and not fd else data,
        extended,
        remote and not fd,
        0,
        fd,
    ),
    st.integers(0x100, 0x103),
    st.binary(max_size=2),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)


def arbitration_bits(frame: CanFrame) -> str:
    return head(frame)[0][1 : 33 if frame.extended else 14]


@pytest.mark.long
@settings(deadline=None, max_examples=200)
@given(st.lists(FRAMES, min_size=2, max_size=12, unique_by=arbitration_bits))
def test_the_lowest_bits_win(frames: list[CanFrame]) -> None:
    """Bit by bit: each station that sends a recessive bit while another sends a dominant one withdraws."""
    bus = bus_of(len(frames) + 1, BitRates(1_000_000, 1_000_000))
    for number, frame in enumerate(frames):
        bus.send(0, number, frame)
    expected, waiting = [], list(frames)
    while waiting:
        left = waiting
        for place in range(1, 33):
            on_bus = min(head(frame)[0].ljust(33, "0")[place] for frame in left)
            left = [frame for frame in left if head(frame)[0].ljust(33, "0")[place] == on_bus]
            if len(left) == 1:
                break
        expected.append(left[0])
        waiting.remove(left[0])
    assert [event.frame for event in delivered(bus)] == expected


def test_order_of_formats_with_the_same_identifier() -> None:
    base = [CanFrame(0x123), CanFrame(0x123, remote=True)]
    extended = [CanFrame(0x123 << 18, extended=True), CanFrame(0x123 << 18, extended=True, remote=True)]
    bus = bus_of(5)
    for number, frame in enumerate([*reversed(extended), *reversed(base)]):
        bus.send(0, number, frame)
    assert [event.frame for event in delivered(bus)] == [*base, *extended]


@pytest.mark.parametrize(("late_ns", "first"), [(0, 1), (7_999, 1), (8_000, 0)])
def test_frame_takes_part_less_than_a_bit_after_the_start(late_ns: int, first: int) -> None:
    bus = bus_of(2, BitRates(125_000))
    bus.send(1000, 0, CanFrame(0x200))
    bus.send(1000 + late_ns, 1, CanFrame(0x100))
    events = delivered(bus)
    assert [event.station for event in events] == [first, 1 - first]
    assert events[0].started_ns == 1000


def test_queues_are_fifo_or_by_priority() -> None:
    ids = [0x300, 0x100, 0x200, 0x100]
    for options, order in ((StationOptions(), [0, 1, 2, 3]), (BY_PRIORITY, [1, 3, 2, 0])):
        bus = bus_of(2, options=options)
        for number, can_id in enumerate(ids):
            bus.send(0, 0, CanFrame(can_id, bytes([number])))
        assert [event.frame.data[0] for event in delivered(bus)] == order


def test_low_priority_frame_at_the_head_of_a_fifo_blocks_those_behind_it() -> None:
    """Priority inversion of SocketCAN: the third station's frame goes before the second one of the first."""
    for options, order in ((StationOptions(), [0x200, 0x300, 0x100]), (BY_PRIORITY, [0x100, 0x200, 0x300])):
        bus = TimedBus([options, StationOptions()])
        bus.send(0, 0, CanFrame(0x300))
        bus.send(0, 0, CanFrame(0x100))
        bus.send(0, 1, CanFrame(0x200))
        assert [event.frame.can_id for event in delivered(bus)] == order


def test_full_queue_refuses() -> None:
    bus = TimedBus([StationOptions(capacity=2), StationOptions()])
    assert [bus.send(0, 0, CanFrame(n)) for n in (1, 2, 3)] == [True, True, False]
    assert bus.waiting(0) == 2
    bus.advance(10 * US)  # the first is on the bus, but may have to be sent again
    assert bus.waiting(0) == 2
    assert not bus.send(10 * US, 0, CanFrame(4))
    bus.advance(50 * US)
    assert bus.send(50 * US, 0, CanFrame(5))
    assert [event.frame.can_id for event in delivered(bus)] == [2, 5]


def test_cleared_frames_are_not_sent() -> None:
    bus = bus_of(2)
    for can_id in (1, 2, 3):
        bus.send(0, 0, CanFrame(can_id))
    bus.advance(10 * US)
    bus.clear(10 * US, 0)
    assert [event.frame.can_id for event in delivered(bus, 10**6)] == [1]
    bus.send(10**6, 0, CanFrame(4))
    bus.clear(10**6, 0)  # in the start of frame: the bus is left as if it had not been
    bus.send(2 * 10**6, 0, CanFrame(5))
    assert [(event.frame.can_id, event.started_ns) for event in delivered(bus)] == [(5, 2 * 10**6)]
    assert bus.waiting(0) == 0


def test_frame_cleared_in_the_start_of_frame_does_not_delay_the_others() -> None:
    bus = bus_of(3)
    for station in (0, 1):
        bus.send(0, station, CanFrame(station))
    bus.clear(500, 0)
    assert [(event.station, event.started_ns) for event in delivered(bus)] == [(1, 0)]


@pytest.mark.long
def test_times_are_exact_after_many_frames() -> None:
    """Bits of 3 1/3 and 1/3 microseconds: a sum of rounded times would be off by milliseconds."""
    rates, rng = BitRates(300_000, 3_000_000), random.Random(5)
    bus, total, frames = bus_of(2, rates), Fraction(0), 5_000
    start = 3_600 * 10**9 + 1  # after an hour
    for _ in range(frames):
        frame = CanFrame(0x123, rng.randbytes(8), fd=True, brs=True)
        bus.send(start, 0, frame)
        nominal, fast = draw(frame).counts
        total += Fraction(nominal, 300_000) + Fraction(fast, 3_000_000)
    events = delivered(bus, 10**14)
    end = start + (total - Fraction(3, 300_000)) * 10**9
    assert len(events) == frames
    assert 0 <= events[-1].time_ns - end < 1
    assert bus.busy_share(start, events[-1].time_ns) == pytest.approx(1, abs=1e-12)


@st.composite
def traffic(draw_of: st.DrawFn) -> list[tuple[int, int, CanFrame]]:
    """(time, station, frame), in order of time, of three stations with identifiers of their own."""
    sent, now = [], 0
    for number in range(draw_of(st.integers(1, 25))):
        now += draw_of(st.integers(0, 400_000) | st.sampled_from([0, 999, 1000, 3000]))
        station = draw_of(st.integers(0, 2))
        can_id = 0x100 + 4 * draw_of(st.integers(0, 3)) + station
        sent.append((now, station, CanFrame(can_id, bytes([number, *draw_of(st.binary(max_size=7))]))))
    return sent


@pytest.mark.long
@settings(deadline=None, max_examples=100)
@given(traffic(), st.lists(st.integers(0, 2_000_000), max_size=20), st.sampled_from(["fifo", "priority"]))
def test_every_frame_is_delivered_once_and_steps_of_time_do_not_matter(
    sent: list[tuple[int, int, CanFrame]], steps: list[int], queue: str
) -> None:
    options = StationOptions(queue="fifo" if queue == "fifo" else "priority")
    at_once, in_steps = bus_of(3, options=options), bus_of(3, options=options)
    for each in sent:
        at_once.send(*each)
    expected = at_once.advance(10**9)
    seen = []
    for time_ns, step in sorted(
        [(time_ns, None) for time_ns in steps] + [(each[0], each) for each in sent], key=lambda each: each[0]
    ):
        while (due := in_steps.next_event_ns) is not None and due <= time_ns:
            seen += in_steps.advance(due)
        if step is None:
            seen += in_steps.advance(time_ns)
        else:
            in_steps.send(*step)
    while (due := in_steps.next_event_ns) is not None:
        seen += in_steps.advance(due)
    assert seen == expected
    events = [event for event in expected if isinstance(event, Delivered)]
    assert len(events) == len(expected)
    assert sorted((e.queued_ns, e.station, e.frame.data) for e in events) == sorted(
        (time_ns, station, frame.data) for time_ns, station, frame in sent
    )
    for before, after in itertools.pairwise(events):
        assert after.started_ns >= before.time_ns + 3_000
    for event in events:
        assert event.time_ns - event.started_ns == (bits(event.frame) - 3) * 1000
        assert event.queued_ns < event.started_ns + 1000


CHANGES = st.tuples(
    st.integers(0, 3_000_000), st.integers(0, 2), st.sampled_from(["clear", "disconnect", "connect"])
)


def bursts_are_what_single_frames_are(
    sent: list[tuple[int, int, CanFrame]], changes: list[tuple[int, int, str]]
) -> None:
    """A rule, even one that hits no frame, makes the bus decide on each frame by itself."""
    never = NthFrame(0x7FF, 1)
    in_bursts, one_by_one = bus_of(3), TimedBus([StationOptions()] * 3, None, [never])
    calls = [(time_ns, station, name, ()) for time_ns, station, name in changes]
    calls += [(time_ns, station, "send", (frame,)) for time_ns, station, frame in sent]
    for bus in (in_bursts, one_by_one):
        for time_ns, station, name, arguments in sorted(calls, key=lambda call: call[0]):
            getattr(bus, name)(time_ns, station, *arguments)
        for station in range(3):
            bus.connect(4_000_000 + 400_000 * 25, station)
    end_ns = 10**9
    assert in_bursts.advance(end_ns) == one_by_one.advance(end_ns)
    assert in_bursts.frames == one_by_one.frames
    assert in_bursts.busy_share(0, end_ns) == one_by_one.busy_share(0, end_ns)
    for station in range(3):
        assert in_bursts.counters(station) == one_by_one.counters(station)
        assert in_bursts.waiting(station) == one_by_one.waiting(station) == 0


@pytest.mark.parametrize("examples", [50, pytest.param(300, marks=pytest.mark.long)])
def test_bursts_are_what_single_frames_are(examples: int) -> None:
    check = given(traffic(), st.lists(CHANGES, max_size=8))(bursts_are_what_single_frames_are)
    settings(deadline=None, max_examples=examples)(check)()


def test_a_frame_within_a_bit_of_the_start_interrupts_a_burst() -> None:
    bus = bus_of(3)
    for number in range(3):
        bus.send(0, 0, CanFrame(0x200, bytes([number])))
    ends_ns = bits(CanFrame(0x200, b"\0")) * 1000  # with the intermission: here the second frame starts
    bus.send(ends_ns + 500, 1, CanFrame(0x100))
    assert [event.frame.can_id for event in delivered(bus)] == [0x200, 0x100, 0x200, 0x200]


@pytest.mark.long
@settings(deadline=None, max_examples=100)
@given(traffic(), st.integers(0, 3_000_000), st.integers(1, 3_000_000))
def test_load_of_any_interval(sent: list[tuple[int, int, CanFrame]], start: int, length: int) -> None:
    bus = bus_of(3)
    for each in sent:
        bus.send(*each)
    end = start + length
    now = max(end, sent[-1][0])
    events = delivered(bus, now)
    running = bus.busy_share(start, end)
    events += delivered(bus, 10**10)
    busy = sum(max(0, min(end, event.time_ns + 3_000) - max(start, event.started_ns)) for event in events)
    assert bus.busy_share(start, end) == running == busy / length
    counts: dict[tuple[int, bool], int] = {}
    for _, _, frame in sent:
        counts[frame.can_id, False] = counts.get((frame.can_id, False), 0) + 1
    assert bus.frames == counts
    bus.forget_load(start)
    assert bus.busy_share(start, end) == running


@pytest.mark.parametrize(
    ("nominal_bps", "data_bps", "line"),
    [
        (9_999, None, "nominal_bps: got 9999, allowed: 10000 to 1000000 bit/s"),
        (
            500_000,
            250_000,
            r"data_bps: got 250000, allowed: 500000 \(nominal_bps\) to 8000000 bit/s, or None",
        ),
        (500_000, 8_000_001, "data_bps: got 8000001"),
    ],
)
def test_what_is_no_bit_rate(nominal_bps: int, data_bps: int | None, line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        BitRates(nominal_bps, data_bps)


@pytest.mark.parametrize("nominal_bps", [125_000, 250_000, 500_000, 800_000, 1_000_000, 83_333])
@pytest.mark.parametrize("data_bps", [None, 1_000_000, 2_000_000, 3_000_000, 5_000_000, 8_000_000])
def test_bit_times_are_whole_ticks(nominal_bps: int, data_bps: int | None) -> None:
    rates = BitRates(nominal_bps, data_bps)
    assert rates.nominal_ticks * nominal_bps == rates.ticks_per_s == rates.ticks_per_ns * 10**9
    assert rates.data_ticks * (data_bps or nominal_bps) == rates.ticks_per_s


def test_bad_calls_name_the_argument() -> None:
    bus = bus_of(2)
    bus.send(1000, 0, CanFrame(1))
    with pytest.raises(ValueError, match="time_ns: got 999, must be at least 1000"):
        bus.advance(999)
    with pytest.raises(IndexError, match="station: got 2, must be 0 to 1"):
        bus.send(1000, 2, CanFrame(1))
    with pytest.raises(ValueError, match="frame: got a CAN FD frame, must be a classic frame"):
        bus.send(1000, 0, CanFrame(1, fd=True))
    with pytest.raises(
        ValueError, match="interval: got 0 to 2000 ns, must not be empty and must end by 1000 ns"
    ):
        bus.busy_share(0, 2000)
    for arguments, line in (
        ({"queue": "lifo"}, "queue: got 'lifo', allowed: fifo or priority"),
        ({"capacity": 0}, "capacity: got 0"),
        ({"restart_ns": -1}, "restart_ns: got -1"),
    ):
        with pytest.raises(ConfigError, match=line):
            StationOptions(**arguments)  # type: ignore[arg-type]
