"""Events on the bus. Times are whole nanoseconds, rounded up from the exact time."""

from __future__ import annotations

import enum
from typing import NamedTuple

from vcan_sim.timed_bus.confinement import Counters
from vcan_sim.timed_bus.frame import CanFrame


class Cause(enum.StrEnum):
    """Cause of an error frame."""

    DISTURBED = "disturbed"
    """An injected disturbance."""
    COLLISION = "collision"
    """Another station sent a different frame with the same identifier."""
    NO_ACK = "not acknowledged"
    """No other station received the frame."""
    CUT_OFF = "cut off"
    """The transmitter was disconnected during its frame."""


class Delivered(NamedTuple):
    """Frame that was sent without error, at the last bit of its end of frame."""

    time_ns: int
    station: int
    """Station that sent the frame."""
    frame: CanFrame
    receivers: tuple[int, ...]
    """Stations that received the frame; empty if another station sent the same bits in the same instant, and
    the event of that station names the receivers."""
    queued_ns: int
    """Time at which the station handed in the frame."""
    started_ns: int
    """Time of the start of frame of the successful attempt."""


class ErrorFrame(NamedTuple):
    """Error flag, at the start of its first bit."""

    time_ns: int
    stations: tuple[int, ...]
    """Stations whose frame failed; they send it again. Empty if only a receiver lost the frame."""
    frames: tuple[CanFrame, ...]
    """Frame on the bus; several if different frames collided, in the order of ``stations``."""
    bit: int
    """Position of the bit in which the error was detected, counted from the start of frame at 0."""
    cause: Cause
    detected_by: tuple[int, ...]
    """Stations that detected the error in this bit; other stations detect it by the error flag."""
    destroyed: bool
    """Whether the error flag destroyed the frame; passive error flags of receivers do not."""


class CountersChanged(NamedTuple):
    """Change of a station's error counters."""

    time_ns: int
    station: int
    counters: Counters


class BusOff(NamedTuple):
    """Start of a station's bus-off state; its queue is kept."""

    time_ns: int
    station: int


class Recovered(NamedTuple):
    """End of a station's bus-off state, with both error counters at 0."""

    time_ns: int
    station: int


Event = Delivered | ErrorFrame | CountersChanged | BusOff | Recovered
