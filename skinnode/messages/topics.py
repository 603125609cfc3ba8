"""Defines the names of a hand's ROS 2 topics and of its patches' coordinate frames.

A ROS 2 name contains only letters, digits and underscores. Any other character in a name from the hand file
becomes an underscore.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from skinnode.config import HandConfig

DIAGNOSTICS: Final = "/diagnostics"
TF_STATIC: Final = "/tf_static"


class PatchTopics(NamedTuple):
    """Topics of a patch."""

    field: str
    field_info: str
    contacts: str
    contact_wrenches: str
    full_field: str


class BusTopics(NamedTuple):
    """Topics of a bus, named as in ros2_socketcan."""

    received: str
    sent: str
    received_fd: str
    sent_fd: str


@dataclass(frozen=True, slots=True)
class HandTopics:
    """Topics of a hand."""

    patches: dict[str, PatchTopics]
    buses: dict[str, BusTopics]
    base: str
    """Namespace of the hand."""
    events: str
    health: str
    journal: str

    @staticmethod
    def base_of(hand: str) -> str:
        """Return the namespace of the hand named ``hand``."""
        return f"/{ros_names([hand])[hand]}"

    @classmethod
    def of(cls, hand: HandConfig) -> HandTopics:
        """Return the topics of a hand."""
        base = cls.base_of(hand.name)
        patches = ros_names([patch.name for patch in hand.patches])
        buses = ros_names([bus.name for bus in hand.buses])
        return cls(
            {
                name: PatchTopics(*(f"{base}/{token}/{part}" for part in PatchTopics._fields))
                for name, token in patches.items()
            },
            {
                name: BusTopics(
                    *(
                        f"{base}/{token}/{part}"
                        for part in ("from_can_bus", "to_can_bus", "from_can_bus_fd", "to_can_bus_fd")
                    )
                )
                for name, token in buses.items()
            },
            base,
            f"{base}/events",
            f"{base}/health",
            f"{base}/journal",
        )


def patch_frame(patch: str) -> str:
    """Return the name of a patch's coordinate frame.

    The prefix distinguishes a patch from a link with the same name. Links keep their names, and the hand's
    frame is ``hand``.
    """
    return f"skin/{patch}"


def ros_names(names: Iterable[str]) -> dict[str, str]:
    """Return a valid and unique ROS 2 name for each name in a hand file."""
    tokens: dict[str, str] = {}
    for name in names:
        token = re.sub("[^A-Za-z0-9_]", "_", name) or "_"
        token = re.sub("__+", "_", f"_{token}" if token[0].isdigit() else token)
        while token in tokens.values():
            token += "x"
        tokens[name] = token
    return tokens
