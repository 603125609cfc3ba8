"""The timed bus with errors: error frames, counters, states, recovery, collisions, disconnected stations."""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.errors import ConfigError
from vcan_sim.timed_bus import (
    AtTime,
    BitRates,
    BusOff,
    CanFrame,
    Cause,
    Counters,
    CountersChanged,
    Delivered,
    Disturbance,
    ErrorFrame,
    ErrorState,
    Event,
    NthFrame,
    RandomShare,
    Recovered,
    StationOptions,
    TimedBus,
)

from .naive_can import draw, error_seen_at

US = 1000
FRAME = CanFrame(0x123, b"\x55\x0f\x00\xff\x3c")
ANOTHER = CanFrame(0x321, b"\x01")
FOREVER = 10**11


def bus_of(
    n: int, *rules: Disturbance, rates: BitRates | None = None, restart_ns: int | None = 0
) -> TimedBus:
    return TimedBus([StationOptions(restart_ns=restart_ns)] * n, rates, rules)


def only(events: Sequence[Event], kind: type[Event]) -> list[Event]:
    return [event for event in events if isinstance(event, kind)]


def errors(events: Sequence[Event]) -> list[ErrorFrame]:
    return [event for event in events if isinstance(event, ErrorFrame)]


def delivered(events: Sequence[Event]) -> list[Delivered]:
    return [event for event in events if isinstance(event, Delivered)]


def until_delivered(bus: TimedBus, frames: int) -> list[Event]:
    """All events up to that many deliveries."""
    events: list[Event] = []
    while len(delivered(events)) < frames:
        due = bus.next_event_ns
        assert due is not None
        events += bus.advance(due)
    return events


# --- error frames


def naive_retry_bits(frame: CanFrame, bit: int) -> tuple[int, int, bool]:
    """Nominal and data bits from the start of a frame that is inverted at a bit, and answered by active error
    flags of a sender and its receivers, to the next start; whether the receivers see an error in that bit."""
    drawn = draw(frame)
    inverted = "10"[int(drawn.bits[bit])]
    place = error_seen_at(drawn, bit, inverted, "0")
    fast = sum(drawn.at_data_rate[: bit + 1])
    lag = place - bit
    nominal = bit + 1 - fast + 6 + 8 + 3
    return (nominal, fast + lag, False) if drawn.at_data_rate[bit] else (nominal + lag, fast, place == bit)


@pytest.mark.long
@settings(deadline=None, max_examples=300)
@given(
    st.integers(0, 0x7FF),
    st.lists(st.sampled_from([0, 0xFF, 0x0F, 0xF0, 0x83]) | st.integers(0, 255), max_size=12).map(bytes),
    st.booleans(),
    st.integers(0, 10**6),
)
def test_error_flags_end_with_those_of_the_receivers(can_id: int, data: bytes, fd: bool, bit: int) -> None:
    fd = fd or len(data) > 8
    data = data if len(data) <= 8 else data.ljust(12, b"\0")
    frame = CanFrame(can_id, data, fd=fd, brs=fd)
    bit %= len(draw(frame).bits) - 1
    bus = bus_of(3, NthFrame(can_id, 1, bit=bit), rates=BitRates(500_000, 4_000_000))
    bus.send(1000, 0, frame)
    events = bus.advance(FOREVER)
    nominal, fast, at_once = naive_retry_bits(frame, bit)
    (error,), (sent,) = errors(events), delivered(events)
    before = sum(draw(frame).at_data_rate[: bit + 1])
    assert error.time_ns == 1000 + (bit + 1 - before) * 2000 + before * 250
    assert (error.stations, error.frames, error.bit, error.destroyed) == ((0,), (frame,), bit, True)
    assert error.cause is Cause.DISTURBED
    assert sent.started_ns == 1000 + nominal * 2000 + fast * 250
    assert (sent.frame, sent.queued_ns) == (frame, 1000)
    if not draw(frame).at_data_rate[bit]:
        assert error.detected_by == ((0, 1, 2) if at_once else (0,))
        assert 6 + 8 + 3 <= nominal - (bit + 1 - before) <= 12 + 8 + 3


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(st.integers(0, 0x7FF), st.binary(max_size=2), st.integers(0, 10**6) | st.integers(-16, -10))
def test_passive_error_flag_is_noticed_as_missing_stuff_bits(can_id: int, data: bytes, bit: int) -> None:
    """A receiver that sees no violation finds the CRC wrong, which shows after the ACK delimiter."""
    frame = CanFrame(can_id, data)
    drawn = draw(frame)
    bit %= len(drawn.bits) - 1
    bus = bus_of(2, NthFrame(can_id, 1, attempts=16), NthFrame(can_id, 17, bit=bit))
    bus.send(0, 0, frame)
    events = bus.advance(FOREVER)
    inverted = "10"[int(drawn.bits[bit])]
    lag = error_seen_at(drawn, bit, inverted, "1") - bit
    pause = delivered(events)[0].started_ns - errors(events)[16].time_ns
    assert pause == (lag + 6 + 8 + 3 + 8) * US


def test_stuff_bit_inverted_is_an_error_for_all() -> None:
    # Identifier 0: the sixth bit is the first stuff bit. Inverted, it is the sixth dominant bit for all.
    bus = bus_of(2, NthFrame(0, 1, bit=5))
    bus.send(0, 0, CanFrame(0))
    events = bus.advance(FOREVER)
    assert errors(events)[0].time_ns == 6 * US
    assert delivered(events)[0].started_ns == (6 + 6 + 8 + 3) * US
    assert errors(events)[0].detected_by == (0, 1)


def test_receiver_alone_sees_an_error() -> None:
    """It takes 9 for being the first, the others 1, the sender 8; each success gives 1 back."""
    bus = bus_of(4, NthFrame(0x123, 1, bit=25, station=2))
    bus.send(0, 0, FRAME)
    events = bus.advance(FOREVER)
    assert errors(events)[0].detected_by == (2,)
    changes = [event for event in events if isinstance(event, CountersChanged)]
    first = {event.station: event.counters for event in changes[:4]}
    assert first == {0: Counters(8, 0), 1: Counters(0, 1), 2: Counters(0, 9), 3: Counters(0, 1)}
    assert [bus.counters(n) for n in range(4)] == [Counters(7, 0), Counters(), Counters(0, 8), Counters()]
    flag_at = errors(events)[0].time_ns // US
    by_stuffing = error_seen_at(draw(FRAME), 25, draw(FRAME).bits[25], "0")
    assert delivered(events)[0].started_ns // US - flag_at == by_stuffing - 25 + 6 + 8 + 3


def test_station_that_is_not_there_disturbs_nothing() -> None:
    bus = bus_of(3, NthFrame(0x123, 1, station=2))
    bus.disconnect(0, 2)
    bus.send(0, 0, FRAME)
    (event,) = bus.advance(FOREVER)
    assert isinstance(event, Delivered)


# --- counters


@pytest.mark.long
def test_alone_on_the_bus() -> None:
    """No acknowledgement: error-passive after 16 attempts, and never bus-off."""
    bus, drawn = bus_of(1), draw(FRAME)
    bus.send(0, 0, FRAME)
    events = bus.advance(10**9)
    assert bus.counters(0) == Counters(128, 0)
    assert max(event.counters.tec for event in events if isinstance(event, CountersChanged)) == 128
    assert not only(events, BusOff)
    assert not delivered(events)
    seen = errors(events)
    to_flag = len(drawn.bits) - 8  # ACK delimiter and end of frame are not sent
    assert {(event.bit, event.cause) for event in seen} == {(to_flag - 1, Cause.NO_ACK)}
    pauses = [after.time_ns - before.time_ns for before, after in itertools.pairwise(seen)]
    assert set(pauses[:15]) == {(6 + 8 + 3 + to_flag) * US}
    assert set(pauses[15:]) == {(6 + 8 + 3 + 8 + to_flag) * US}  # suspended
    assert len(seen) == 16 + (10**9 // US - 16 * to_flag - 15 * 17) // (to_flag + 25)


def test_bus_off_after_32_errors_and_back_on_an_idle_bus() -> None:
    # Inverted stuff bit: all flags at once, so each attempt is 6 + 6 + 8 + 3 bits.
    bus = bus_of(2, NthFrame(0, 1, attempts=32, bit=5))
    bus.send(0, 0, CanFrame(0))
    events = bus.advance(FOREVER)
    flags = [event.time_ns // US for event in errors(events)]
    assert flags == [6 + 23 * n + 8 * max(0, n - 15) for n in range(32)]
    (off,), (back,) = only(events, BusOff), only(events, Recovered)
    assert (off.station, off.time_ns // US) == (0, flags[-1])
    assert back == Recovered(off.time_ns + (6 + 128 * 11) * US, 0)  # 6 for the receiver's active flag
    assert delivered(events)[0].started_ns == back.time_ns
    states = [e.counters for e in events if isinstance(e, CountersChanged) and e.station == 0]
    assert [counters.tec for counters in states] == [*range(8, 257, 8), 0]
    assert [counters.state for counters in states] == (
        [ErrorState.ACTIVE] * 15 + [ErrorState.PASSIVE] * 16 + [ErrorState.BUS_OFF, ErrorState.ACTIVE]
    )


def test_frame_half_a_bit_before_the_end_of_a_recovery_delays_it() -> None:
    bus = bus_of(3, NthFrame(0, 1, attempts=32, bit=5))
    bus.send(0, 0, CanFrame(0))
    events: list[Event] = []
    while not only(events, BusOff):
        events += bus.advance(bus.next_event_ns or 0)
    due = events[-1].time_ns + (6 + 128 * 11) * US
    bus.send(due - 500, 1, ANOTHER)
    events = bus.advance(FOREVER)
    end = due - 500 + (len(draw(ANOTHER).bits) + 3) * US  # 127 runs before the frame, and the gap after it
    assert only(events, Recovered) == [Recovered(end, 0)]
    assert delivered(events)[0].receivers == (2,)


def test_recovery_counts_recessive_bits_of_passive_flags() -> None:
    """The only other station gets no acknowledgement. Once it is error-passive, its flag (6), delimiter (8),
    intermission (3) and suspension (8) are two runs of 11; before, delimiter and intermission are one."""
    bus = bus_of(2, NthFrame(0, 1, attempts=32, bit=5))
    bus.send(0, 0, CanFrame(0))
    events: list[Event] = []
    while not only(events, BusOff):
        events += bus.advance(bus.next_event_ns or 0)
    bus.send(events[-1].time_ns, 1, ANOTHER)
    events = bus.advance(FOREVER)
    before = events[: events.index(only(events, Recovered)[0])]
    # 1 run before the first attempt, 1 after each of 16, then 2 after each: 17 + 2 * 56 = 129 > 127
    assert len(errors(before)) == 16 + 56
    assert only(events, Recovered)[0].time_ns == errors(before)[-1].time_ns + 11 * US


def test_recovery_after_a_frame_that_was_cut_off() -> None:
    bus = bus_of(3, NthFrame(0, 1, attempts=32, bit=5))
    bus.send(0, 0, CanFrame(0))
    events: list[Event] = []
    while not only(events, BusOff):
        events += bus.advance(bus.next_event_ns or 0)
    begin = events[-1].time_ns + (6 + 11) * US
    bus.send(begin, 1, FRAME)
    bus.disconnect(begin + 20 * US, 1)
    events = bus.advance(FOREVER)
    flag_end = errors(events)[0].time_ns + 6 * US
    assert only(events, Recovered) == [Recovered(flag_end + 127 * 11 * US, 0)]


def test_recovery_counts_one_gap_between_frames_of_a_full_bus() -> None:
    """ACK delimiter, end of frame and intermission are 11 recessive bits."""
    bus = bus_of(3, NthFrame(0, 1, attempts=32, bit=5))
    bus.send(0, 0, CanFrame(0))
    events: list[Event] = []
    while not only(events, BusOff):
        events += bus.advance(bus.next_event_ns or 0)
    for _ in range(200):
        bus.send(events[-1].time_ns, 1, ANOTHER)
    after = bus.advance(FOREVER)
    place = [type(event) for event in after].index(Recovered)
    # The first of the 128 gaps lies between the last error flag and the first frame.
    assert sum(isinstance(event, Delivered) for event in after[:place]) == 127
    last = [event for event in after[:place] if isinstance(event, Delivered)][-1]
    assert after[place].time_ns == last.time_ns + 3 * US
    assert delivered(after[place:])[0].frame == CanFrame(0)


def test_recovery_waits_for_its_restart() -> None:
    for restart_ns in (None, 5_000_000):
        bus = bus_of(2, NthFrame(0, 1, attempts=32, bit=5), restart_ns=restart_ns)
        bus.send(0, 0, CanFrame(0))
        bus.restart(0, 0)  # not bus-off: nothing to restart
        events = bus.advance(4_000_000)
        (off,) = only(events, BusOff)
        assert bus.counters(0).state is ErrorState.BUS_OFF
        assert bus.waiting(0) == 1
        begin = off.time_ns + 5_000_000
        if restart_ns is None:
            assert bus.next_event_ns is None
            begin = 4_500_000
            bus.restart(begin, 0)
        assert bus.next_event_ns == begin + 128 * 11 * US
        assert only(bus.advance(FOREVER), Recovered) == [Recovered(begin + 128 * 11 * US, 0)]


def test_error_passive_sender_lets_others_go_first() -> None:
    """Suspend transmission: it waits 8 bits longer than a station with a lower priority."""
    bus = bus_of(3, NthFrame(0, 1, attempts=16, bit=5))
    for _ in range(4):
        bus.send(0, 0, CanFrame(0))
    events = until_delivered(bus, 1)
    assert bus.counters(0) == Counters(127, 0)  # active again, with its first success
    assert delivered(events)[0].started_ns == (16 * 23 + 8) * US
    bus = bus_of(3, NthFrame(0, 1, attempts=17, bit=5))
    for _ in range(4):
        bus.send(0, 0, CanFrame(0))
    bus.send(0, 1, CanFrame(0x700))
    frames = [event.frame.can_id for event in delivered(bus.advance(FOREVER))]
    assert frames == [0x700, 0, 0, 0, 0]


def test_suspended_sender_that_becomes_ready_in_a_start_of_frame_waits() -> None:
    bus = bus_of(3, NthFrame(0, 1, attempts=17, bit=5))
    bus.send(0, 0, CanFrame(0))
    bus.send(0, 0, CanFrame(0, b"\1"))
    (sent,) = delivered(until_delivered(bus, 1))
    bus.send(sent.time_ns + (3 + 8) * US - 500, 1, CanFrame(0x700))
    assert [event.frame.can_id for event in delivered(bus.advance(FOREVER))] == [0x700, 0]


def test_receiver_above_127_falls_to_119() -> None:
    """Fourteen errors that it sees alone, of 9 each, then ones as any receiver's."""
    bus = bus_of(3, NthFrame(0x123, 1, attempts=14, bit=25, station=2))
    bus.send(0, 0, FRAME)
    events = until_delivered(bus, 1)
    assert bus.counters(2) == Counters(0, 14 * 9 - 1)
    bus.disturb(NthFrame(0x123, 1, attempts=3, bit=30))
    bus.send(events[-1].time_ns, 0, FRAME)
    events = until_delivered(bus, 1)
    at_two = [e.counters for e in events if isinstance(e, CountersChanged) and e.station == 2]
    assert [counters.rec for counters in at_two] == [126, 127, 128, 119]
    assert [counters.state for counters in at_two[1:]] == [
        ErrorState.ACTIVE,
        ErrorState.PASSIVE,
        ErrorState.ACTIVE,
    ]


def test_error_passive_receiver_does_not_destroy_the_frame() -> None:
    bus = bus_of(3, NthFrame(0x123, 1, attempts=16, bit=25, station=2))
    bus.send(0, 0, FRAME)
    events = bus.advance(FOREVER)
    assert [error.destroyed for error in errors(events)] == [True] * 15 + [False]
    assert [error.stations for error in errors(events)] == [(0,)] * 15 + [()]
    (sent,) = delivered(events)
    assert sent.receivers == (1,)
    assert bus.counters(2) == Counters(0, 15 * 9 + 1)


def test_only_receiver_that_is_passive_and_disturbed_does_not_acknowledge() -> None:
    bus = bus_of(2, NthFrame(0x123, 1, attempts=16, bit=25, station=1))
    bus.send(0, 0, FRAME)
    causes = [error.cause for error in errors(bus.advance(FOREVER))]
    assert causes == [Cause.DISTURBED] * 16 + [Cause.NO_ACK]


# --- collisions


def test_same_identifier_and_different_data_collide() -> None:
    """Until both are error-passive: then the loser's flag no longer destroys the winner's frame."""
    ours, theirs = CanFrame(0x123, b"\x01\x02"), CanFrame(0x123, b"\x01\x82")
    drawn = [draw(frame).bits for frame in (ours, theirs)]
    place = next(n for n, pair in enumerate(zip(*drawn, strict=False)) if pair[0] != pair[1])
    bus = bus_of(3)
    bus.send(0, 0, ours)
    bus.send(0, 1, theirs)
    events = bus.advance(FOREVER)
    seen = errors(events)
    assert [error.destroyed for error in seen] == [True] * 16 + [False]
    assert {(error.bit, error.cause, error.detected_by) for error in seen} == {(place, Cause.COLLISION, (1,))}
    assert seen[0].stations == (0, 1)
    assert seen[0].frames == (ours, theirs)
    assert seen[0].time_ns == (place + 1) * US
    assert seen[16].stations == (1,)
    first, second = delivered(events)
    assert (first.station, first.receivers, second.station) == (0, (2,), 1)
    # 16 collisions, then the loser's last error; the first success of each gives 1 back, as a reception does.
    assert bus.counters(0) == Counters(127, 0)
    assert bus.counters(1) == Counters(135, 0)
    assert bus.counters(2) == Counters(0, 14)


@pytest.mark.parametrize("stations", [2, 3])
def test_stations_that_collide_start_again_together(stations: int) -> None:
    ours, theirs = CanFrame(0x123, b"\x01\x02"), CanFrame(0x123, b"\x01\x82")
    bus = bus_of(stations)
    bus.send(0, 0, ours)
    bus.send(0, 1, theirs)
    first, second = errors(bus.advance(300 * US))[:2]
    drawn = draw(ours)
    # The sender of the dominant bit sees the flag in its next recessive bit, the receiver by stuffing.
    lag = drawn.bits.index("1", first.bit + 1) - first.bit
    if stations == 3:
        lag = max(lag, error_seen_at(drawn, first.bit, "0", "0") - first.bit)
    assert second.time_ns - first.time_ns == (lag + 6 + 8 + 3 + first.bit + 1) * US


def test_same_bits_at_the_same_time_pass_as_one_frame() -> None:
    bus = bus_of(3)
    for station in (0, 1):
        bus.send(0, station, FRAME)
    first, second = delivered(bus.advance(FOREVER))
    assert (first.time_ns, first.station, first.receivers) == (second.time_ns, 0, (2,))
    assert (second.station, second.receivers) == (1, ())
    assert bus.frames == {(0x123, False): 1}
    bus = bus_of(3)  # one of them is disconnected: the other goes on
    for station in (0, 1):
        bus.send(0, station, FRAME)
    bus.disconnect(20 * US, 0)
    assert [(event.station, event.receivers) for event in delivered(bus.advance(FOREVER))] == [(1, (2,))]
    assert (bus.waiting(0), bus.waiting(1)) == (1, 0)
    alone = bus_of(2)  # two that send do not acknowledge each other
    for station in (0, 1):
        alone.send(0, station, FRAME)
    assert errors(alone.advance(10**6))[0].cause is Cause.NO_ACK


def test_classic_and_fd_frames_of_one_identifier_collide_at_fdf() -> None:
    bus = bus_of(3, rates=BitRates(500_000, 2_000_000))
    bus.send(0, 0, CanFrame(0x155, fd=True))
    bus.send(0, 1, CanFrame(0x155))
    error = errors(bus.advance(10**6))[0]
    assert (error.bit, error.detected_by) == (14, (0,))  # SOF, 11 identifier bits, RRS, IDE; nothing stuffed


# --- rules


def test_time_hits_the_bit_on_the_bus() -> None:
    bus = bus_of(2, AtTime(5_000), AtTime(1_030_500), AtTime(10**7))
    bus.send(10_000, 0, FRAME)
    bus.send(10**6, 0, FRAME)
    events = bus.advance(FOREVER)
    assert [(error.bit, error.time_ns) for error in errors(events)] == [(30, 1_031_000)]
    assert len(delivered(events)) == 2
    fd, drawn = (
        CanFrame(0x123, bytes(20), fd=True, brs=True),
        draw(CanFrame(0x123, bytes(20), fd=True, brs=True)),
    )
    for bit in range(0, len(drawn.bits) - 1, 7):
        fast = sum(drawn.at_data_rate[:bit])
        time_ns = (bit - fast) * 2000 + fast * 500
        bus = bus_of(2, AtTime(time_ns), rates=BitRates(500_000, 2_000_000))
        bus.send(0, 0, fd)
        assert errors(bus.advance(FOREVER))[0].bit == bit


def test_earliest_of_several_disturbances_destroys_the_frame() -> None:
    bus = bus_of(3, NthFrame(0x123, 1, bit=40), NthFrame(0x123, 1, bit=30), NthFrame(0x123, 1, bit=35))
    bus.send(0, 0, FRAME)
    assert [error.bit for error in errors(bus.advance(FOREVER))] == [30]


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_share_of_all_attempts(share: float) -> None:
    runs = []
    for _ in range(2):
        bus = bus_of(
            3, RandomShare(share, seed=3, can_id=0x100), RandomShare(share, seed=4, can_id=0x111, bit=7)
        )
        for n in range(400):
            bus.send(0, n % 2, CanFrame(0x100 if n % 2 else 0x200))
        runs.append(bus.advance(30_000 * 400 if share < 1 else 10**7))
    assert runs[0] == runs[1]
    hit, passed = len(errors(runs[0])), sum(event.frame.can_id == 0x100 for event in delivered(runs[0]))
    assert all(error.frames[0].can_id == 0x100 for error in errors(runs[0]))
    if share == 1:
        assert (passed, len(only(runs[0], BusOff)) >= 1) == (0, True)
    elif share:
        assert abs(hit / (hit + passed) - share) < 4 * (share * (1 - share) / (hit + passed)) ** 0.5
        assert len({error.bit for error in errors(runs[0])}) > 15
    else:
        assert hit == 0


def test_bit_beyond_the_frame_is_the_last_that_destroys_it() -> None:
    bus = bus_of(2, NthFrame(0x123, 1, bit=10_000))
    bus.send(0, 0, FRAME)
    assert errors(bus.advance(FOREVER))[0].bit == len(draw(FRAME).bits) - 2


@pytest.mark.parametrize(
    ("kind", "arguments", "line"),
    [
        (NthFrame, {"can_id": 1, "first": 0}, "disturbances.first: got 0, allowed: at least 1"),
        (NthFrame, {"can_id": 1, "first": 1, "attempts": 0}, "disturbances.attempts: got 0"),
        (NthFrame, {"can_id": 1, "first": 1, "bit": -1}, "disturbances.bit: got -1"),
        (RandomShare, {"share": 1.5, "seed": 1}, "disturbances.share: got 1.5, allowed: 0 to 1"),
        (RandomShare, {"share": 1, "seed": 1, "bit": -1}, "disturbances.bit: got -1"),
        (AtTime, {"time_ns": -1}, "disturbances.time_ns: got -1"),
    ],
)
def test_what_is_no_rule(kind: type[Disturbance], arguments: dict[str, float], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        kind(**arguments)  # type: ignore[arg-type]


def test_rule_for_a_station_that_does_not_exist() -> None:
    with pytest.raises(ConfigError, match=r"disturbances\.station: got 2, allowed: 0 to 1, or None"):
        bus_of(2, AtTime(0, station=2))


# --- stations that leave and join


def test_sender_that_is_disconnected_leaves_an_error_frame() -> None:
    """The receivers see recessive bits until the stuff rule is violated."""
    drawn = draw(FRAME)
    bit = 40
    bus = bus_of(3)
    bus.send(0, 0, FRAME)
    bus.send(0, 1, ANOTHER)
    bus.disconnect(bit * US + 500, 0)
    events = bus.advance(FOREVER)
    place = error_seen_at(drawn, bit, drawn.bits[bit], "1")
    (error,) = errors(events)
    assert (error.bit, error.cause, error.stations) == (place, Cause.CUT_OFF, ())
    assert error.time_ns == (place + 1) * US
    (sent,) = delivered(events)
    assert (sent.frame, sent.receivers) == (ANOTHER, (2,))
    assert sent.started_ns == (place + 1 + 6 + 8 + 3) * US
    assert bus.busy_share(0, sent.started_ns) == 1
    assert [bus.counters(n) for n in range(3)] == [Counters(), Counters(0, 1), Counters()]
    assert bus.waiting(0) == 1
    bus.connect(FOREVER + 1, 0)
    (again,) = delivered(bus.advance(2 * FOREVER))
    assert (again.frame, again.queued_ns, again.started_ns) == (FRAME, 0, FOREVER + 1 + 11 * US)


def test_only_receiver_counts_a_frame_cut_off_as_any_receiver() -> None:
    bus = bus_of(2)
    bus.send(0, 0, FRAME)
    bus.disconnect(40 * US, 0)
    bus.advance(FOREVER)
    assert bus.counters(1) == Counters(0, 1)


def test_receiver_that_leaves_or_joins_during_a_frame() -> None:
    bus = bus_of(3)
    bus.disconnect(0, 2)
    bus.send(0, 0, FRAME)
    bus.connect(20 * US, 2)  # too late for the frame
    bus.send(21 * US, 0, FRAME)
    first, second = delivered(bus.advance(FOREVER))
    assert (first.receivers, second.receivers) == ((1,), (1, 2))
    bus = bus_of(2)
    bus.send(0, 0, FRAME)
    bus.disconnect(20 * US, 1)  # nobody is left to acknowledge
    assert errors(bus.advance(200 * US))[0].cause is Cause.NO_ACK
    bus = bus_of(2)
    bus.send(0, 0, FRAME)
    end = (len(draw(FRAME).bits)) * US
    bus.disconnect(end - 5 * US, 0)  # in the end of frame: acknowledged and complete
    assert len(delivered(bus.advance(FOREVER))) == 1
    assert bus.waiting(0) == 0


# --- properties

RULES = st.lists(
    st.builds(
        RandomShare,
        st.sampled_from([0.05, 0.3]),
        st.integers(0, 99),
        st.sampled_from([None, 0x100, 0x101]),
        st.sampled_from([None, 5, 25]),
        st.just(False),
        st.sampled_from([None, None, 0, 1, 2]),
    ),
    min_size=1,
    max_size=3,
)


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(RULES, st.integers(0, 2**32))
def test_counters_are_those_that_the_rules_give(rules: list[Disturbance], seed: int) -> None:
    """Kept by hand from the error frames and the deliveries; every frame arrives once, in order."""
    rng, stations = random.Random(seed), 3
    bus, now = bus_of(stations, *rules), 0
    handed: list[list[CanFrame]] = [[] for _ in range(stations)]
    for number in range(60):
        station = number % stations
        frame = CanFrame(0x100 + station, bytes([number]))
        handed[station].append(frame)
        now += rng.randrange(150 * US)
        bus.send(now, station, frame)
    events = bus.advance(FOREVER)
    for station in range(stations):
        assert [e.frame for e in delivered(events) if e.station == station] == handed[station]
    tec, rec = [0] * stations, [0] * stations
    shown = [(0, 0)] * stations
    off: set[int] = set()
    for event in events:
        if isinstance(event, CountersChanged):
            shown[event.station] = (event.counters.tec, event.counters.rec)
            continue
        if isinstance(event, BusOff):
            assert tec[event.station] >= 256
            off.add(event.station)
            continue
        if isinstance(event, Recovered):
            off.remove(event.station)
            tec[event.station] = rec[event.station] = 0
            continue
        assert shown == list(zip(tec, rec, strict=True))
        if isinstance(event, Delivered):
            tec[event.station] -= tec[event.station] > 0
            for n in event.receivers:
                rec[n] = 119 if rec[n] > 127 else max(0, rec[n] - 1)
            continue
        for n in range(stations):
            if n in event.stations:
                tec[n] += 8 * (event.cause is not Cause.NO_ACK or tec[n] < 128)
            elif n in off or event.cause is Cause.NO_ACK:
                pass
            elif event.detected_by == (n,) and event.destroyed:
                rec[n] += 9
            elif event.destroyed or n in event.detected_by:
                rec[n] += 1
    assert shown == list(zip(tec, rec, strict=True))


def test_a_rule_that_is_removed_disturbs_no_more() -> None:
    rule, other = RandomShare(1.0, seed=1, can_id=0x123), RandomShare(1.0, seed=1, can_id=0x123)
    bus = bus_of(3, rule)
    bus.send(0, 0, FRAME)
    assert errors(bus.advance(200 * US))
    with pytest.raises(ValueError, match="an active rule"):
        bus.undisturb(other)  # equal, but another rule
    bus.undisturb(rule)
    late = bus.advance(FOREVER)
    assert len(errors(late)) <= 1  # the attempt in progress
    assert len(delivered(late)) == 1
