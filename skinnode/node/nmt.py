"""NMT slave (CiA 301 v4.2, 7.2.8 and 7.3.2)."""

from __future__ import annotations

from collections.abc import Callable

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import AFTER_COMMAND, NmtCommand, NmtState, parse
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.rejected import Rejected, RejectedFrames


class NmtSlave:
    """NMT state machine of a node.

    Args:
        store: Object dictionary.
        rejected: Counters of rejected frames.
        entered: Callback for a state change; receives the new state, the previous state and the time in ns.
    """

    def __init__(
        self,
        store: ObjectStore,
        rejected: RejectedFrames,
        entered: Callable[[NmtState, NmtState, int], None],
    ) -> None:
        self._store, self._rejected, self._entered = store, rejected, entered
        self.state = NmtState.INITIALISING
        """Current NMT state."""

    def command(self, data: bytes, node_id: int) -> NmtCommand | None:
        """Return the NMT command in a frame, or None if it is malformed or addresses another node.

        Args:
            data: Payload of the frame.
            node_id: Node-ID of this node.
        """
        try:
            return parse(data, node_id)
        except ValueError:
            self._rejected.count(Rejected.NMT)
            return None

    def obey(self, command: NmtCommand, t_ns: int) -> None:
        """Enter the state that a command requests. Resets are not handled here."""
        self.enter(AFTER_COMMAND[command], t_ns)

    def enter(self, state: NmtState, t_ns: int) -> None:
        """Enter an NMT state, unless it is the current state."""
        if state is not self.state:
            before, self.state = self.state, state
            self._entered(state, before, t_ns)

    def on_communication_error(self, t_ns: int) -> None:
        """Apply the error behaviour (0x1029) after a heartbeat event, a life guarding event or bus-off.

        Depending on 0x1029:1, the node changes from OPERATIONAL to PRE-OPERATIONAL (0), keeps its state (1)
        or enters STOPPED (2).
        """
        behaviour = self._store.integer(od.ERROR_BEHAVIOUR, 1)
        if behaviour == 2:
            self.enter(NmtState.STOPPED, t_ns)
        elif behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self.enter(NmtState.PRE_OPERATIONAL, t_ns)
