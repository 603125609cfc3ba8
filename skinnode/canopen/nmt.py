"""Network management (CiA 301 v4.2, 7.3.2): states, commands, and the services available in each state.

================  ===================  ===========================================================
state             entered by           served
================  ===================  ===========================================================
INITIALISING      power, both resets   nothing; ends with the boot-up message
PRE_OPERATIONAL   itself, command 128  SDO, SYNC, TIME, EMCY, NMT, error control
OPERATIONAL       command 1            the same, and PDO
STOPPED           command 2            NMT, error control
================  ===================  ===========================================================

A node executes NMT commands in every state except INITIALISING, in which it receives no commands. The command
*reset node* (129) resets all objects to their power-on values. The command *reset communication* (130) resets
only the objects from 0x1000 to 0x1FFF. The node boots after *reset node* or *reset communication*.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from skinnode.text.words import counted

ALL_NODES: Final = 0
"""Node-ID in an NMT command that addresses all nodes on the bus."""

STATE_MASK: Final = 0x7F
"""Mask for the NMT state in a heartbeat or guarding response."""

GUARD_TOGGLE: Final = 0x80
"""Bit that toggles with each guarding response from a node."""


class NmtState(IntEnum):
    """NMT states, with their values in heartbeats.

    In this project, a node that is switched off also has the state INITIALISING.
    """

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
"""Names of the NMT states, for display."""

AFTER_COMMAND: Final = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}
"""NMT state that a node enters after each command, excluding the two reset commands."""


def state_name(state: int) -> str:
    """Return the name of an NMT state for display, or ``state N`` if CiA 301 does not define the state.

    Args:
        state: state byte of a heartbeat, without the toggle bit.
    """
    return STATE_NAMES.get(state, f"state {state}")


def encode(command: NmtCommand, node_id: int) -> bytes:
    """Return the payload of an NMT command, which is sent with COB-ID 0.

    Args:
        command: the command specifier.
        node_id: 1 to 127, or :data:`ALL_NODES`.
    """
    return bytes((command, node_id))


def parse(data: bytes, node_id: int) -> NmtCommand | None:
    """Return the NMT command in a frame with COB-ID 0; None if the frame addresses another node.

    Args:
        data: payload of the frame.
        node_id: the node-ID of this node.

    Raises:
        ValueError: if the payload is not two bytes long, or if the command specifier is unknown.
    """
    if len(data) != 2:
        raise ValueError(f"NMT command: got {counted(len(data), 'byte')}, must be 2 bytes")
    return NmtCommand(data[0]) if data[1] in (0, node_id) else None
