"""Events on a simulated bus. Times are in whole nanoseconds, rounded up from the exact time."""

from __future__ import annotations

import enum
from typing import NamedTuple

from vcan_sim.timed_bus.confinement import Counters
from vcan_sim.timed_bus.frame import CanFrame


class Cause(enum.StrEnum):
    """Cause of an error frame."""

    DISTURBED = "disturbed"
    """An injected disturbance inverted a bit."""
    COLLISION = "collision"
    """Another station sent a different frame with the same identifier."""
    NO_ACK = "not acknowledged"
    """No other station acknowledged the frame."""
    CUT_OFF = "cut off"
    """The transmitter was disconnected during its frame."""


class Delivered(NamedTuple):
    """Event: a frame was sent without error. The event time is the end of its last bit."""

    time_ns: int
    station: int
    """Station that sent the frame."""
    frame: CanFrame
    receivers: tuple[int, ...]
    """Stations that received the frame. If several stations sent the same frame at once, each has its own
    event, and only the first event lists the receivers."""
    queued_ns: int
    """Time at which the station queued the frame, in ns."""
    started_ns: int
    """Start of frame of the successful attempt, in ns."""


class ErrorFrame(NamedTuple):
    """Event: an error flag. The event time is the start of its first bit."""

    time_ns: int
    stations: tuple[int, ...]
    """Stations whose frame failed and will be retransmitted; empty if only a receiver lost the frame."""
    frames: tuple[CanFrame, ...]
    """Frame on the bus, or the colliding frames in the order of ``stations``."""
    bit: int
    """Position of the bit in which the error was detected; the start of frame is bit 0."""
    cause: Cause
    detected_by: tuple[int, ...]
    """Stations that detected the error in this bit. The other stations detect the error flag."""
    destroyed: bool
    """Whether the error flag destroyed the frame. Passive error flags from receivers do not."""


class CountersChanged(NamedTuple):
    """Event: a station's error counters changed."""

    time_ns: int
    station: int
    counters: Counters


class BusOff(NamedTuple):
    """Event: a station went bus-off. Its transmit queue is kept."""

    time_ns: int
    station: int


class Recovered(NamedTuple):
    """Event: a station recovered from bus-off. Both error counters are 0."""

    time_ns: int
    station: int


Event = Delivered | ErrorFrame | CountersChanged | BusOff | Recovered
