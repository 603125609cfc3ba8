"""Messages of ROS 2, held against rosbags and, by foreign code, against what they were made of."""

from __future__ import annotations

import dataclasses
import random
import re

import numpy as np
import pytest

from skinnode.config import parse_hand
from skinnode.host.health import BusHealth, Condition, PatchHealth
from skinnode.host.skeleton import Skeleton
from skinnode.messages.can_frames import FrameEncoder, frame_message, frame_of
from skinnode.messages.definitions import DEFINITIONS, FIELD, OURS, version_of
from skinnode.messages.health import ERROR, OK, STALE, WARN, diagnostics, level_of
from skinnode.messages.poses import transforms
from skinnode.messages.topics import HandTopics, patch_frame
from skinnode.messages.typestore import decode, encode, schema_text
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.transport.bus_state import BusState
from skinnode.transport.frame import Frame

T_NS = 1_790_000_000_123_456_789


@pytest.mark.parametrize("bus", ["c", "can", "can0", "can00", "bus number 7", "hände"])
def test_the_fast_encoder_writes_the_bytes_of_rosbags(bus: str) -> None:
    rng, encoder = random.Random(bus), FrameEncoder(bus)
    for _ in range(300):
        fd = rng.random() < 0.5
        data = rng.randbytes(rng.choice((0, 1, 8, 12, 20, 64)) if fd else rng.randrange(9))
        remote = not fd and rng.random() < 0.3
        flags = (remote, rng.random() < 0.3, rng.random() < 0.5, fd)
        frame = Frame(rng.randrange(1 << 29), data, rng.randrange(2_000_000_000 * 10**9), *flags)
        name, message = frame_message(frame, bus)
        assert encoder.encode(frame) == encode(message, name)
        assert decode(encoder.encode(frame), name).header.frame_id == bus
        assert frame_of(encoder.encode(frame), name) == frame


def test_a_time_that_the_message_cannot_hold_is_the_nearest() -> None:
    for t_ns, kept_s in ((-5, 0), (10**20, 2**31 - 1)):
        data = FrameEncoder("can0").encode(Frame(5, b"", t_ns))
        assert decode(data, "can_msgs/msg/Frame").header.stamp.sec == kept_s


def test_messages_of_ours_have_a_version_in_their_schema() -> None:
    ours = [name for name in DEFINITIONS if name.startswith(OURS)]
    assert len(ours) == 7
    for name in ours:
        wanted = 2 if name == FIELD else 1
        assert version_of(schema_text(name)) == version_of(DEFINITIONS[name]) == wanted


def test_topics_are_valid_names_and_differ() -> None:
    bus = {"name": "can-0", "interface": "virtual"}
    names = ["a-b", "a_b", "a b", "2nd", "Däumling", "_"]
    patches = [{"name": name, "node_id": 5 + i, "bus": "can-0"} for i, name in enumerate(names)]
    topics = HandTopics.of(parse_hand({"name": "left hand", "buses": [bus], "patches": patches}))
    found = [topics.events, topics.journal, *topics.buses["can-0"]]
    found += [topic for each in topics.patches.values() for topic in each]
    assert len(found) == len(set(found)) == 2 + 4 + 5 * len(names)
    for topic in found:
        assert re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", topic), topic
        assert "__" not in topic
        assert topic.startswith("/left_hand/")


def test_poses_are_those_of_the_hand_file_and_no_frame_is_its_own_parent() -> None:
    hand = parse_hand(
        {
            "buses": [{}],
            "links": [{"name": "palm", "pose": {"position_m": [0.1, 0.2, 0.3]}}],
            "patches": [
                {"name": "palm", "node_id": 5, "link": "palm", "pose": {"position_m": [0.0, 0.0, 0.01]}},
                {"name": "back", "node_id": 6},
            ],
        }
    )
    message = transforms(Skeleton.of(hand), T_NS)
    message = decode(encode(message, "tf2_msgs/msg/TFMessage"), "tf2_msgs/msg/TFMessage")
    found = {each.child_frame_id: (each.header.frame_id, each.transform) for each in message.transforms}
    assert {child: parent for child, (parent, _) in found.items()} == {
        "palm": "hand",
        patch_frame("palm"): "palm",
        patch_frame("back"): "hand",
    }
    moved = found["palm"][1].translation
    assert (moved.x, moved.y, moved.z) == (0.1, 0.2, 0.3)
    assert found[patch_frame("palm")][1].translation.z == 0.01
    assert found[patch_frame("palm")][1].rotation.w == 1.0


def health(condition: Condition, **more: object) -> PatchHealth:
    return PatchHealth("palm", 5, condition, 5, 0.1, None, 1, 0, None, "", 0, **more)  # type: ignore[arg-type]


def test_health_becomes_a_level_a_message_and_every_known_value() -> None:
    fault = DataFault(FaultyPart.UPPER, FaultKind.OPEN, upper=3)
    assert level_of(health(Condition.OPERATIONAL)) == OK
    assert level_of(health(Condition.OPERATIONAL, faults=(fault,))) == WARN
    assert level_of(health(Condition.OPERATIONAL, duplicate_id=True)) == ERROR
    assert level_of(health(Condition.LOST)) == STALE
    assert level_of(health(Condition.REFUSED)) == ERROR
    patches = {"palm": health(Condition.LOST, faults=(fault,))}
    name = "diagnostic_msgs/msg/DiagnosticArray"
    (status,) = decode(encode(diagnostics("left", patches, {}, T_NS), name), name).status
    assert (status.name, status.hardware_id, status.level) == ("left: palm", "node 5", STALE)
    assert status.message == "lost: no heartbeat from node 5 for 0.1 s"
    values = {each.key: each.value for each in status.values}
    assert values["faults"] == "upper wire 3: open since scan 0"
    assert values["boot_ups"] == "1"
    assert "scan_age_s" not in values  # unknown


@pytest.mark.parametrize(
    ("changes", "level", "message"),
    [
        ({}, OK, "available"),
        ({"controller": BusState.ACTIVE}, OK, "available"),
        ({"controller": BusState.WARNING}, WARN, "the controller is error warning"),
        ({"controller": BusState.PASSIVE}, WARN, "the controller is error passive"),
        ({"controller": BusState.OFF}, ERROR, "the controller is bus-off"),
        ({"controller": BusState.OFF, "away": "no such device"}, ERROR, "no such device"),
        ({"no_sync": True}, ERROR, "no SYNC"),
    ],
)
def test_a_bus_whose_controller_is_not_well_is_not_ok(changes, level, message) -> None:
    counters = [entry.name for entry in dataclasses.fields(BusHealth) if entry.default is dataclasses.MISSING]
    sound = BusHealth(**{**dict.fromkeys(counters, 0), "bus": "can0", "away": None, "foreign_ids": ()})
    buses = {"can0": dataclasses.replace(sound, **changes)}
    name = "diagnostic_msgs/msg/DiagnosticArray"
    (status,) = decode(encode(diagnostics("left", {}, buses, T_NS), name), name).status
    assert (status.name, status.hardware_id) == ("left: can0", "can0")
    assert (status.level, status.message) == (level, message)


@pytest.mark.parametrize(
    ("what", "log_level", "colour"),
    [("touched", 20, "good"), ("back", 20, "good"), ("booting", 30, "note"), ("lost", 40, "bad")],
)
def test_an_event_is_as_serious_in_a_recording_as_in_the_monitor(what, log_level, colour) -> None:
    from skinnode.host.events import HealthEvent
    from skinnode.messages.health import log_message
    from skinnode.monitor.view_model import log_line

    event = HealthEvent(T_NS, "palm", what, "text")
    name = "rcl_interfaces/msg/Log"
    assert decode(encode(log_message(event, T_NS), name), name).level == log_level
    assert log_line(event, 0).level == colour


def test_masks_and_numbers_of_a_point_cloud_keep_their_order() -> None:
    from skinnode.messages.fields import CLOUD_FIELDS, point_cloud
    from skinnode.model.frames import FieldFrame, ScanStamp, SolveStats
    from skinnode.model.status import Status

    rng = np.random.default_rng(1)
    rest_m, displacement_m = rng.normal(size=(2, 2, 3, 3))
    field = FieldFrame(
        displacement_m,
        np.abs(displacement_m),
        (Status.CONVERGED,) * 2,
        np.zeros(2),
        SolveStats(1, 1, 1, 0.0),
        stamp=ScanStamp("palm", 1, 1, 0, 5, 6, 7),
    )
    cloud = point_cloud(field, rest_m, T_NS)
    assert (cloud.height, cloud.width, cloud.is_dense) == (2, 3, False)  # no forces: NaN
    dtype = np.dtype({"names": [f.name for f in cloud.fields], "formats": ["<f4"] * len(cloud.fields)})
    points = cloud.data.tobytes()
    table = np.frombuffer(points, dtype=dtype).reshape(2, 3)
    assert table.dtype.names == CLOUD_FIELDS
    assert [f.offset for f in cloud.fields] == [dtype.fields[name][1] for name in dtype.names]  # type: ignore[index, union-attr]
    np.testing.assert_array_equal(table["y"], (rest_m + displacement_m)[..., 1].astype("f4"))
    np.testing.assert_array_equal(table["dz"], displacement_m[..., 2].astype("f4"))
    assert np.isnan(table["fx"]).all()
    np.testing.assert_array_equal(table["share_z"], 1.0)
