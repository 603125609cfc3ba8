"""Plans the traffic on a hand's buses: frames, bus loads, and worst-case response times.

The plan of a bus contains SYNC, the host's heartbeat if enabled, the frames of other devices listed in the
hand file, and a fraction :data:`SDO_SHARE` of the bandwidth for SDO. Each patch adds the chunks and the
summary of one scan per SYNC period, and one heartbeat and one EMCY per heartbeat period. The plan excludes
the SDO transfers that configure a node when it rejoins the bus: they have a lower priority than PDOs and use
only spare bandwidth.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skinnode.bus_load.response import Message, response_time_ns
from skinnode.bus_load.timing import exact_bits_batch, fd_bits, fd_worst_case_bits, worst_case_bits
from skinnode.canopen import indices as od
from skinnode.config import BusConfig, HandConfig, PatchConfig
from skinnode.errors import BusLoadError, ConfigError, Shown
from skinnode.protocol.profile import PatchProfile

SCAN_SHARE: Final = 0.8
"""Fraction of the SYNC period reserved for scans; the rest is left for SDO, EMCY and late frames."""

SDO_SHARE: Final = 0.01
"""Fraction of the bandwidth reserved for SDO: one request and one response every 27 ms at 1 Mbit/s."""

NODE_LATENCY_S: Final = 2e-3
"""Maximum delay in seconds from SYNC to the first chunk, specified for an otherwise idle machine."""

PACE_JITTER_S: Final = 0.2e-3
"""Maximum deviation in seconds of a chunk from its scheduled time, specified for an otherwise idle
machine."""

_SAMPLES: Final = 512
"""Number of random frames used to estimate the mean frame length, with a standard error of 0.1 bits."""


@dataclass(frozen=True, slots=True)
class PlannedFrame:
    """Entry of a traffic plan: all frames with the same identifier."""

    name: str
    can_id: int
    length: int
    """Data length, in bytes."""
    period_s: float
    """Period at which the frames are sent, in s."""
    count: int
    """Number of frames with this identifier per period."""
    spacing_s: float
    """Minimum time between consecutive frames with this identifier within a period, in s."""
    jitter_s: float
    """Maximum deviation of a frame from its scheduled time, in s."""
    worst_s: float
    """Duration of a frame with the maximum number of stuff bits, in s."""
    typical_s: float
    """Mean duration of a frame with random data, in s."""
    scans: bool = False
    """Whether the frames are sent in every SYNC period."""
    response_s: float | None = None
    """Worst-case response time in seconds, from queueing a frame to its last bit; None if unbounded."""

    @property
    def frames_per_s(self) -> float:
        """Mean number of frames per second."""
        return self.count / self.period_s

    @property
    def load(self) -> float:
        """Bus load of frames with the maximum number of stuff bits, as a fraction."""
        return self.frames_per_s * self.worst_s

    @property
    def typical_load(self) -> float:
        """Bus load with random data, as a fraction."""
        return self.frames_per_s * self.typical_s


@dataclass(frozen=True, slots=True)
class ScanTime:
    """Nominal and worst-case duration of a scan of one patch."""

    patch: str
    node_id: int
    chunks: int
    paced_s: float
    """Nominal time in seconds from the first to the last chunk, determined by the inhibit time."""
    worst_s: float | None
    """Worst-case time in seconds from queueing the SYNC to the end of the summary; None if unbounded."""


@dataclass(frozen=True, slots=True)
class BusPlan:
    """Traffic plan of one bus: frames and scan durations."""

    bus: BusConfig
    period_s: float
    """SYNC period, in s."""
    frames: tuple[PlannedFrame, ...]
    scans: tuple[ScanTime, ...]

    @property
    def frames_per_s(self) -> float:
        """Total number of frames per second on the bus."""
        return sum(frame.frames_per_s for frame in self.frames)

    @property
    def load(self) -> float:
        """Bus load if every frame has the maximum number of stuff bits; 1 means a fully loaded bus."""
        return sum(frame.load for frame in self.frames)

    @property
    def typical_load(self) -> float:
        """Bus load with random data, as a fraction."""
        return sum(frame.typical_load for frame in self.frames)

    @property
    def others(self) -> tuple[PlannedFrame, ...]:
        """Planned frames of other devices listed in the hand file."""
        named = {other.can_id for other in self.bus.others}
        return tuple(frame for frame in self.frames if frame.can_id in named)

    @property
    def shortest_period_ms(self) -> int | None:
        """Shortest SYNC period (ms) at which the load is at most ``max_load``; None if there is none."""
        free = self.bus.max_load - sum(frame.load for frame in self.frames if not frame.scans)
        scan_s = sum(frame.count * frame.worst_s for frame in self.frames if frame.scans)
        return int(-(-scan_s * 1e3 // free)) if free > 0 else None


def check_plan(hand: HandConfig) -> tuple[BusPlan, ...]:
    """Plan the traffic of each bus that has patches, and check its load.

    Args:
        hand: the hand.

    Raises:
        BusLoadError: if a bus's load exceeds its ``max_load``.
        ConfigError: as in :func:`plan_of`.
    """
    plans = plan_of(hand)
    for plan in plans:
        require_room(hand, plan)
    return plans


def require_room(hand: HandConfig, plan: BusPlan) -> None:
    """Check that a plan's bus load does not exceed the bus's ``max_load``.

    Args:
        hand: the hand.
        plan: the traffic plan of one of the hand's buses.

    Raises:
        BusLoadError: if the load exceeds the bus's ``max_load``.
    """
    bus, needed = plan.bus, plan.load
    if needed <= bus.max_load:
        return
    cures, period_ms = [], plan.shortest_period_ms
    if period_ms is not None:
        guest = bus.role == "guest"
        cures.append(f"a master's SYNC every {period_ms} ms" if guest else f"sync.period_ms = {period_ms}")
    if len(plan.scans) > 1:
        cures.append("fewer patches")
    cure = " or ".join(cures) or "a faster bus"
    key = f"buses[{[each.name for each in hand.buses].index(bus.name)}]"
    raise BusLoadError(
        f"{key} ({bus.name})",
        Shown(f"a plan that needs {needed:.1%} of {_rate(bus)}"),
        f"at most {bus.max_load:.1%} (max_load); {cure} would suffice",
        needed=needed,
        available=bus.max_load,
        where=hand.where(key),
    )


def _rate(bus: BusConfig) -> str:
    data = f", {bus.data_bitrate_bps} bit/s in the data phase" if bus.fd else ""
    return f"{bus.bitrate_bps} bit/s{data}"


def plan_of(hand: HandConfig) -> tuple[BusPlan, ...]:
    """Plan the traffic of each bus that has patches, regardless of its load.

    Args:
        hand: the hand.

    Raises:
        ConfigError: if a patch's data do not fit the wire format, or a frame of another device has one of the
            hand's identifiers.
    """
    profiles = {patch.name: _profile(hand, i, patch) for i, patch in enumerate(hand.patches)}
    return tuple(
        _plan_of_bus(hand, i, bus, profiles) for i, bus in enumerate(hand.buses) if hand.patches_on(bus.name)
    )


def inhibit_time_100us(period_ms: int, frames: int) -> int:
    """Return the inhibit time (0x1800:3, unit 100 µs) that makes a scan last SCAN_SHARE of the SYNC period.

    A scan is shorter if the required inhibit time does not fit in the object, an UNSIGNED16.

    Args:
        period_ms: SYNC period, in ms.
        frames: number of frames in a scan.
    """
    return min(int(period_ms * 10 * SCAN_SHARE / frames), 0xFFFF)


def _profile(hand: HandConfig, i: int, patch: PatchConfig) -> PatchProfile:
    try:
        return PatchProfile.from_config(patch, hand.bus(patch.bus))
    except ConfigError as error:
        key = f"patches[{i}].layout"
        got = Shown(f"{error.got} {error.key}")
        raise ConfigError(key, got, error.allowed, where=hand.where(key)) from None


def _plan_of_bus(hand: HandConfig, i: int, bus: BusConfig, profiles: dict[str, PatchProfile]) -> BusPlan:
    patches = hand.patches_on(bus.name)
    frames = [*_of_the_bus(hand, bus)]
    for patch in patches:
        frames += _of_a_patch(hand, bus, patch, profiles[patch.name])
    ours = {frame.can_id: frame.name for frame in frames}
    # The plan contains the frames of a single SDO channel, but every node has its own SDO identifiers.
    for patch in patches:
        ours |= {
            od.command_cob_id(patch.node_id): f"commands to {patch.name}",
            od.sdo_response_cob_id(patch.node_id): f"SDO answers of {patch.name}",
            od.sdo_request_cob_id(patch.node_id): f"SDO requests to {patch.name}",
        }
    for number, other in enumerate(bus.others):
        key = f"buses[{i}].others[{number}].can_id"
        if other.can_id in ours:
            allowed = f"an identifier that is unique on the bus; this one is used for {ours[other.can_id]}"
            raise ConfigError(key, Shown(f"0x{other.can_id:03X}"), allowed, where=hand.where(key))
        frame = _classic(
            bus, f"other 0x{other.can_id:03X}", other.can_id, other.length, other.period_ms * 1e-3
        )
        frames.append(frame)
        ours[other.can_id] = frame.name
    frames.sort(key=lambda frame: frame.can_id)
    answers = _responses_s(tuple(frames), bus)
    frames = [replace(frame, response_s=answers[frame.can_id]) for frame in frames]
    scans = [_scan_time(patch, profiles[patch.name], hand, answers) for patch in patches]
    return BusPlan(bus, hand.sync.period_s, tuple(frames), tuple(scans))


def _of_the_bus(hand: HandConfig, bus: BusConfig) -> Iterator[PlannedFrame]:
    counted = hand.sync.counter_overflow > 0
    yield _classic(bus, "SYNC", od.SYNC_COB_ID, int(counted), hand.sync.period_s, scans=True)
    if bus.heartbeat_node_id is not None:
        cob_id = od.heartbeat_cob_id(bus.heartbeat_node_id)
        yield _classic(bus, "heartbeat of the host", cob_id, 1, hand.bring_up.heartbeat_s)
    lowest = min(patch.node_id for patch in hand.patches_on(bus.name))
    transfer_s = 2 * worst_case_bits(8) / bus.bitrate_bps / SDO_SHARE
    yield _classic(bus, "SDO answers", od.sdo_response_cob_id(lowest), 8, transfer_s)
    yield _classic(bus, "SDO requests", od.sdo_request_cob_id(lowest), 8, transfer_s)


def _of_a_patch(
    hand: HandConfig, bus: BusConfig, patch: PatchConfig, profile: PatchProfile
) -> Iterator[PlannedFrame]:
    period_s, beat_s, node_id = hand.sync.period_s, hand.bring_up.heartbeat_s, patch.node_id
    yield _classic(bus, f"EMCY of {patch.name}", od.emcy_cob_id(node_id), 8, beat_s)
    cob_id, length = od.chunk_cob_id(node_id), profile.chunk_bytes
    # Chunks of up to 8 bytes, such as those of a patch with two lower wires, are classic frames even on a CAN
    # FD bus.
    times = _classic_s(bus, cob_id, length) if length <= 8 else _fd_s(bus, cob_id, length)
    spacing_s = inhibit_time_100us(hand.sync.period_ms, profile.n_chunks + 1) * 1e-4
    name = f"chunks of {patch.name}"
    yield PlannedFrame(
        name, cob_id, length, period_s, profile.n_chunks, spacing_s, PACE_JITTER_S, *times, scans=True
    )
    yield _classic(bus, f"summary of {patch.name}", od.summary_cob_id(node_id), 8, period_s, scans=True)
    yield _classic(bus, f"heartbeat of {patch.name}", od.heartbeat_cob_id(node_id), 1, beat_s)


def _classic(  # noqa: PLR0913 - one argument for each column of the plan
    bus: BusConfig, name: str, can_id: int, length: int, period_s: float, *, scans: bool = False
) -> PlannedFrame:
    worst_s, typical_s = _classic_s(bus, can_id, length)
    return PlannedFrame(name, can_id, length, period_s, 1, 0.0, 0.0, worst_s, typical_s, scans)


def _classic_s(bus: BusConfig, can_id: int, length: int) -> tuple[float, float]:
    return worst_case_bits(length) / bus.bitrate_bps, _typical_bits(can_id, length) / bus.bitrate_bps


def _fd_s(bus: BusConfig, can_id: int, length: int) -> tuple[float, float]:
    worst, typical = fd_worst_case_bits(length), _typical_fd_bits(can_id, length)
    bit_s, data_bit_s = 1 / bus.bitrate_bps, 1 / bus.data_bitrate_bps
    return worst[0] * bit_s + worst[1] * data_bit_s, typical[0] * bit_s + typical[1] * data_bit_s


@functools.lru_cache(maxsize=1024)
def _typical_bits(can_id: int, length: int) -> float:
    data = np.random.default_rng(can_id).integers(0, 256, (_SAMPLES, 8), dtype=np.uint8)
    return float(exact_bits_batch(np.full(_SAMPLES, can_id), np.full(_SAMPLES, length), data).mean())


@functools.lru_cache(maxsize=1024)
def _typical_fd_bits(can_id: int, length: int) -> tuple[float, float]:
    data = np.random.default_rng(can_id).integers(0, 256, (_SAMPLES, length), dtype=np.uint8)
    nominal, fast = fd_bits(np.full(_SAMPLES, can_id), data)
    return float(nominal.mean()), float(fast.mean())


def _responses_s(frames: tuple[PlannedFrame, ...], bus: BusConfig) -> dict[int, float | None]:
    """Return each identifier's worst-case response time in seconds; None if unbounded."""
    messages = [
        Message(
            frame.can_id,
            _ceil_ns(frame.worst_s),
            int(frame.period_s * 1e9 + 0.5),
            frame.count,
            int(frame.spacing_s * 1e9 + 0.5),
            int(frame.jitter_s * 1e9 + 0.5),
        )
        for frame in frames
    ]
    bit_ns = _ceil_ns(1 / bus.bitrate_bps)
    found: dict[int, float | None] = {}
    for message in messages:
        time_ns = response_time_ns(message, [each for each in messages if each is not message], bit_ns)
        found[message.can_id] = None if time_ns is None else time_ns * 1e-9
    return found


def _ceil_ns(time_s: float) -> int:
    return int(-(-time_s * 1e9 // 1))


def _scan_time(
    patch: PatchConfig, profile: PatchProfile, hand: HandConfig, answers: dict[int, float | None]
) -> ScanTime:
    """Compute the nominal and the worst-case duration of a patch's scans.

    The worst case is the nominal duration plus the latency of the node and the response times of the SYNC,
    the last chunk and the summary.
    """
    spacing_s = inhibit_time_100us(hand.sync.period_ms, profile.n_chunks + 1) * 1e-4
    paced_s = (profile.n_chunks - 1) * spacing_s
    parts = [
        answers[cob_id]
        for cob_id in (od.SYNC_COB_ID, od.chunk_cob_id(patch.node_id), od.summary_cob_id(patch.node_id))
    ]
    late_s = [part for part in parts if part is not None]
    worst_s = NODE_LATENCY_S + paced_s + sum(late_s) if len(late_s) == len(parts) else None
    return ScanTime(patch.name, patch.node_id, profile.n_chunks, paced_s, worst_s)
