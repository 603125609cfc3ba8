"""Error control services: boot-up message, heartbeat and node guarding (CiA 301 v4.2, 7.2.8.3).

A node ignores guarding requests while its producer heartbeat time (0x1017) is not 0.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.emergency import EmcyCode
from skinnode.canopen.nmt import NmtState
from skinnode.errors import BusError
from skinnode.node.guarding import Guarding
from skinnode.node.heartbeat import HeartbeatConsumer, HeartbeatProducer
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.rejected import Rejected
from skinnode.node.services import NodeServices

Handler = Callable[[bytes, int], None]

_RIVAL_BEATS: Final = 3
"""Duration of silence after which a node-ID conflict is considered resolved, in heartbeat periods. The loss
of one heartbeat from the other node does not end the conflict."""
_RIVAL_NS: Final = 750_000_000
"""Duration of silence (ns) after which a node-ID conflict is considered resolved if this node sends no
heartbeats. It equals three default heartbeat periods.
"""


class ErrorControl:
    """Error control services of a node.

    Args:
        services: Resources that all services of the node share.
        listen: Callback for a change in the result of :meth:`handlers`.
        failed: Callback for a heartbeat event or life guarding event, given its time in ns.
    """

    def __init__(
        self,
        services: NodeServices,
        listen: Callable[[], None],
        failed: Callable[[int], None],
    ) -> None:
        self._cob_id = 0  # COB-ID of heartbeats; 0 until the node has a node-ID
        store, emcy, now = services.store, services.emcy, services.now
        self._store, self._emcy, self._now = store, emcy, now
        self._rejected, self._send = services.rejected, services.send
        self._listen = listen
        self._booted_ns: int | None = None  # time of boot-up until the boot-up message is sent, then None
        self._producer = HeartbeatProducer()
        self._rival_until_ns = (
            NO_DEADLINE_NS  # time at which a node-ID conflict ends unless the other node sends again
        )
        self._guarding = Guarding(store, emcy, failed)
        self._consumer = HeartbeatConsumer(store, emcy, failed)
        store.watch(od.HEARTBEAT_PRODUCER, lambda _: self._on_period())
        store.watch(od.HEARTBEAT_CONSUMER, lambda _: self._on_consumers())
        for index in (od.GUARD_TIME, od.LIFE_TIME_FACTOR):
            store.watch(index, lambda _: self._guarding.on_written(now()))

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which :meth:`on_timer` must be called next."""
        boot_up_ns = NO_DEADLINE_NS if self._booted_ns is None else self._booted_ns
        return min(boot_up_ns, self._producer.deadline_ns, self.silent_from_ns, self._rival_until_ns)

    @property
    def silent_from_ns(self) -> int:
        """Time (ns) from which :meth:`on_timer` reports a missed heartbeat or guarding request."""
        return min(self._guarding.deadline_ns, self._consumer.deadline_ns)

    def handlers(self) -> dict[int, Handler]:
        """Return the handlers for data frames, by COB-ID."""
        handlers: dict[int, Handler] = {
            od.heartbeat_cob_id(node_id): functools.partial(self._on_heartbeat, node_id)
            for node_id in self._consumer.node_ids
        }
        handlers[self._cob_id] = self._on_own
        return handlers

    def reset(self, node_id: int) -> None:
        """Reset all error control services and forget all received heartbeats and guarding requests.

        Args:
            node_id: Node-ID of this node.
        """
        self._cob_id = od.heartbeat_cob_id(node_id)
        self._rival_until_ns = NO_DEADLINE_NS
        self._guarding.reset()
        self._consumer.reset()

    def boot_up(self, t_ns: int) -> None:
        """Schedule the heartbeats, and send the boot-up message as soon as the bus accepts it."""
        self._producer.boot_up(self._store.integer(od.HEARTBEAT_PRODUCER), t_ns)
        self._booted_ns = t_ns
        with contextlib.suppress(BusError):
            self._send_boot_up()

    def on_request(self, state: NmtState, t_ns: int) -> None:
        """Answer a guarding request (a remote frame), unless the node sends heartbeats."""
        if not self._producer.period_ns:
            self._send(self._cob_id, self._guarding.answer(state, t_ns))

    def on_timer(self, state: NmtState, t_ns: int) -> None:
        """Perform all actions due at ``t_ns``."""
        self._send_boot_up()
        if self._producer.beat(t_ns):
            self._send(self._cob_id, bytes((state,)))
        self._guarding.on_timer(t_ns)
        self._consumer.on_timer(t_ns)
        if t_ns >= self._rival_until_ns:
            self._rival_until_ns = NO_DEADLINE_NS
            self._emcy.clear(EmcyCode.CAN_ID_COLLISION, t_ns)

    def _send_boot_up(self) -> None:
        if self._booted_ns is not None:
            self._send(self._cob_id, bytes((NmtState.INITIALISING,)))
            self._booted_ns = None

    def _on_own(self, _: bytes, t_ns: int) -> None:
        """Report that another node has the same node-ID.

        Every frame from the other node is counted as rejected. The error ends when the other node has been
        silent for three heartbeat periods.
        """
        self._rival_until_ns = t_ns + (_RIVAL_BEATS * self._producer.period_ns or _RIVAL_NS)
        self._rejected.count(Rejected.OWN_ERROR_CONTROL)
        self._emcy.report(EmcyCode.CAN_ID_COLLISION, self._cob_id.to_bytes(2, "little"), t_ns)

    def _on_period(self) -> None:
        self._producer.set_period(self._store.integer(od.HEARTBEAT_PRODUCER), self._now())
        if self._producer.period_ns:
            self._guarding.end(self._now())

    def _on_consumers(self) -> None:
        self._consumer.on_written(self._now())
        self._listen()

    def _on_heartbeat(self, node_id: int, data: bytes, t_ns: int) -> None:
        if len(data) == 1:
            self._consumer.on_heartbeat(node_id, data[0], t_ns)
        else:
            self._rejected.count(Rejected.HEARTBEAT)
