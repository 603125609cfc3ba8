"""Network management: states and commands of CiA 301 v4.2, 7.3.2, and what a node may do in each state."""

from __future__ import annotations

from enum import IntEnum


class NmtState(IntEnum):
    """States; the value is what the heartbeat carries. A node without power is INITIALISING too: it is
    silent."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127

    @property
    def communicates(self) -> bool:
        """SDO, SYNC and EMCY are served."""
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
    """The command a frame on COB-ID 0 holds for ``node_id``; None for another node's, or for no command."""
    if len(data) != 2 or data[1] not in (0, node_id):
        return None
    try:
        return NmtCommand(data[0])
    except ValueError:
        return None
