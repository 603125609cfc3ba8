"""Hand frames: the fields of one SYNC, who is missing and why, and nobody waits for a patch that is away."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinnode.config import HandConfig, parse_hand
from skinnode.host import Condition, HandFrame, Host
from skinnode.host.hand_frame import LATE, OVERTAKEN, HandGatherer, HandSubscription
from skinnode.model.frames import FieldFrame, ScanStamp, SolveStats
from skinnode.node import NmtState
from skinnode.transport import CanPort
from vcan_sim.fleet import Fleet

from .conftest import Rack, eventually
from .test_roles import changed, robot

MS = 1_000_000
PATIENCE = 50 * MS


def field(patch: str, scan: int) -> FieldFrame:
    zero = np.zeros((1, 1, 3))
    stamp = ScanStamp(patch, scan, scan % 240, 0, 1000 * scan, 0, 0)
    return FieldFrame(zero, zero, (), np.zeros(1), SolveStats(0, 0, 0, 0.0), stamp=stamp)


def gatherer(*patches: str, condition: Condition = Condition.OPERATIONAL) -> HandGatherer:
    return HandGatherer(patches, PATIENCE, lambda patch: condition)


def numbers(frame: HandFrame | None) -> dict[str, int]:
    assert frame is not None
    return {patch: one.stamp.scan for patch, one in frame.fields.items() if one.stamp is not None}


def test_a_frame_is_out_with_its_last_field() -> None:
    hand = gatherer("a", "b")
    hand.add(field("a", 1), 0)
    assert hand.next(0) is None
    hand.add(field("a", 2), 10 * MS)
    hand.add(field("b", 1), 20 * MS)
    first = hand.next(20 * MS)
    assert first is not None
    assert (first.scan, first.t_sync_ns, first.complete, numbers(first)) == (1, 1000, True, {"a": 1, "b": 1})
    assert hand.next(20 * MS) is None
    assert hand.next_deadline_ns() == 60 * MS


def test_a_patch_that_skipped_a_scan_is_not_waited_for() -> None:
    hand = gatherer("a", "b")
    hand.add(field("a", 1), 0)
    hand.add(field("b", 2), 1)
    frame = hand.next(1)
    assert frame is not None
    assert (numbers(frame), frame.missing, frame.complete) == ({"a": 1}, {"b": OVERTAKEN}, False)


def test_after_the_patience_it_goes_on_and_who_comes_then_is_late() -> None:
    hand = gatherer("a", "b")
    hand.add(field("a", 1), 0)
    assert hand.next(PATIENCE - 1) is None
    frame = hand.next(PATIENCE)
    assert frame is not None
    assert frame.missing == {"b": LATE}
    hand.add(field("b", 1), PATIENCE)
    assert hand.next(2 * PATIENCE) is None
    assert hand.late == 1


def test_a_patch_that_is_away_costs_no_more_time_after_three_frames() -> None:
    hand = gatherer("a", "b", condition=Condition.LOST)
    for scan in range(1, 4):
        hand.add(field("a", scan), 0)
        assert hand.next(0) is None
        frame = hand.next(PATIENCE)
        assert frame is not None
        assert frame.missing == {"b": "lost"}
    hand.add(field("a", 4), 0)
    assert numbers(hand.next(0)) == {"a": 4}
    hand.add(field("b", 5), 0)  # back: waited for again
    assert hand.next(0) is None
    hand.add(field("a", 5), 0)
    assert numbers(hand.next(0)) == {"a": 5, "b": 5}


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 12), st.integers(0, 40)), max_size=60),
)
def test_frames_ascend_and_every_field_is_in_its_own_frame_or_late(
    events: list[tuple[str, int, int]],
) -> None:
    """Whatever comes when, each patch in order."""
    hand, now_ns, newest = gatherer("a", "b", "c"), 0, dict.fromkeys("abc", 0)
    given_in, out = [], []
    for patch, step, wait_ms in events:
        now_ns += wait_ms * MS
        newest[patch] += step
        given_in.append((patch, newest[patch]))
        hand.add(field(patch, newest[patch]), now_ns)
        while (frame := hand.next(now_ns)) is not None:
            out.append(frame)
    while (deadline_ns := hand.next_deadline_ns()) is not None:
        frame = hand.next(deadline_ns)
        assert frame is not None
        out.append(frame)
    assert all(a.scan < b.scan for a, b in itertools.pairwise(out))
    for frame in out:
        assert set(numbers(frame).values()) == {frame.scan}
        assert set(frame.fields) | set(frame.missing) == set("abc")
        assert not set(frame.fields) & set(frame.missing)
    told = sorted((patch, frame.scan) for frame in out for patch in frame.fields)
    assert len(told) + hand.late == len(given_in)
    assert set(told) <= set(given_in)


def take(frames: HandSubscription, count: int) -> list[HandFrame]:
    return list(itertools.islice(frames, count))


@pytest.mark.real_time
def test_of_a_running_hand(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        frames = take(host.hands(timeout_s=10), 10)
    assert [frame.scan for frame in frames] == list(range(frames[0].scan, frames[0].scan + 10))
    for frame in frames[1:]:  # the first SYNC may have been before
        assert frame.complete
        assert set(frame.fields) == {"p0", "p1"}
        assert {one.stamp.t_sync_ns for one in frame.fields.values() if one.stamp} == {frame.t_sync_ns}


@pytest.mark.real_time
def test_one_after_the_other_as_async_for(hand: HandConfig, fleet: Fleet) -> None:
    async def gather(host: Host) -> list[HandFrame]:
        frames = []
        async for frame in host.hands(timeout_s=10):
            frames.append(frame)
            if len(frames) == 5:
                break
        return frames

    with Host.from_config(hand) as host:
        frames = asyncio.run(gather(host))
    assert [frame.scan - frames[0].scan for frame in frames] == [0, 1, 2, 3, 4]


def test_a_patch_pulled_out_is_named_and_the_others_go_on(hand: HandConfig, rack: Rack) -> None:
    with Host.from_config(hand) as host:
        frames = host.hands(timeout_s=10, capacity=1000)
        assert eventually(lambda: take(frames, 1)[0].complete)
        rack.pull("p1")
        assert eventually(lambda: take(frames, 1)[0].missing == {"p1": "lost"})
        rack.plug("p1")
        assert eventually(lambda: take(frames, 1)[0].complete)


def test_a_hand_without_one_counted_sync_has_none(
    make_hand: Callable[..., HandConfig], rack_of: Callable[[HandConfig], Rack]
) -> None:
    hand = changed(
        make_hand(),
        bus={"role": "guest", "guest_sends": "sdo"},
        sync={"counter_overflow": 0, "period_ms": 25},
    )
    rack = rack_of(hand)
    for name in ("p0", "p1"):
        rack.plug(name)
    with (
        Host.from_config(hand) as host,
        pytest.raises(ValueError, match="SYNC producers: got none with a co"),
    ):
        host.hands()


def test_a_hand_of_two_masters_has_none(
    make_hand: Callable[..., HandConfig], rack_of: Callable[[HandConfig], Rack]
) -> None:
    """The host on one bus, the robot on the other: their SYNCs have nothing to do with each other."""
    table = make_hand().model_dump(mode="json")
    channel = table["buses"][0]["channel"]
    table["buses"] = [{"name": f"can{i}", "channel": f"{channel}-{i}"} for i in range(2)]
    table["buses"][1] |= {"role": "guest", "guest_sends": "sdo"}
    table["patches"][1]["bus"] = "can1"
    hand = parse_hand(table)
    rack = rack_of(hand)
    for name in ("p0", "p1"):
        rack.plug(name)
    with CanPort(hand.bus("can1")) as port, robot(port, hand):
        assert eventually(lambda: rack.nodes["p1"].nmt_state == NmtState.OPERATIONAL)
        with Host.from_config(hand) as host:
            assert all(host.fields(timeout_s=10, patch=name).get(10) for name in ("p0", "p1"))
            with pytest.raises(ValueError, match=r"^SYNC producers: got 2, must be one that all patches"):
                host.hands()


def test_the_frames_end_with_the_host_and_a_silence_is_a_timeout(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        frames = host.hands(timeout_s=0.3)
        take(frames, 2)
        fleet.stop()
        with pytest.raises(TimeoutError, match=r"^no hand frame within 0\.3 s$"):
            take(frames, 1000)
        assert frames.get(0.01) is None
    assert take(frames, 1000) == []
    assert frames.dropped == 0
