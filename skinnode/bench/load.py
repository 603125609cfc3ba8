"""Generates load for ``skinnode bench pipeline``: a child process replays the frames of simulated nodes.

The nodes run the code of ``skinnode node`` on simulated patches. Whenever the simulated bus is free, the
pending frame with the lowest identifier wins arbitration. The frame occupies the bus for the duration of its
bits, including stuff bits. The resistances come from the simulator, because those of the solver's own model
would be unrealistically easy to solve.
"""

from __future__ import annotations

import errno
import heapq
import multiprocessing
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np

from skinnode.bus_load.plan import inhibit_time_100us
from skinnode.bus_load.timing import exact_bits_batch, fd_bits
from skinnode.canopen import indices as od
from skinnode.config import BusConfig, HandConfig, PatchConfig
from skinnode.errors import BusError
from skinnode.model.forward import resistance_ohm
from skinnode.node import EXACT, PatchNode
from skinnode.process.child_processes import starting_children
from skinnode.process.garbage_collection import without_long_collections
from skinnode.protocol.profile import PatchProfile
from skinnode.transport.datagram import LOOPBACK, datagram
from vcan_sim.default_scene import Scene
from vcan_sim.sensor import SimulatedPatch

TICK_S: Final = 0.25e-3
"""Polling interval of the sender, in s. On a fully loaded bus, about two frames become due in each interval.
Frames that are due together are sent together, as a USB adapter does."""
LEAD_S: Final = 0.5
"""Delay between the call to :meth:`Generator.begin` and the first SYNC, in s."""
_BEAT_S: Final = 0.1
_FULL_S: Final = 1e-4

_Queued = tuple[int, int, bytes, bool]
"""Queued frame: queueing time (ns), COB-ID, data, and whether the frame is a CAN FD frame."""


@dataclass(frozen=True, slots=True)
class Sent:
    """Results of a replay."""

    frames: dict[str, int]
    """Number of frames sent on each bus, excluding the heartbeats before the replay."""
    bus_load: dict[str, float]
    """Fraction of the time during which each simulated bus was busy."""
    late_p99_ms: float
    """99th percentile of the delay from the simulated to the actual send time, in ms."""
    late_max_ms: float
    cpu_s: float


class Generator:
    """Child process that replays a hand's bus traffic; the process is ready when the constructor returns.

    Args:
        hand: Hand to replay.
        seconds: Duration of the traffic, in s.
        touched: Number of patches that are pressed and stroked as in the demo, the first ones; None for all.
        core: Processor core to which the process is bound; None for no binding.
    """

    def __init__(self, hand: HandConfig, seconds: float, *, touched: int | None, core: int | None) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawn.Pipe()
        self._process = spawn.Process(target=_serve, args=(theirs, hand, seconds, touched, core), daemon=True)
        with starting_children():
            self._process.start()
        theirs.close()
        self._receive()

    def send_heartbeats(self, buses: Sequence[str]) -> None:
        """Start sending heartbeats for the patches on ``buses``, so that a host can detect them."""
        self._pipe.send(list(buses))

    def begin(self) -> int:
        """Schedule the replay to start after :data:`LEAD_S`; return the start time (monotonic, ns)."""
        t_ns = time.monotonic_ns() + round(LEAD_S * 1e9)
        self._pipe.send(t_ns)
        return t_ns

    def wait(self) -> Sent:
        """Wait for the end of the replay, and return its results."""
        sent: Sent = self._receive()
        return sent

    def close(self) -> None:
        """Stop the process."""
        self._pipe.close()
        self._process.join(5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _receive(self) -> Any:
        try:
            answer = self._pipe.recv()
        except EOFError:
            self._process.join()
            raise BusError("the load generator process ended unexpectedly") from None
        if isinstance(answer, Exception):
            raise answer
        return answer


def _serve(pipe: Connection, hand: HandConfig, seconds: float, touched: int | None, core: int | None) -> None:
    try:
        if core is not None:
            os.sched_setaffinity(0, {core})
        streams = {bus.name: stream_of(hand, bus, seconds, touched=touched) for bus in hand.buses}
        with without_long_collections():
            pipe.send(True)
            while True:
                chosen = [hand.bus(name) for name in pipe.recv()]
                pipe.send(_play(pipe, hand, [(bus, streams[bus.name]) for bus in chosen]))
    except EOFError:
        return
    except Exception as error:  # re-raised in the parent
        pipe.send(error)


# --- preparation


@dataclass(frozen=True, slots=True)
class Stream:
    """Frames on one bus with their simulated times."""

    t_ns: list[int]
    """End times of the frames in ns after the first SYNC, in ascending order."""
    packets: list[bytes]
    load: float


def stream_of(hand: HandConfig, bus: BusConfig, seconds: float, *, touched: int | None = None) -> Stream:
    """Simulate ``seconds`` of operation and return all frames on ``bus``, including SYNC."""
    scans = round(seconds / hand.sync.period_s)
    late_ns = round([each.name for each in hand.buses].index(bus.name) * hand.sync.stagger_s * 1e9)
    syncs = _syncs(hand, scans, late_ns)
    queues = [syncs]
    for number, patch in enumerate(hand.patches):
        if patch.bus == bus.name:
            queues.append(_node_frames(hand, patch, number, syncs, touched is None or number < touched))
    frames = [(*frame, queue) for queue, frames in enumerate(queues) for frame in frames]
    durations = _durations_ns(bus, [frame[:4] for frame in frames])
    return _arbitrate(frames, durations)


def _syncs(hand: HandConfig, scans: int, late_ns: int) -> list[_Queued]:
    period_ns, overflow = hand.sync.period_ms * 1_000_000, hand.sync.counter_overflow
    return [(late_ns + k * period_ns, od.SYNC_COB_ID, bytes([k % overflow + 1]), False) for k in range(scans)]


def _node_frames(
    hand: HandConfig, patch: PatchConfig, number: int, syncs: Sequence[_Queued], touched: bool
) -> list[_Queued]:
    """Return the frames that ``patch``'s node queues in response to ``syncs``."""
    bus, layout = hand.bus(patch.bus), patch.layout.build()
    profile = PatchProfile.from_config(patch, bus)
    source = SimulatedPatch(Scene(layout, hand.simulation, number))
    out: list[_Queued] = []
    now_ns = 0

    def send(can_id: int, data: bytes) -> None:
        out.append((now_ns, can_id, data, len(data) > 8))

    node = PatchNode(
        patch.node_id,
        layout,
        source,
        send=send,
        profile=profile,
        baseline_ohm=resistance_ohm(layout, layout.upper_m),
        pacing=EXACT,
    )
    node.power_on(now_ns)
    inhibit = inhibit_time_100us(hand.sync.period_ms, profile.n_chunks + 1)
    chunk, request = od.chunk_cob_id(patch.node_id), od.sdo_request_cob_id(patch.node_id)
    for index, subindex, value, size in (
        (od.SYNC_COUNTER_OVERFLOW, 0, hand.sync.counter_overflow, 1),
        (od.HEARTBEAT_PRODUCER, 0, hand.bring_up.heartbeat_ms, 2),
        (od.TPDO1_PARAMETER, od.PDO_COB_ID, chunk | 1 << 31, 4),
        (od.TPDO1_PARAMETER, od.PDO_INHIBIT_TIME, inhibit, 2),
        (od.TPDO1_PARAMETER, od.PDO_COB_ID, chunk, 4),
    ):
        out.clear()
        command = (
            0x23 | (4 - size) << 2
        )  # command byte of an expedited SDO download of `size` bytes (CiA 301, 7.2.4.3.3)
        multiplexer = index.to_bytes(2, "little") + bytes([subindex])
        node.on_frame(request, bytes([command]) + multiplexer + value.to_bytes(4, "little"), now_ns)
        assert out[-1][2][0] == 0x60, f"0x{index:04X}:{subindex} refused"
    node.on_frame(od.NMT_COB_ID, bytes((1, patch.node_id)), now_ns)
    if touched:
        source.start(0)
    out.clear()
    for now_ns, can_id, counter, _ in syncs:
        node.on_frame(can_id, counter, now_ns)
        end_ns = now_ns + hand.sync.period_ms * 1_000_000
        while (due_ns := node.next_deadline_ns()) is not None and due_ns < end_ns:
            now_ns = max(due_ns, now_ns)
            node.on_timer(now_ns)
    node.power_off()
    return out


def _durations_ns(bus: BusConfig, frames: Sequence[_Queued]) -> list[int]:
    """Return the duration of each frame on the bus, in ns."""
    ids = np.array([can_id for _, can_id, _, _ in frames])
    lengths = np.array([len(data) for _, _, data, _ in frames])
    durations = np.zeros(len(frames))
    fd = np.array([is_fd for _, _, _, is_fd in frames], dtype=bool)
    for length in set(lengths[fd].tolist()):
        rows = np.flatnonzero(fd & (lengths == length)).tolist()
        data = np.frombuffer(b"".join(frames[row][2] for row in rows), np.uint8).reshape(-1, length)
        nominal, fast = fd_bits(ids[rows], data)
        durations[rows] = 1e9 * (nominal / bus.bitrate_bps + fast / bus.data_bitrate_bps)
    rows = np.flatnonzero(~fd).tolist()
    data = np.frombuffer(b"".join(frames[row][2].ljust(8, b"\0") for row in rows), np.uint8).reshape(-1, 8)
    durations[rows] = 1e9 * exact_bits_batch(ids[rows], lengths[rows], data) / bus.bitrate_bps
    return [round(duration) for duration in durations]


def _arbitrate(frames: Sequence[tuple[int, int, bytes, bool, int]], durations: Sequence[int]) -> Stream:
    """Simulate bus arbitration and return the frames in the order in which they are sent.

    Each node has a first-in, first-out queue. Whenever the bus is free, the queue whose first frame has the
    lowest identifier sends that frame.
    """
    order = sorted(range(len(frames)), key=lambda i: frames[i][0])
    waiting: dict[int, list[int]] = {}  # indices of each node's queued frames, newest first
    heads: list[tuple[int, int]] = []  # heap with (identifier, node) of each queue's first frame
    times, packets = [], []
    now_ns = busy_ns = next_in = 0
    while next_in < len(order) or heads:
        if not heads:
            now_ns = max(now_ns, frames[order[next_in]][0])
        while next_in < len(order) and frames[order[next_in]][0] <= now_ns:
            queue = waiting.setdefault(frames[order[next_in]][4], [])
            if not queue:
                heapq.heappush(heads, (frames[order[next_in]][1], frames[order[next_in]][4]))
            queue.insert(0, order[next_in])
            next_in += 1
        _, node = heapq.heappop(heads)
        sent = waiting[node].pop()
        _, can_id, data, fd, _ = frames[sent]
        now_ns += durations[sent]
        busy_ns += durations[sent]
        times.append(now_ns)
        packets.append(datagram(can_id, data, fd=fd))
        if waiting[node]:
            heapq.heappush(heads, (frames[waiting[node][-1]][1], node))
    return Stream(times, packets, busy_ns / max(1, now_ns))


# --- replay of the prepared frames in real time


def _play(pipe: Connection, hand: HandConfig, loads: Sequence[tuple[BusConfig, Stream]]) -> Sent:
    sockets = [_connect(bus) for bus, _ in loads]
    try:
        sent = [0] * len(loads)
        beats = [
            [datagram(od.heartbeat_cob_id(patch.node_id), b"\x05") for patch in hand.patches_on(bus.name)]
            for bus, _ in loads
        ]
        while not pipe.poll(_BEAT_S):
            for sock, packets in zip(sockets, beats, strict=True):
                for packet in packets:
                    _send(sock, packet)
        begin_ns = pipe.recv()
        cpu_s = time.process_time()
        late_ns = _replay(sockets, [stream for _, stream in loads], begin_ns, sent)
        return Sent(
            frames={bus.name: count for (bus, _), count in zip(loads, sent, strict=True)},
            bus_load={bus.name: stream.load for bus, stream in loads},
            late_p99_ms=float(np.percentile(late_ns, 99)) / 1e6,
            late_max_ms=float(np.max(late_ns)) / 1e6,
            cpu_s=time.process_time() - cpu_s,
        )
    finally:
        for sock in sockets:
            sock.close()


def _replay(
    sockets: Sequence[socket.socket], streams: Sequence[Stream], begin_ns: int, sent: list[int]
) -> list[int]:
    """Send every frame at its scheduled time; return the delay (ns) of the first frame of each burst."""
    late_ns, clock = [], time.monotonic_ns
    at = [0] * len(streams)
    left = sum(len(stream.packets) for stream in streams)
    while left:
        now_ns = clock() - begin_ns
        for number, stream in enumerate(streams):
            first, times, packets, send = at[number], stream.t_ns, stream.packets, sockets[number]
            i = first
            while i < len(times) and times[i] <= now_ns:
                sent[number] += _send(send, packets[i])
                i += 1
            if i > first:
                late_ns.append(now_ns - times[first])
                left -= i - first
                at[number] = i
        time.sleep(TICK_S)
    return late_ns


def _connect(bus: BusConfig) -> socket.socket:
    if bus.interface == "socketcan":
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, int(bus.fd))
        sock.bind((bus.channel,))
    else:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.connect((LOOPBACK, int(bus.channel)))
    return sock


def _send(sock: socket.socket, packet: bytes) -> int:
    """Send a packet; return the number of packets sent: 1, or 0 if no receiver has opened its socket yet."""
    while True:
        try:
            sock.send(packet)
        except ConnectionRefusedError:
            return 0
        except OSError as error:
            if error.errno != errno.ENOBUFS:
                raise
            time.sleep(_FULL_S)  # the transmit queue of the CAN interface is full
        else:
            return 1
