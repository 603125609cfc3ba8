"""Node guarding and life guarding (CiA 301 v4.2, 7.2.8.3.2.1), including objects 0x100C and 0x100D."""

from __future__ import annotations

from collections.abc import Callable

from skinnode.canopen import indices as od
from skinnode.canopen.emergency import EmcyCode
from skinnode.canopen.nmt import GUARD_TOGGLE, NmtState
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS


class Guarding:
    """Guarding slave: answers guarding requests and reports a life guarding event when they stop.

    Args:
        store: Object dictionary.
        emcy: EMCY producer of the node.
        failed: Callback for a life guarding event, given its time in ns.
    """

    def __init__(self, store: ObjectStore, emcy: EmcyProducer, failed: Callable[[int], None]) -> None:
        self._store, self._emcy, self._failed = store, emcy, failed
        self._toggle = 0
        self._guarded = False  # whether a guarding request has been received
        self.deadline_ns = NO_DEADLINE_NS
        """Time (ns) at which the node life time expires."""

    def reset(self) -> None:
        """Reset the toggle bit and end guarding, as CiA 301 requires for *reset communication*."""
        self._toggle = 0
        self._guarded = False
        self.deadline_ns = NO_DEADLINE_NS

    def answer(self, state: NmtState, t_ns: int) -> bytes:
        """Return the answer to a guarding request and restart the node life time.

        Args:
            state: NMT state of the node.
            t_ns: Arrival time of the request, in ns.
        """
        answer = bytes((state | self._toggle,))
        self._toggle ^= GUARD_TOGGLE
        self._guarded = True
        self._start(t_ns)
        return answer

    def on_written(self, t_ns: int) -> None:
        """Apply a new guard time or life time factor.

        While guarding is active, the node life time restarts. A node life time of 0 ends a life guarding
        error.
        """
        if self._guarded or not self._life_ns:
            self._start(t_ns)

    def end(self, t_ns: int) -> None:
        """End guarding when the node starts to send heartbeats instead."""
        self._guarded = False
        self.deadline_ns = NO_DEADLINE_NS
        self._emcy.clear(EmcyCode.HEARTBEAT, t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Report a life guarding event if the node life time has expired."""
        if t_ns >= self.deadline_ns:
            self._guarded = False
            self.deadline_ns = NO_DEADLINE_NS
            self._emcy.report(EmcyCode.HEARTBEAT, bytes(1), t_ns)  # node 0: the master
            self._failed(t_ns)

    @property
    def _life_ns(self) -> int:
        guard_ms, factor = self._store.integer(od.GUARD_TIME), self._store.integer(od.LIFE_TIME_FACTOR)
        return guard_ms * factor * 1_000_000

    def _start(self, t_ns: int) -> None:
        life_ns = self._life_ns
        self.deadline_ns = t_ns + life_ns if life_ns else NO_DEADLINE_NS
        self._emcy.clear(EmcyCode.HEARTBEAT, t_ns)
