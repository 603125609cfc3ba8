"""NMT slave: a node's state and the commands that change it (CiA 301 v4.2, 7.2.8 and 7.3.2)."""

from __future__ import annotations

from collections.abc import Callable

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import AFTER_COMMAND, NmtCommand, NmtState, parse
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.rejected import Rejected, RejectedFrames


class NmtSlave:
    """NMT state machine of a node.

    Args:
        store: object dictionary; 0x1029 holds the error behaviour.
        rejected: counts frames that are not NMT commands.
        entered: called after each change with the new state, the previous state and the time in ns.
    """

    def __init__(
        self,
        store: ObjectStore,
        rejected: RejectedFrames,
        entered: Callable[[NmtState, NmtState, int], None],
    ) -> None:
        self._store, self._rejected, self._entered = store, rejected, entered
        self.state = NmtState.INITIALISING
        """Current state."""

    def command(self, data: bytes, node_id: int) -> NmtCommand | None:
        """Return the command in a frame with COB-ID 0; None if the frame is malformed or for another node.

        Args:
            data: the payload.
            node_id: the node's own node-ID.
        """
        try:
            return parse(data, node_id)
        except ValueError:
            self._rejected.count(Rejected.NMT)
            return None

    def obey(self, command: NmtCommand, t_ns: int) -> None:
        """Enter the state that a command other than a reset requests."""
        self.enter(AFTER_COMMAND[command], t_ns)

    def enter(self, state: NmtState, t_ns: int) -> None:
        """Enter a state, unless the node is already in it."""
        if state is not self.state:
            before, self.state = self.state, state
            self._entered(state, before, t_ns)

    def on_communication_error(self, t_ns: int) -> None:
        """Change the state as 0x1029 specifies, after a missed heartbeat, a life guarding event or bus-off.

        0: change from OPERATIONAL to PRE-OPERATIONAL; 1: no change; 2: enter STOPPED.
        """
        behaviour = self._store.integer(od.ERROR_BEHAVIOUR, 1)
        if behaviour == 2:
            self.enter(NmtState.STOPPED, t_ns)
        elif behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self.enter(NmtState.PRE_OPERATIONAL, t_ns)
