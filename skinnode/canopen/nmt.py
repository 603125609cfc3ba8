"""Network management (CiA 301 v4.2, 7.3.2): states, commands, and the services available in each state.

================  ===================  ===========================================================
state             entered by           served
================  ===================  ===========================================================
INITIALISING      power, both resets   nothing; ends with the boot-up message
PRE_OPERATIONAL   itself, command 128  SDO, SYNC, TIME, EMCY, NMT, error control
OPERATIONAL       command 1            the same, and PDO
STOPPED           command 2            NMT, error control
================  ===================  ===========================================================

A node obeys every command in every state except INITIALISING, in which it does not receive commands. *Reset
node* (129) resets all objects to their defaults; *reset communication* (130) resets only the objects from
0x1000 to 0x1FFF. The node boots after either command.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from skinnode.text.words import counted

ALL_NODES: Final = 0
"""Node-ID in an NMT command that addresses every node on a bus."""

STATE_MASK: Final = 0x7F
"""Bits of a heartbeat or guarding response that hold the state."""

GUARD_TOGGLE: Final = 0x80
"""Bit of a guarding response that toggles with each response."""


class NmtState(IntEnum):
    """NMT states, with the values sent in heartbeats. A node without power also counts as INITIALISING."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127

    @property
    def communicates(self) -> bool:
        """Whether the SDO, SYNC, TIME and EMCY services are available."""
        return self in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)


class NmtCommand(IntEnum):
    """Command specifiers."""

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
"""Names of the states for display."""

AFTER_COMMAND: Final = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}
"""State after each command other than the resets."""


def state_name(state: int) -> str:
    """Return the name of a state for display, or ``state N`` for a number that CiA 301 does not define.

    Args:
        state: the state byte of a heartbeat, without the toggle bit.
    """
    return STATE_NAMES.get(state, f"state {state}")


def encode(command: NmtCommand, node_id: int) -> bytes:
    """Return the data of an NMT frame, which is sent on COB-ID 0.

    Args:
        command: the command specifier.
        node_id: 1 to 127, or :data:`ALL_NODES`.
    """
    return bytes((command, node_id))


def parse(data: bytes, node_id: int) -> NmtCommand | None:
    """Return the command in a frame on COB-ID 0; None if the frame addresses another node.

    Args:
        data: the payload.
        node_id: the node-ID of this node.

    Raises:
        ValueError: if the payload is not two bytes long, or the specifier is unknown.
    """
    if len(data) != 2:
        raise ValueError(f"NMT: got {counted(len(data), 'byte')}, must be 2")
    return NmtCommand(data[0]) if data[1] in (0, node_id) else None
