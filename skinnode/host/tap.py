"""Where somebody who writes down what passes through a host is let in."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Protocol

from skinnode.host.link import BusLink
from skinnode.host.pipeline import Lane, LaneTap
from skinnode.transport import Frame


class HostTap(LaneTap, Protocol):
    """Who writes down all frames and what else decides what a host makes of them. Never waits."""

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """A batch that is about to be dealt out. On the mainline of the bus, as what a lane says is."""

    def sent(self, bus: str, frame: Frame) -> None:
        """A frame that the interface has taken. On whatever thread sent it."""


def tap_link(tap: HostTap, link: BusLink) -> None:
    """From now on ``tap`` hears of every frame."""
    link.listen(functools.partial(tap.received, link.config.name))
    link.listen_to_sent(functools.partial(tap.sent, link.config.name))


def tap_lane(tap: HostTap, lane: Lane) -> None:
    """From now on ``tap`` hears of the lane; first of how it is. Mainline."""
    lane.tap = tap
    lane.tell_tap()
