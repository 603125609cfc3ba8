"""Network management: states and commands of CiA 301 v4.2, 7.3.2, and what a node may do in each state.

================  ===================  ===========================================================
state             entered by           served
================  ===================  ===========================================================
INITIALISING      power, both resets   nothing; ends by itself with the boot-up message
PRE_OPERATIONAL   itself, command 128  SDO, SYNC, TIME, EMCY, NMT, error control
OPERATIONAL       command 1            the same, and PDO
STOPPED           command 2            NMT, error control
================  ===================  ===========================================================

Every command is obeyed in every state but INITIALISING, which it does not reach. Reset node (129) gives all
objects their defaults, reset communication (130) those from 0x1000 to 0x1FFF; the node boots up after both.
"""

from __future__ import annotations

from enum import IntEnum

from skinnode.text.words import counted


class NmtState(IntEnum):
    """States; the value is what the heartbeat carries. A node without power is INITIALISING too: it is
    silent."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127

    @property
    def communicates(self) -> bool:
        """SDO, SYNC, TIME and EMCY are served."""
        return self in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)


class NmtCommand(IntEnum):
    """Command specifiers."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


AFTER_COMMAND = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


def parse(data: bytes, node_id: int) -> NmtCommand | None:
    """The command a frame on COB-ID 0 holds for ``node_id``; None for another node's. Raises ValueError for
    what is no command: not two bytes, or an unknown specifier."""
    if len(data) != 2:
        raise ValueError(f"NMT: got {counted(len(data), 'byte')}, must be 2")
    return NmtCommand(data[0]) if data[1] in (0, node_id) else None
