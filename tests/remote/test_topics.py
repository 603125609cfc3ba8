"""What a program without skinnode sees of a published hand: topics, tokens and standard messages of ROS 2."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zenoh
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_typestore

import skinnode as sk
from skinnode.messages.typestore import schema_text
from tests.remote.conftest import Process, eventually

pytestmark = pytest.mark.system_time

DDS = {
    "field": "sensor_msgs/msg/PointCloud2",
    "contact_wrenches": "geometry_msgs/msg/WrenchStamped",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "tf_static": "tf2_msgs/msg/TFMessage",
}


def key_of(topic: str, message: str) -> str:
    """As rmw_zenoh makes it, with the hash of the message from the standard definitions."""
    package, kind, name = message.split("/")
    return (
        f"0/{topic}/{package}::{kind}::dds_::{name}_/{get_typestore(Stores.ROS2_JAZZY).hash_rihs01(message)}"
    )


def test_ros_2_programs_see_the_hand(
    start: Callable[..., Process], session: zenoh.Session, port: int
) -> None:
    start(name="left hand").wait_until_up()
    eventually(lambda: session.info.peers_zid())
    tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/0/**") if reply.ok]
    names = [token.split("/")[5:] for token in tokens]
    assert ["NN", "%", "%", "skinnode"] in names
    topics = {parts[4]: parts[5] for parts in names if parts[0] == "MP"}
    assert topics["%left_hand%p1%field"] == "sensor_msgs::msg::dds_::PointCloud2_"
    assert topics["%diagnostics"] == "diagnostic_msgs::msg::dds_::DiagnosticArray_"
    assert len({token.split("/")[4] for token in tokens}) == len(tokens)  # every entity has its number

    samples: list[Any] = []
    key = key_of("left_hand/p0/field", DDS["field"])
    subscriber = session.declare_subscriber(key, samples.append)
    eventually(lambda: len(samples) > 5)
    subscriber.undeclare()
    read = generate_dynamic(DDS["field"], schema_text(DDS["field"]))[DDS["field"]]
    cloud = read(samples[0].payload.to_bytes())
    assert (cloud.height, cloud.width, cloud.header.frame_id) == (4, 4, "skin/p0")
    names_of = [each.name for each in cloud.fields]
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(4, 4, len(names_of))
    rest = points[..., :3] - points[..., 3:6]
    with sk.connect("left hand", port=port) as hand:
        assert rest == pytest.approx(hand.layout("p0").upper_m, abs=1e-7)
    numbers = [struct.unpack_from("<q", sample.attachment.to_bytes())[0] for sample in samples]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert all(len(sample.attachment.to_bytes()) == 33 for sample in samples)


@pytest.mark.parametrize(
    ("topic", "message"), [("diagnostics", DDS["diagnostics"]), ("tf_static", DDS["tf_static"])]
)
def test_health_and_poses_arrive(
    start: Callable[..., Process], session: zenoh.Session, topic: str, message: str
) -> None:
    start().wait_until_up()
    samples: list[Any] = []
    session.declare_subscriber(key_of(topic, message), samples.append)
    eventually(lambda: samples)
    read = generate_dynamic(message, schema_text(message))[message](samples[0].payload.to_bytes())
    if topic == "diagnostics":
        assert [each.name for each in read.status] == ["hand: p0", "hand: p1", "hand: can0"]
    else:
        assert {each.child_frame_id for each in read.transforms} == {"skin/p0", "skin/p1"}
