"""Measures a node: chunk pacing, delay from SYNC to first chunk, heartbeat jitter, and CPU time per frame.

A frame is timestamped when the node passes it to the CAN interface; SYNC is timestamped with the same
monotonic clock. A second thread of the process sends SYNC and background frames through its own endpoint, so
the results include contention for the interpreter lock. Other processes affect the results even more. To
reduce their effect, run ``chrt -f 20 skinnode bench node``.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from skinnode.bench.timing import machine, take_turns
from skinnode.canopen import indices as od
from skinnode.config import BusConfig
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import EXACT, THRIFTY, NodeRunner, Pacing, PatchNode
from skinnode.process.garbage_collection import without_long_collections
from skinnode.transport import CanPort

NODE_ID: Final = 4
FULL_BUS_HZ: Final = 8_000
"""Rate at which frames with eight data bytes fully load a 1 Mbit/s bus, in Hz."""
SCAN_PERIOD_S: Final = 0.1
BEAT_MS: Final = 10
_BURST_S: Final = 1e-3  # time between bursts, because a thread cannot wake up 8000 times per second
_MOST_S: Final = (
    5e-3  # maximum backlog; older frames are dropped, because a fully loaded bus could not catch up
)

Row = dict[str, Any]


class _Still:
    """An untouched patch."""

    def __init__(self, layout: PatchLayout) -> None:
        self._ohm = resistance_ohm(layout, layout.upper_m)

    def read(self, t_ns: int) -> Float:
        return self._ohm


class _Rig:
    """Test rig for one measurement: a node and a bus manager."""

    def __init__(self, config: BusConfig, pacing: Pacing) -> None:
        layout = PatchLayout.preset("staggered")
        self.manager, self._port = CanPort(config), CanPort(config)
        self.sent: list[tuple[int, int]] = []
        """COB-ID and send time (ns) of each frame sent by the node."""
        node = PatchNode(NODE_ID, layout, _Still(layout), send=self._send, pacing=pacing)
        self.inhibit_ns = node.profile.default_inhibit_100us * 100_000
        self._runner = NodeRunner(self._port, [node])

    def _send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, time.monotonic_ns()))
        self._port.send(can_id, data)

    def __enter__(self) -> _Rig:
        self._runner.start()
        time.sleep(0.1)
        self.manager.send(od.NMT_COB_ID, bytes((1, 0)))
        time.sleep(0.05)
        return self

    def __exit__(self, *_: object) -> None:
        self._runner.stop()
        self._port.close()
        self.manager.close()

    @property
    def received(self) -> int:
        return self._port.received

    def take(self) -> None:
        """Empty the manager's receive queue; a full queue would block the node."""
        while self.manager.recv(0.0) is not None:
            pass


def run(seconds: float, rounds: int, interface: str, channel: str | None) -> dict[str, Any]:
    """Measure chunk pacing, heartbeats and the CPU time per frame; return all results.

    Args:
        seconds: Duration of each measurement on the bus.
        rounds: Number of timing rounds for each kind of frame.
        interface: python-can interface.
        channel: Channel of the interface; None to choose an unused channel name.
    """
    config = BusConfig(interface=interface, channel=channel or uuid.uuid4().hex)
    with without_long_collections():
        rows = _scans(config, seconds, EXACT, "exact") + _scans(config, seconds, THRIFTY, "thrifty")
        rows.append(_heartbeat(config, seconds, 0))
        rows.append(_heartbeat(config, seconds, FULL_BUS_HZ))
    handling = [
        {"what": what, "us": timing.call_us} for what, timing in take_turns(handlers(), rounds=rounds).items()
    ]
    return {"machine": machine() | {"interface": interface}, "rows": rows, "handling": handling}


def _row(what: str, late_ns: Float, goal_ms: float, load_hz: float = 0.0) -> Row:
    """Return a row that summarises signed deviations from the nominal time, in ns."""
    late_ms = np.abs(late_ns) / 1e6
    p50, p99, most = np.percentile(late_ms, [50, 99, 100]).tolist() if len(late_ms) else [None] * 3
    spread = {"p50_ms": p50, "p99_ms": p99, "max_ms": most}
    return {"what": what, **spread, "goal_ms": goal_ms, "n": len(late_ms), "load_hz": load_hz}


def _scans(config: BusConfig, seconds: float, pacing: Pacing, name: str) -> list[Row]:
    """Measure the intervals between chunks, and the time from SYNC to the first chunk."""
    gaps: list[int] = []
    first: list[int] = []
    with _Rig(config, pacing) as rig:
        for _ in range(max(2, round(seconds / SCAN_PERIOD_S))):
            rig.sent.clear()
            sync_ns = time.monotonic_ns()
            rig.manager.send(od.SYNC_COB_ID, b"")
            time.sleep(SCAN_PERIOD_S)
            rig.take()
            times = [t_ns for can_id, t_ns in tuple(rig.sent) if can_id == od.chunk_cob_id(NODE_ID)]
            first += [t_ns - sync_ns for t_ns in times[:1]]
            gaps += np.diff(times).tolist()
        inhibit_ns = rig.inhibit_ns
    return [
        _row(f"chunk pacing, {name}", np.array(gaps, float) - inhibit_ns, 0.2),
        _row(f"SYNC to first chunk, {name}", np.array(first, float), 2.0),
    ]


def _heartbeat(config: BusConfig, seconds: float, load_hz: int) -> Row:
    """Measure the intervals between a node's heartbeats."""
    stop = threading.Event()
    with _Rig(config, EXACT) as rig:
        period = bytes((0x2B, 0x17, 0x10, 0, *BEAT_MS.to_bytes(2, "little"), 0, 0))
        rig.manager.send(od.sdo_request_cob_id(NODE_ID), period)
        loader = threading.Thread(target=_load, args=(rig, load_hz, stop))
        loader.start()
        time.sleep(0.1)
        rig.sent.clear()
        before, start_s = rig.received, time.monotonic()
        time.sleep(seconds)
        heard_hz = (rig.received - before) / (time.monotonic() - start_s)
        times = [t_ns for can_id, t_ns in tuple(rig.sent) if can_id == od.heartbeat_cob_id(NODE_ID)]
        stop.set()
        loader.join()
    what = "heartbeat on a full bus" if load_hz else "heartbeat on an idle bus"
    return _row(what, np.diff(np.array(times, float)) - BEAT_MS * 1e6, 5.0, heard_hz)


def _load(rig: _Rig, rate_hz: int, stop: threading.Event) -> None:
    """Send unrelated frames in bursts, at a constant mean rate."""
    start_s, sent = time.monotonic(), 0
    while not stop.is_set():
        due = int((time.monotonic() - start_s) * rate_hz)
        for _ in range(min(due - sent, round(_MOST_S * rate_hz))):
            rig.manager.send(0x3F0, bytes(8))
        sent = due
        rig.take()
        time.sleep(_BURST_S)


def handlers() -> dict[str, Callable[[], object]]:
    """Return one function per kind of frame; each passes a frame of its kind directly to a node.

    Like a :class:`NodeRunner` thread, each function also queries the node's next deadline.
    """
    layout = PatchLayout.preset("staggered")
    node = PatchNode(NODE_ID, layout, _Still(layout), send=lambda _can_id, _data: None, pacing=EXACT)
    now_ns = 0
    node.power_on(now_ns)

    def give(can_id: int, data: bytes, *, remote: bool = False) -> None:
        node.on_frame(can_id, data, now_ns, remote)
        node.next_deadline_ns()

    def scan() -> None:
        nonlocal now_ns
        give(od.SYNC_COB_ID, b"")
        for _ in range(node.profile.n_chunks):
            now_ns = node.next_deadline_ns() or now_ns
            node.on_timer(now_ns)

    # Map the error register to TPDO3, and configure TPDO3 for transmission on remote request.
    sdo = od.sdo_request_cob_id(NODE_ID)
    for request in ("23021a0108000110", "2f021a0001000000", "2f021802fd000000", "2302180184030000"):
        give(sdo, bytes.fromhex(request))
    give(od.NMT_COB_ID, bytes((1, 0)))
    return {
        "frame of somebody else": lambda: give(0x3F0, bytes(8)),
        "SDO upload": lambda: give(sdo, bytes.fromhex("4000100000000000")),
        "RPDO": lambda: give(od.command_cob_id(NODE_ID), bytes(6)),
        "remote request": lambda: give(0x384, b"", remote=True),
        "SYNC and 100 chunks": scan,
    }
