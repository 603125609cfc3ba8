"""Network management (CiA 301 v4.2, 7.3.2): NMT states and commands.

================  ===================  ===========================================================
state             entered by           served
================  ===================  ===========================================================
INITIALISING      power, both resets   nothing; ends with the boot-up message
PRE_OPERATIONAL   itself, command 128  SDO, SYNC, TIME, EMCY, NMT, error control
OPERATIONAL       command 1            the same, and PDO
STOPPED           command 2            NMT, error control
================  ===================  ===========================================================

A node obeys NMT commands in every state except INITIALISING. *Reset node* (129) sets all objects to their
power-on values. *Reset communication* (130) does so only for objects 0x1000 to 0x1FFF. Then the node boots.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from skinnode.text.words import counted

ALL_NODES: Final = 0
"""Node-ID in an NMT command that addresses all nodes on the bus."""

STATE_MASK: Final = 0x7F
"""Mask of the NMT state in a heartbeat or guarding response."""

GUARD_TOGGLE: Final = 0x80
"""Bit that a node toggles in each guarding response."""


class NmtState(IntEnum):
    """NMT states, with their values in heartbeats. This project treats switched-off nodes as INITIALISING."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127

    @property
    def communicates(self) -> bool:
        """Whether the SDO, SYNC, TIME and EMCY services are available in this state."""
        return self in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)


class NmtCommand(IntEnum):
    """NMT command specifiers."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


STATE_NAMES: Final[dict[int, str]] = {
    NmtState.INITIALISING: "booting",
    NmtState.STOPPED: "stopped",
    NmtState.OPERATIONAL: "operational",
    NmtState.PRE_OPERATIONAL: "pre-operational",
}
"""Display names of the NMT states."""

AFTER_COMMAND: Final = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}
"""NMT state that a node enters after each command except the two resets."""


def state_name(state: int) -> str:
    """Return the name of an NMT state for display; ``state N`` if CiA 301 does not define it.

    Args:
        state: state byte of a heartbeat, without the toggle bit.
    """
    return STATE_NAMES.get(state, f"state {state}")


def encode(command: NmtCommand, node_id: int) -> bytes:
    """Return the payload of an NMT command.

    Args:
        command: command specifier.
        node_id: 1 to 127, or :data:`ALL_NODES`.
    """
    return bytes((command, node_id))


def parse(data: bytes, node_id: int) -> NmtCommand | None:
    """Return the NMT command in a frame, or None if it addresses another node.

    Args:
        data: payload of the frame.
        node_id: node-ID of this node.

    Raises:
        ValueError: if the payload is not two bytes long, or if the command specifier is unknown.
    """
    if len(data) != 2:
        raise ValueError(f"NMT command: got {counted(len(data), 'byte')}, must be 2 bytes")
    return NmtCommand(data[0]) if data[1] in (0, node_id) else None
