"""Fault confinement states of a CAN controller (ISO 11898-1), decoded from SocketCAN error frames.

<linux/can/error.h> defines the format of error frames.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from skinnode.transport.frame import Frame

_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100
_WARNING, _PASSIVE, _ACTIVE = 0x0C, 0x30, 0x40
_CONTROLLER_BYTE: Final = 1


class BusState(StrEnum):
    """Fault confinement state of a CAN controller."""

    ACTIVE = "error active"
    WARNING = "error warning"
    """An error counter has reached the warning limit. The controller is still error active."""
    PASSIVE = "error passive"
    """An error counter has reached the error passive limit. The controller still sends and receives."""
    OFF = "bus-off"
    """The controller neither sends nor receives."""


def bus_state(frame: Frame) -> BusState | None:
    """Return the state that a SocketCAN error frame reports, or None if it reports no state."""
    if frame.can_id & _BUS_OFF:
        return BusState.OFF
    if frame.can_id & _RESTARTED:
        return BusState.ACTIVE
    if frame.can_id & _CONTROLLER and len(frame.data) > _CONTROLLER_BYTE:
        bits = frame.data[_CONTROLLER_BYTE]
        if bits & _PASSIVE:
            return BusState.PASSIVE
        if bits & _WARNING:
            return BusState.WARNING
        if bits & _ACTIVE:
            return BusState.ACTIVE
    return None
