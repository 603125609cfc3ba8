"""Heartbeats: sent by this node (0x1017) and expected from others (0x1016). CiA 301 v4.2, 7.2.8.3.2."""

from __future__ import annotations

from dataclasses import dataclass

from skinnode.node.abort import AbortCode, Refused
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.node.od import ObjectStore
from skinnode.wire import indices as od


class HeartbeatProducer:
    """When the next heartbeat is due. Free of drift: late by less than a period, it keeps to its beat."""

    def __init__(self) -> None:
        self.period_ns = 0
        self.deadline_ns = NO_DEADLINE_NS

    def set_period(self, period_ms: int, t_ns: int) -> None:
        """Beat every ``period_ms``, first one period from now; 0 ends it."""
        self.period_ns = period_ms * 1_000_000
        self.deadline_ns = t_ns + self.period_ns if period_ms else NO_DEADLINE_NS

    def beat(self, t_ns: int) -> bool:
        """Whether a heartbeat is due at ``t_ns``; the next one is then planned."""
        if t_ns < self.deadline_ns:
            return False
        self.deadline_ns += self.period_ns
        if self.deadline_ns <= t_ns:
            self.deadline_ns = t_ns + self.period_ns
        return True


@dataclass(slots=True)
class _Expected:
    node_id: int
    within_ns: int
    deadline_ns: int = NO_DEADLINE_NS
    """Monitoring starts at the first heartbeat."""


class HeartbeatConsumer:
    """Watches the nodes of object 0x1016."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._expected: dict[int, _Expected] = {}
        self.deadline_ns = NO_DEADLINE_NS
        """When the next heartbeat is missed."""
        store.guard(od.HEARTBEAT_CONSUMER, self._guard)

    @property
    def node_ids(self) -> list[int]:
        """Who is listened to."""
        return list(self._expected)

    def reload(self) -> None:
        """Take over what was written to 0x1016. Monitoring begins anew."""
        words = [self._store.integer(od.HEARTBEAT_CONSUMER, i + 1) for i in range(od.HEARTBEAT_CONSUMERS)]
        expected = [_Expected(word >> 16, (word & 0xFFFF) * 1_000_000) for word in words]
        self._expected = {item.node_id: item for item in expected if item.node_id and item.within_ns}
        self._plan()

    def on_heartbeat(self, node_id: int, t_ns: int) -> None:
        """A node is alive."""
        item = self._expected.get(node_id)
        if item is not None:
            item.deadline_ns = t_ns + item.within_ns
            self._plan()

    def missed(self, t_ns: int) -> list[int]:
        """Nodes whose heartbeat has just been missed. They are listened to again from their next one on."""
        late = [item for item in self._expected.values() if t_ns >= item.deadline_ns]
        for item in late:
            item.deadline_ns = NO_DEADLINE_NS
        self._plan()
        return [item.node_id for item in late]

    def _plan(self) -> None:
        self.deadline_ns = min([item.deadline_ns for item in self._expected.values()], default=NO_DEADLINE_NS)

    def _guard(self, subindex: int, value: int) -> None:
        if subindex == 0:
            return
        node_id, time_ms = value >> 16, value & 0xFFFF
        if node_id > 127:
            raise Refused(AbortCode.INVALID_VALUE)
        others = (i for i in range(1, od.HEARTBEAT_CONSUMERS + 1) if i != subindex)
        taken = {self._store.integer(od.HEARTBEAT_CONSUMER, i) for i in others}
        if node_id and time_ms and any(word >> 16 == node_id and word & 0xFFFF for word in taken):
            raise Refused(AbortCode.INCOMPATIBLE)  # one node, two times
