"""Detect other masters on a bus by the frames that only a master sends.

The host does not receive its own frames, so a received NMT command, for example, comes from another master.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen import indices as od
from skinnode.config import BusConfig

_log = logging.getLogger(__name__)

QUIET_NS: Final = 10_000_000_000
"""Gap (ns) in the frames of one type from other masters after which the next such frame is logged."""

SYNC, NMT, SDO, HEARTBEAT = "SYNC", "NMT commands", "SDO requests to the hand's nodes", "the host's heartbeat"


@dataclass(frozen=True, slots=True)
class OtherMasterStats:
    """Counters of frames received from other masters.

    On a bus that another master runs, SYNC and NMT commands are legitimate, so ``syncs`` and ``nmt_commands``
    stay 0.
    """

    syncs: int
    nmt_commands: int
    sdo_requests: int
    """Number of SDO requests to the hand's nodes, for example from a second host or a service tool."""
    heartbeats: int
    """Number of heartbeats with the host's node-ID."""
    last_ns: int | None
    """Monotonic time (ns) of the newest frame from another master; None before the first one."""


class OtherMasters:
    """Detector for other masters on one bus. It logs the first frame of each type. Used by the mainline."""

    def __init__(self, bus: BusConfig) -> None:
        self._bus = bus
        self._counts = dict.fromkeys((SYNC, NMT, SDO, HEARTBEAT), 0)
        self._last_ns: dict[str, int] = {}

    def handlers(self, node_ids: list[int]) -> dict[int, Callable[[bytes, int], None]]:
        """Return the handlers that count other masters' frames, by COB-ID.

        On a bus that another master runs, there is no handler for SYNC and NMT commands.

        Args:
            node_ids: Node-IDs of the hand's nodes on this bus.
        """

        def counter_of(what: str) -> Callable[[bytes, int], None]:
            return lambda data, t_ns: self._on(what, t_ns)

        handlers = {od.sdo_request_cob_id(node_id): counter_of(SDO) for node_id in node_ids}
        if self._bus.role == "master":
            handlers |= {od.SYNC_COB_ID: counter_of(SYNC), od.NMT_COB_ID: counter_of(NMT)}
        if self._bus.heartbeat_node_id is not None:
            handlers[od.heartbeat_cob_id(self._bus.heartbeat_node_id)] = counter_of(HEARTBEAT)
        return handlers

    def stats(self) -> OtherMasterStats:
        """Return all counters. Thread-safe."""
        counts = self._counts
        last_ns = max(self._last_ns.values(), default=None)
        return OtherMasterStats(counts[SYNC], counts[NMT], counts[SDO], counts[HEARTBEAT], last_ns)

    def _on(self, what: str, t_ns: int) -> None:
        self._counts[what] += 1
        before_ns = self._last_ns.get(what)
        self._last_ns[what] = t_ns
        expected = self._bus.role == "guest" and what == SDO
        if not expected and (before_ns is None or t_ns - before_ns > QUIET_NS):
            _log.warning("%s: another node sends %s: is there a second host or master?", self._bus.name, what)
