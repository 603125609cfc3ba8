"""Heartbeat producer (0x1017) and heartbeat consumer (0x1016), CiA 301 v4.2, 7.2.8.3.2.2."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.emergency import EmcyCode
from skinnode.canopen.nmt import NmtState
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS

_BOOTED: Final = 1
"""Second manufacturer-specific byte of the emergency message for a monitored node that has restarted; the
byte is 0 if a heartbeat is overdue."""


class HeartbeatProducer:
    """Schedule of a node's heartbeats. A delay of one period or more shifts the schedule."""

    def __init__(self) -> None:
        self.period_ns = 0
        """Heartbeat period in ns; 0 if the node sends no heartbeats."""
        self.deadline_ns = NO_DEADLINE_NS
        """Time (ns) at which the next heartbeat must be sent."""

    def boot_up(self, period_ms: int, t_ns: int) -> None:
        """Start the schedule. The first heartbeat is due one period after the boot-up message.

        Args:
            period_ms: Heartbeat period, in ms; 0 for no heartbeats.
            t_ns: Time of the boot-up message, in ns.
        """
        self.period_ns = period_ms * 1_000_000
        self.deadline_ns = t_ns + self.period_ns if period_ms else NO_DEADLINE_NS

    def set_period(self, period_ms: int, t_ns: int) -> None:
        """Change the heartbeat period. A heartbeat is due immediately.

        Args:
            period_ms: Heartbeat period, in ms; 0 for no heartbeats.
            t_ns: Current time, in ns.
        """
        self.period_ns = period_ms * 1_000_000
        self.deadline_ns = t_ns if period_ms else NO_DEADLINE_NS

    def beat(self, t_ns: int) -> bool:
        """Return whether a heartbeat is due at ``t_ns``. If so, schedule the next one."""
        if t_ns < self.deadline_ns:
            return False
        self.deadline_ns += self.period_ns
        if self.deadline_ns <= t_ns:
            self.deadline_ns = t_ns + self.period_ns
        return True


@dataclass(slots=True)
class _Monitored:
    node_id: int
    within_ns: int
    deadline_ns: int = NO_DEADLINE_NS
    """Time (ns) at which the next heartbeat is overdue. Monitoring starts at the first heartbeat."""


class HeartbeatConsumer:
    """Monitors the nodes listed in 0x1016.

    Args:
        store: Object dictionary.
        emcy: EMCY producer of the node.
        failed: Callback for a missed heartbeat, given its time in ns.
    """

    def __init__(self, store: ObjectStore, emcy: EmcyProducer, failed: Callable[[int], None]) -> None:
        self._store, self._emcy, self._failed = store, emcy, failed
        self._monitored: dict[int, _Monitored] = {}
        self.deadline_ns = NO_DEADLINE_NS
        """Earliest time (ns) at which a heartbeat is overdue."""
        store.guard(od.HEARTBEAT_CONSUMER, self._guard)

    @property
    def node_ids(self) -> list[int]:
        """Node-IDs of the monitored nodes."""
        return list(self._monitored)

    def reset(self) -> None:
        """Apply 0x1016 after a reset and forget all received heartbeats."""
        self._monitored = {}
        self.on_written(0)

    def on_written(self, t_ns: int) -> None:
        """Apply a write to 0x1016. For a changed entry, monitoring starts at the next heartbeat."""
        words = [self._store.integer(od.HEARTBEAT_CONSUMER, i + 1) for i in range(od.HEARTBEAT_CONSUMERS)]
        wanted = [_Monitored(word >> 16, (word & 0xFFFF) * 1_000_000) for word in words]
        before, self._monitored = self._monitored, {}
        for item in wanted:
            if 0 < item.node_id <= od.MAX_NODE_ID and item.within_ns:
                old = before.get(item.node_id)
                same = old is not None and old.within_ns == item.within_ns
                self._monitored[item.node_id] = old if old is not None and same else item
        for node_id, old in before.items():
            if self._monitored.get(node_id) is not old:
                self._emcy.clear(EmcyCode.HEARTBEAT, t_ns, node_id)
        self._plan()

    def on_heartbeat(self, node_id: int, state: int, t_ns: int) -> None:
        """Handle a heartbeat or boot-up message from a monitored node.

        A boot-up message does not start monitoring, because not every node sends heartbeats after it has
        booted. While a node is monitored, a boot-up message means that it has restarted.

        Args:
            node_id: Node-ID of the monitored node.
            state: NMT state in the message.
            t_ns: Arrival time, in ns.
        """
        item = self._monitored[node_id]
        if state == NmtState.INITIALISING:
            if item.deadline_ns == NO_DEADLINE_NS:
                return
            self._emcy.report_once(EmcyCode.HEARTBEAT, bytes((node_id, _BOOTED)), t_ns)
        item.deadline_ns = t_ns + item.within_ns
        self._emcy.clear(EmcyCode.HEARTBEAT, t_ns, node_id)
        self._plan()

    def on_timer(self, t_ns: int) -> None:
        """Report the monitored nodes whose heartbeats have become overdue."""
        if t_ns < self.deadline_ns:
            return
        for item in self._monitored.values():
            if t_ns >= item.deadline_ns:
                item.deadline_ns = NO_DEADLINE_NS
                self._emcy.report(EmcyCode.HEARTBEAT, bytes((item.node_id,)), t_ns, item.node_id)
        self._plan()
        self._failed(t_ns)

    def _plan(self) -> None:
        self.deadline_ns = min(
            [item.deadline_ns for item in self._monitored.values()], default=NO_DEADLINE_NS
        )

    def _guard(self, subindex: int, value: int) -> None:
        """Reject a second entry for the same node. Entries with node-ID 0 or heartbeat time 0 are unused."""
        if value >> 24:
            raise Refused(AbortCode.INVALID_VALUE)
        node_id, time_ms = value >> 16, value & 0xFFFF
        others = (i for i in range(1, od.HEARTBEAT_CONSUMERS + 1) if i != subindex)
        taken = {self._store.integer(od.HEARTBEAT_CONSUMER, i) for i in others}
        if node_id and time_ms and any(word >> 16 == node_id and word & 0xFFFF for word in taken):
            raise Refused(AbortCode.INCOMPATIBLE)  # CiA 301 forbids duplicate entries for a node
