"""Bus with injected faults, and the port of the simulated nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.process import clock
from skinnode.transport import CanPort, Frame
from vcan_sim.bus_attacker import NO_BUS_FAULTS, BusAttacker, BusFaults, InjectedOnBus, check_bus
from vcan_sim.tally import Kind, kind_of
from vcan_sim.timed_bus import BitRates, Cause, ErrorFrame, Event, RandomShare
from vcan_sim.timed_interface import Segment, segment
from vcan_sim.virtual_time import VirtualClock


class Passed:
    """Counts of data and remote frames at a port, by kind."""

    def __init__(self) -> None:
        self.sent: Counter[Kind] = Counter()
        self.heard: Counter[Kind] = Counter()
        """Frames received and delivered to the nodes."""
        self.missed: Counter[Kind] = Counter()
        """Frames missed because the controller was bus-off."""


class FaultyPort(CanPort):
    """Port with a switchable bus-off state, in which it neither sends nor delivers frames."""

    off = False

    def __init__(self, config: BusConfig) -> None:
        super().__init__(config)
        self.passed = Passed()

    def send(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        """Send a frame. Raises BusError if the bus rejects it or the controller is bus-off."""
        if self.off:
            raise BusError(f"{self.config.name}: bus-off, 0x{can_id:03X} not sent")
        super().send(can_id, data, remote=remote)
        self.passed.sent[kind_of(can_id, data, remote)] += 1

    def recv_batch(self, timeout_s: float, most: int = 1) -> list[Frame]:
        """Receive a batch of frames. Raises BusError if the controller is bus-off."""
        if self.off:
            while frames := super().recv_batch(0.0):
                _count(frames, self.passed.missed)
            raise BusError(f"{self.config.name}: bus-off, nothing received")
        frames = super().recv_batch(timeout_s, most)
        _count(frames, self.passed.heard)
        return frames


def _count(frames: list[Frame], counter: Counter[Kind]) -> None:
    for frame in frames:
        if not (frame.error or frame.extended):
            counter[kind_of(frame.can_id, frame.data, frame.remote)] += 1


class FaultyBus:
    """Bus of a simulated hand; applies injected faults and counts them.

    Args:
        config: Configuration of the bus.
        node_ids: Node-IDs on the bus.
    """

    def __init__(self, config: BusConfig, node_ids: Sequence[int]) -> None:
        self._config, self._node_ids = config, node_ids
        self._faults, self._counts = NO_BUS_FAULTS, InjectedOnBus()
        self._port: FaultyPort | None = None
        self._attacker: BusAttacker | None = None
        self._segment: Segment | None = None
        self._rule: RandomShare | None = None

    def connect(self, port: FaultyPort) -> None:
        """Apply the faults through ``port``, the nodes' open port."""
        self._port = port
        self._attacker = BusAttacker(self._config, self._node_ids, self._counts)
        virtual = clock.current()
        if self._config.interface == "timed" and isinstance(virtual, VirtualClock):
            data_bps = self._config.data_bitrate_bps if self._config.fd else None
            rates = BitRates(self._config.bitrate_bps, data_bps)
            self._segment = segment(self._config.channel, virtual, rates)
            self._segment.listeners.append(self._on_event)
        self._apply()

    def stop(self) -> None:
        """Stop the rogue frames and disturbances, and release the port."""
        if self._attacker is not None:
            self._attacker.stop()
            self._attacker = None
        if self._segment is not None:
            self._disturb(0.0)
            self._segment.listeners.remove(self._on_event)
            self._segment = None
        self._port = None

    def check(self, faults: BusFaults) -> None:
        """Raise ConfigError if this bus does not support the faults."""
        check_bus(faults, self._config)

    def inject(self, faults: BusFaults) -> None:
        """Replace the faults of the bus."""
        self._counts.bus_off += faults.bus_off and not self._faults.bus_off
        self._faults = faults
        if self._port is not None:
            self._apply()

    def injected(self) -> InjectedOnBus:
        """Return the counts of the faults injected into the bus."""
        if self._segment is not None:
            self._segment.catch_up()
        return replace(self._counts)

    def _apply(self) -> None:
        if self._port is not None:
            self._port.off = self._faults.bus_off
        if self._attacker is not None:
            self._attacker.set(self._faults)
        self._disturb(self._faults.disturbed)

    def _disturb(self, share: float) -> None:
        """Abort a fraction ``share`` of all further transmissions with error frames."""
        if self._segment is None or share == (0.0 if self._rule is None else self._rule.share):
            return
        if self._rule is not None:
            self._segment.undisturb(self._rule)
            self._rule = None
        if share:
            self._rule = RandomShare(share, self._faults.seed)
            self._segment.disturb(self._rule)

    def _on_event(self, event: Event) -> None:
        if isinstance(event, ErrorFrame) and event.destroyed and event.cause is Cause.DISTURBED:
            self._counts.disturbed += 1
