"""The page on ROS 2 names the messages that exist; its bus.yml is checked when its blocks run."""

from __future__ import annotations

import re

from rosbags.typesys import Stores, get_typestore

from skinnode.messages.definitions import DEFINITIONS, OURS

from .blocks import DOCS

PAGE = (DOCS / "ros2.md").read_text(encoding="utf-8")
_MESSAGE = re.compile(r"`(\w+_(?:msgs|interfaces)/\w+)`")
NAMED = set(_MESSAGE.findall(PAGE.split("| message | content |")[1].split("\n\n")[0]))


def test_messages_of_the_table_are_all_of_ours_and_standard_ones() -> None:
    named = {name.replace("/", "/msg/") for name in NAMED}
    ours = {name for name in named if name.startswith(OURS)}
    assert ours == {name for name in DEFINITIONS if name.startswith(OURS)}
    assert named - ours < set(get_typestore(Stores.ROS2_JAZZY).fielddefs)


def test_every_message_that_is_recorded_is_in_the_table() -> None:
    recordings = (DOCS / "recordings.md").read_text(encoding="utf-8")
    recorded = set(_MESSAGE.findall(recordings.split("## Topics of an MCAP file")[1].split("\n## ")[0]))
    assert len(recorded) > 8
    assert recorded - NAMED == {"can_msgs/Frame", "ros2_socketcan_msgs/FdFrame"}  # raw frames: under "Bags"
