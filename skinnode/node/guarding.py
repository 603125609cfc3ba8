"""Node guarding and life guarding: CiA 301 v4.2, 7.2.8.3.2.1 (objects 0x100C and 0x100D)."""

from __future__ import annotations

from collections.abc import Callable

from skinnode.canopen import indices as od
from skinnode.canopen.emergency import EmcyCode
from skinnode.canopen.nmt import GUARD_TOGGLE, NmtState
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore


class Guarding:
    """Answers a master that asks for the state, and notices when it stops asking.

    ``failed`` is called with the time of a life guarding event, after its EMCY.
    """

    def __init__(self, store: ObjectStore, emcy: EmcyProducer, failed: Callable[[int], None]) -> None:
        self._store, self._emcy, self._failed = store, emcy, failed
        self._toggle = 0
        self._guarded = False  # from the first request on
        self.deadline_ns = NO_DEADLINE_NS
        """When the life time is over."""

    def reset(self) -> None:
        """The state 'reset communication' was passed, which is the only one that resets the toggle bit."""
        self._toggle = 0
        self._guarded = False
        self.deadline_ns = NO_DEADLINE_NS

    def answer(self, state: NmtState, t_ns: int) -> bytes:
        """What to send on a remote frame with the COB-ID of error control. Starts life guarding, or goes on
        with it."""
        answer = bytes((state | self._toggle,))
        self._toggle ^= GUARD_TOGGLE
        self._guarded = True
        self._start(t_ns)
        return answer

    def on_written(self, t_ns: int) -> None:
        """Guard time or life time factor changed: a life time that runs begins anew, and without one there
        is no life guarding error."""
        if self._guarded or not self._life_ns:
            self._start(t_ns)

    def end(self, t_ns: int) -> None:
        """Heartbeats take the place of guarding; there is no life time until the next request."""
        self._guarded = False
        self.deadline_ns = NO_DEADLINE_NS
        self._emcy.over(EmcyCode.HEARTBEAT, t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Tell the life guarding event if it is time: once, until the master asks again."""
        if t_ns >= self.deadline_ns:
            self._guarded = False
            self.deadline_ns = NO_DEADLINE_NS
            self._emcy.present(EmcyCode.HEARTBEAT, bytes(1), t_ns)  # of node 0: the master
            self._failed(t_ns)

    @property
    def _life_ns(self) -> int:
        guard_ms, factor = self._store.integer(od.GUARD_TIME), self._store.integer(od.LIFE_TIME_FACTOR)
        return guard_ms * factor * 1_000_000

    def _start(self, t_ns: int) -> None:
        life_ns = self._life_ns
        self.deadline_ns = t_ns + life_ns if life_ns else NO_DEADLINE_NS
        self._emcy.over(EmcyCode.HEARTBEAT, t_ns)
