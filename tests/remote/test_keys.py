"""Keys and attachments, held against the design document of rmw_zenoh and against Zenoh itself."""

from __future__ import annotations

import pytest
import zenoh
from zenoh.ext import Int64, z_serialize

from skinnode.errors import ConfigError
from skinnode.remote import keys
from skinnode.remote.attachment import Attachment

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"
TALKER = (
    "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/"
    f"%chatter/std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
)
LISTENER = "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
"""Examples of docs/design.md in ros2/rmw_zenoh."""


def test_keys_are_those_of_rmw_zenoh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert keys.topic_key("/chatter", "std_msgs/msg/String") == CHATTER
    token = keys.publisher_token("8b20917502ee955ac4476e0266340d5c", 10, "/chatter", "std_msgs/msg/String")
    default_depth = TALKER.replace("talker", "skinnode").replace("::,7:", "::,:")
    assert token == default_depth  # the example's publisher keeps 7 messages, ours the default of rmw_zenoh
    assert keys.node_token("aac3178e146ba6f1fc6e6a4085e77f21") == LISTENER.replace("listener", "skinnode")
    monkeypatch.setenv("ROS_DOMAIN_ID", "2")
    assert keys.topic_key("/robot1/chatter", "std_msgs/msg/String") == "2/robot1" + CHATTER[1:]


@pytest.mark.parametrize("text", ["-1", "233", "1.5", "x", "1/2"])
def test_a_wrong_domain_is_refused(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(ConfigError, match=r"ROS_DOMAIN_ID: got .*, allowed: an integer from 0 to 232"):
        keys.domain()


def test_attachments_are_those_of_zenoh() -> None:
    gid = bytes(range(16))
    for sequence, sent_ns in ((1, 1_790_000_000_123_456_789), (2**62, 0), (7, -5)):
        theirs = z_serialize((Int64(sequence), Int64(sent_ns), gid)).to_bytes()
        assert Attachment(sequence, sent_ns, gid).encode() == theirs
        assert Attachment.decode(theirs) == (sequence, sent_ns, gid)
    for wrong in (b"", b"x" * 32, b"x" * 33, b"x" * 34):
        with pytest.raises(ValueError, match=r"attachment"):
            Attachment.decode(wrong)


@pytest.mark.parametrize("name", ["hand", "left hand", "a/b", "**", "*", "$*", "#?", "Däumling", "%25", "@x"])
def test_every_name_of_a_hand_fits_into_keys(name: str) -> None:
    token = zenoh.KeyExpr(keys.hand_token(name, "8b20"))
    assert keys.hand_of(str(token)) == name
    assert keys.zid_of(str(token)) == "8b20"
    others = [other for other in ("hand", "x", "**", "a/b") if other != name]
    assert zenoh.KeyExpr(keys.hand_tokens()).includes(token)
    assert zenoh.KeyExpr(keys.hand_tokens(name)).includes(token)
    assert not any(zenoh.KeyExpr(keys.hand_tokens(other)).intersects(token) for other in others)
    zenoh.KeyExpr(keys.description_key(name))
    zenoh.KeyExpr(keys.command_key(name))
