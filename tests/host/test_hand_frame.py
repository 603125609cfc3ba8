"""Hand frames: the fields and contacts of one SYNC, who is missing and why, who is waited for."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import itertools
import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinnode.config import HandConfig, parse_hand
from skinnode.errors import SkinError
from skinnode.host import Condition, HandFrame, Host
from skinnode.host.hand_frame import LATE, OVERTAKEN, HandGatherer, HandSubscription
from skinnode.host.publish import Publisher
from skinnode.host.skeleton import Skeleton
from skinnode.model.frames import Contact, FieldFrame, ScanStamp, SolveStats
from skinnode.model.pose import Pose
from skinnode.model.status import Status
from skinnode.node import NmtState
from skinnode.transport import CanPort
from vcan_sim.event_loop import run
from vcan_sim.fleet import Fleet

from .conftest import Rack, eventually
from .test_roles import changed, robot

MS = 1_000_000
PATIENCE = 50 * MS


def field(patch: str, scan: int, run: int = 0) -> FieldFrame:
    zero = np.zeros((1, 1, 3))
    stamp = ScanStamp(patch, scan, scan % 240, 0, 1000 * scan, 0, 0, run)
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


def test_scan_numbers_start_again_in_each_run() -> None:
    hand = gatherer("a", "b")
    for scan in range(1, 101):
        hand.add(field("a", scan), scan)
        hand.add(field("b", scan), scan)
        assert numbers(hand.next(scan)) == {"a": scan, "b": scan}
    hand.add(field("a", 101), 101)  # the last field of the first run
    hand.add(field("a", 1, run=1), 102)
    assert hand.next(102) is None  # b could still deliver scan 101
    hand.add(field("b", 1, run=1), 103)
    last, first = hand.next(103), hand.next(103)
    assert last is not None
    assert (numbers(last), last.missing) == ({"a": 101}, {"b": OVERTAKEN})
    assert first is not None
    assert (first.scan, numbers(first), first.complete) == (1, {"a": 1, "b": 1}, True)
    assert hand.late == 0


def test_a_frame_has_the_fields_of_one_run() -> None:
    hand = gatherer("a", "b")
    hand.add(field("a", 7), 0)
    hand.add(field("b", 7, run=1), 1)
    frame = hand.next(PATIENCE)
    assert numbers(frame) == {"a": 7}


@pytest.mark.system_time
@pytest.mark.parametrize("read", ["get", "for", "async for"])
def test_closing_a_subscription_ends_its_waiting_reader(read: str) -> None:
    publisher = Publisher(("a",))
    hands = HandSubscription(publisher.subscribe(8, None, None), gatherer("a"), None)

    async def follow() -> list[HandFrame]:
        return [frame async for frame in hands]

    waits = {"get": hands.get, "for": lambda: list(hands), "async for": lambda: asyncio.run(follow())}[read]
    reader = threading.Thread(target=waits, daemon=True)
    reader.start()
    reader.join(0.1)
    assert reader.is_alive()
    hands.close()
    reader.join(10.0)
    assert not reader.is_alive()
    hands.close()
    assert hands.get() is None


@pytest.mark.parametrize("read", ["get", "for", "async for"])
@pytest.mark.parametrize("error", [None, SkinError("the interface is gone")])
def test_the_end_loses_no_field(read: str, error: SkinError | None) -> None:
    publisher = Publisher(("a", "b"))
    hands = HandSubscription(publisher.subscribe(8, None, None), gatherer("a", "b"), None)
    for patch, scan in (("a", 1), ("b", 1), ("a", 2), ("a", 3)):
        publisher.publish(field(patch, scan), patch)
    publisher.end() if error is None else publisher.fail(error)
    got: list[HandFrame] = []

    async def follow() -> None:
        it = aiter(hands)
        while (one := await anext(it, None)) is not None:
            got.append(one)

    with contextlib.nullcontext() if error is None else pytest.raises(SkinError, match="interface is gone"):
        if read == "for":
            got.extend(hands)
        elif read == "async for":
            asyncio.run(follow())
        else:
            while (one := hands.get()) is not None:
                got.append(one)
    assert [numbers(frame) for frame in got] == [{"a": 1, "b": 1}, {"a": 2}, {"a": 3}]
    assert [dict(frame.missing) for frame in got] == [{}, {"b": LATE}, {"b": LATE}]
    assert (hands.dropped, hands.late) == (0, 0)


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


@pytest.mark.long
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


ON_LINKS = {
    "buses": [{"name": "can0"}],
    "patches": [
        {"name": "palm", "node_id": 1},
        {"name": "pad", "node_id": 2, "link": "distal", "pose": {"position_m": [0.0, 0.0, 0.01]}},
        {"name": "tip", "node_id": 3, "link": "distal", "pose": {"rpy_rad": [0.0, np.pi / 2, 0.0]}},
    ],
    "links": [{"name": "distal", "pose": {"position_m": [0.1, 0.0, 0.0]}}],
}


def pressed(patch: str, newton: float, **changes: object) -> FieldFrame:
    """A field with one contact at x = 20 mm, y = 0."""
    contact = Contact(
        centroid_m=np.array([0.02, 0.0, 0.0]),
        centroid_std_m=np.full(3, 1e-4),
        area_m2=1e-4,
        area_std_m2=1e-5,
        normal_force_n=newton,
        normal_force_std_n=0.1,
        shear_force_n=np.zeros(2),
        shear_force_std_n=np.full(2, 0.1),
    )
    return dataclasses.replace(field(patch, 1), contacts=(contact,), **changes)


def frame_of(*fields: FieldFrame, condition: Condition = Condition.OPERATIONAL) -> HandFrame:
    hand = parse_hand(ON_LINKS)
    names = [patch.name for patch in hand.patches]
    gatherer = HandGatherer(names, PATIENCE, lambda patch: condition, Skeleton.of(hand))
    for each in fields:
        gatherer.add(each, 0)
    frame = gatherer.next(PATIENCE)
    assert frame is not None
    return frame


def test_contacts_of_all_patches_in_the_frame_of_the_hand_and_of_their_link() -> None:
    frame = frame_of(pressed("palm", 1.0), pressed("pad", 2.0), pressed("tip", 3.0))
    assert [(c.patch, c.link, c.frame) for c in frame.contacts] == [
        ("tip", "distal", "hand"),
        ("pad", "distal", "hand"),
        ("palm", "hand", "hand"),
    ]
    # the tip is turned by a quarter about y: its x axis is the link's −z, its normal the link's x
    expected_m = [[0.1, 0.0, -0.02], [0.12, 0.0, 0.01], [0.02, 0.0, 0.0]]
    np.testing.assert_allclose([c.position_m for c in frame.contacts], expected_m, atol=1e-15)
    np.testing.assert_allclose(frame.contacts[0].force_n, [-3.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(frame.contacts[0].normal, [1.0, 0.0, 0.0], atol=1e-15)
    tip, pad = frame.contacts_on("distal")
    np.testing.assert_allclose(
        [tip.position_m, pad.position_m], [[0.0, 0.0, -0.02], [0.02, 0.0, 0.01]], atol=1e-15
    )
    assert tip.frame == "distal"
    assert [c.patch for c in frame.contacts_on("hand")] == ["palm"]


def test_the_wrench_of_each_link_is_about_the_origin_of_its_frame() -> None:
    frame = frame_of(pressed("palm", 1.0), pressed("pad", 2.0), pressed("tip", 3.0))
    assert list(frame.wrenches) == ["distal", "hand"]
    distal = frame.wrenches["distal"]
    np.testing.assert_allclose(distal.force_n, [-3.0, 0.0, -2.0], atol=1e-15)
    np.testing.assert_allclose(distal.torque_nm, [0.0, 0.02 * 3.0 + 0.02 * 2.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(frame.wrench.force_n, [-3.0, 0.0, -3.0], atol=1e-15)
    # about the hand: the pad's force has a lever of 0.12 m
    np.testing.assert_allclose(frame.wrench.torque_nm, [0.0, 0.06 + 0.24 + 0.02, 0.0], atol=1e-15)
    moved = [
        wrench.moved(Pose((0.1, 0.0, 0.0)) if link == "distal" else Pose())
        for link, wrench in frame.wrenches.items()
    ]
    np.testing.assert_allclose(sum(each.torque_nm for each in moved), frame.wrench.torque_nm, atol=1e-15)
    np.testing.assert_allclose(sum(each.covariance for each in moved), frame.wrench.covariance)


def test_links_move_with_the_joints_and_only_the_frame_of_the_hand_notices() -> None:
    frame = frame_of(pressed("palm", 1.0), pressed("pad", 2.0))
    bent = frame.at({"distal": Pose.from_rpy((0.0, 0.0, 0.1), (0.0, 0.0, np.pi)), "thumb": Pose()})
    np.testing.assert_allclose(bent.contacts[0].position_m, [-0.02, 0.0, 0.11], atol=1e-15)
    np.testing.assert_allclose(bent.contacts[1].position_m, frame.contacts[1].position_m)
    np.testing.assert_allclose(frame.contacts[0].position_m, [0.12, 0.0, 0.01], atol=1e-15)
    np.testing.assert_allclose(bent.wrenches["distal"].torque_nm, frame.wrenches["distal"].torque_nm)
    assert bent.distrust == frame.distrust
    with pytest.raises(ValueError, match=r"^link_poses: got 'hand', must be names of links"):
        frame.at({"hand": Pose()})
    with pytest.raises(ValueError, match=r"^link: got 'thumb', must be one of 'distal', 'hand'"):
        frame.contacts_on("thumb")


def test_every_patch_that_is_not_to_be_trusted_says_why() -> None:
    whole = frame_of(pressed("palm", 1.0), pressed("pad", 2.0), pressed("tip", 3.0))
    assert (whole.trusted, whole.precise, dict(whole.distrust)) == (True, True, {})
    frame = frame_of(
        pressed(
            "palm", 1.0, status=(Status.CONVERGED, Status.MAX_STEPS, Status.MAX_STEPS, Status.INCONSISTENT)
        ),
        pressed("pad", 2.0, distrust="crossing of upper wire 3 and lower wire 12 contradicts"),
        condition=Condition.LOST,
    )
    assert dict(frame.distrust) == {
        "palm": "not all wires CONVERGED: 2 MAX_STEPS, 1 INCONSISTENT",
        "pad": "crossing of upper wire 3 and lower wire 12 contradicts",
        "tip": "no field: lost",
    }
    assert not frame.trusted
    assert not frame.precise
    assert {c.patch: c.trusted for c in frame.contacts} == {"palm": False, "pad": False}


def test_the_wrench_of_a_link_is_trusted_if_all_its_patches_are() -> None:
    frame = frame_of(pressed("palm", 1.0), pressed("pad", 2.0))  # the tip is missing
    assert {link: wrench.trusted for link, wrench in frame.wrenches.items()} == {
        "distal": False,
        "hand": True,
    }
    assert not frame.wrench.trusted
    imprecise = frame_of(pressed("palm", 1.0), pressed("pad", 2.0, precise=False), pressed("tip", 1.0))
    assert (imprecise.trusted, imprecise.precise) == (True, False)


def take(frames: HandSubscription, count: int) -> list[HandFrame]:
    return list(itertools.islice(frames, count))


def test_of_a_running_hand(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        frames = take(host.hands(timeout_s=10), 10)
    assert [frame.scan for frame in frames] == list(range(frames[0].scan, frames[0].scan + 10))
    for frame in frames[1:]:  # the first SYNC may have been before
        assert frame.complete
        assert set(frame.fields) == set(frame.skeleton.mounts) == {"p0", "p1"}
        assert {one.stamp.t_sync_ns for one in frame.fields.values() if one.stamp} == {frame.t_sync_ns}


def test_one_after_the_other_as_async_for(hand: HandConfig, fleet: Fleet) -> None:
    async def gather(host: Host) -> list[HandFrame]:
        frames = []
        async for frame in host.hands(timeout_s=10):
            frames.append(frame)
            if len(frames) == 5:
                break
        return frames

    with Host.from_config(hand) as host:
        frames = run(gather(host))
    assert [frame.scan - frames[0].scan for frame in frames] == [0, 1, 2, 3, 4]


@pytest.mark.long
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
    table["buses"] = [
        {"name": f"can{i}", "interface": "timed", "channel": f"{channel}-{i}"} for i in range(2)
    ]
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
            with pytest.raises(
                ValueError, match=r"^SYNC producers: got 2, must be a single producer with a counter"
            ):
                host.hands()


@pytest.mark.long
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
