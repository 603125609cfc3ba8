"""Defines the Zenoh key expressions for a daemon's topics, liveliness tokens and services.

Topics and their tokens follow rmw_zenoh (docs/design.md and liveliness_utils.cpp of ros2/rmw_zenoh), so that
programs on ROS 2 Jazzy or later can see them::

    topic      DOMAIN/TOPIC/TYPE/HASH
    publisher  @ros2_lv/DOMAIN/ZID/NODE/ENTITY/MP/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS
    node       @ros2_lv/DOMAIN/ZID/NODE/NODE/NN/ENCLAVE/NAMESPACE/NAME

In a token, ``%`` replaces ``/``, and a lone ``%`` stands for the empty name. The other keys, which start with
``skinnode``, have no counterpart in ROS 2.
"""

from __future__ import annotations

import functools
import os
import re
from typing import Final
from urllib.parse import quote, unquote

from skinnode.errors import ConfigError
from skinnode.messages.typestore import typestore

_NODE: Final = "skinnode"
"""Name of the ROS 2 node that represents the daemon."""
_QOS: Final = "::,:,:,:,,"
"""rmw_zenoh's encoding of its default QoS: reliable, volatile, keep last 42 (``qos.cpp``)."""
_HIGHEST_DOMAIN: Final = 232
"""Highest domain ID that ROS 2 accepts."""


def domain() -> int:
    """Return the ROS 2 domain given by the environment variable ``ROS_DOMAIN_ID``; 0 by default.

    Raises:
        ConfigError: if the variable is not an integer from 0 to 232.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not re.fullmatch("[0-9]{1,3}", text) or int(text) > _HIGHEST_DOMAIN:
        raise ConfigError("ROS_DOMAIN_ID", text, f"an integer from 0 to {_HIGHEST_DOMAIN}")
    return int(text)


def dds_type(message: str) -> str:
    """Return the DDS type of a message: ``std_msgs::msg::dds_::String_`` for ``std_msgs/msg/String``."""
    package, kind, name = message.split("/")
    return f"{package}::{kind}::dds_::{name}_"


@functools.cache
def type_hash(message: str) -> str:
    """Return the RIHS01 hash of a message definition (REP-2016), as computed by rosbags."""
    return str(typestore().hash_rihs01(message))


def topic_key(topic: str, message: str) -> str:
    """Return the key of a topic.

    Args:
        topic: Name of the topic, with a leading slash.
        message: Name of the message, such as ``std_msgs/msg/String``.
    """
    return f"{domain()}/{topic.strip('/')}/{dds_type(message)}/{type_hash(message)}"


def node_token(zid: str) -> str:
    """Return the liveliness token of the daemon's ROS 2 node.

    Args:
        zid: ID of the Zenoh session.
    """
    return f"@ros2_lv/{domain()}/{zid}/0/0/NN/%/%/{_NODE}"


def publisher_token(zid: str, entity: int, topic: str, message: str) -> str:
    """Return the liveliness token of a ROS 2 publisher.

    Args:
        zid: ID of the Zenoh session.
        entity: Number of the publisher in the session, from 1; the node is number 0.
        topic: Name of the topic, with a leading slash.
        message: Name of the message.
    """
    mangled = topic.replace("/", "%")
    what = f"{mangled}/{dds_type(message)}/{type_hash(message)}"
    return f"@ros2_lv/{domain()}/{zid}/0/{entity}/MP/%/%/{_NODE}/{what}/{_QOS}"


def hand_token(hand: str, zid: str) -> str:
    """Return the liveliness token with which a daemon claims a hand."""
    return f"skinnode/{domain()}/hands/{_quoted(hand)}/{zid}"


def hand_tokens(hand: str | None = None) -> str:
    """Return the key expression for the tokens of a hand's daemons, or of all daemons if ``hand`` is None."""
    return f"skinnode/{domain()}/hands/{'*' if hand is None else _quoted(hand)}/*"


def hand_of(token: str) -> str:
    """Return the name of the hand that a token claims."""
    return unquote(token.split("/")[3])


def zid_of(token: str) -> str:
    """Return the ID of the session that declared a hand's token."""
    return token.split("/")[4]


def description_key(hand: str) -> str:
    """Return the key at which a daemon describes its hand."""
    return f"skinnode/{domain()}/description/{_quoted(hand)}"


def command_key(hand: str) -> str:
    """Return the key at which a daemon accepts commands."""
    return f"skinnode/{domain()}/command/{_quoted(hand)}"


def _quoted(hand: str) -> str:
    """Return a hand's name with all special characters percent-encoded, as key expressions require."""
    return quote(hand, safe="")
