"""Send NMT commands as the NMT master of a bus (CiA 301 v4.2, 7.2.8.3.1)."""

from __future__ import annotations

from collections.abc import Callable

from skinnode.canopen.indices import NMT_COB_ID
from skinnode.canopen.nmt import NmtCommand, encode


def start(send: Callable[[int, bytes], None], node_id: int) -> None:
    """Command a node to become operational."""
    send(NMT_COB_ID, encode(NmtCommand.START, node_id))


def stand_by(send: Callable[[int, bytes], None], node_id: int) -> None:
    """Command a node to become pre-operational.

    A pre-operational node sends heartbeats, EMCY messages and SDO responses, but no PDOs.
    """
    send(NMT_COB_ID, encode(NmtCommand.ENTER_PRE_OPERATIONAL, node_id))


def reset(send: Callable[[int, bytes], None], node_id: int) -> None:
    """Command a node to reset all objects to their power-on values and to boot."""
    send(NMT_COB_ID, encode(NmtCommand.RESET_NODE, node_id))
