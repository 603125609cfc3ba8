"""All simulated nodes of a hand, each bus with its port and its thread, started and stopped together."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from skinnode.model.config import HandConfig, PatchConfig
from skinnode.model.layout import Float
from skinnode.node import NmtState, NodeRunner, PatchNode
from skinnode.transport import CanPort
from skinnode.wire.indices import chunk_cob_id, summary_cob_id
from skinnode.wire.profile import PatchProfile
from vcan_sim.scene import Scene
from vcan_sim.sensor import SimulatedPatch


@dataclass(frozen=True, slots=True)
class NodeReport:
    """What a simulated node has done so far."""

    patch: str
    node_id: int
    nmt_state: NmtState
    frames_sent: int
    pdos_sent: int
    """Those of the frames that carried process data: chunks and summaries."""
    scans_sent: int
    """Scans sent to their end."""


class Fleet:
    """The patches of a hand as CANopen nodes in a scene each.

    A scene begins when its node has sent its first scan: bring-up may take as long as it likes, and a tare at
    power-on sees an untouched patch. :meth:`start` opens the buses and powers the nodes on, :meth:`stop`
    takes them to pre-operational and closes the buses; a ``with`` block does both.

    Args:
        hand: buses, patches and scene.
        interface, channel: instead of those of the file. Raises ConfigError for a channel that is meant for
            several buses.
    """

    def __init__(self, hand: HandConfig, *, interface: str | None = None, channel: str | None = None) -> None:
        self.hand = hand.on(interface, channel)
        self._stations = {
            patch.name: _Station(
                patch,
                PatchProfile.from_config(patch, hand.bus(patch.bus)),
                SimulatedPatch(Scene(patch.layout.build(), hand.simulation, number)),
            )
            for number, patch in enumerate(hand.patches)
        }
        self._runners: list[NodeRunner] = []
        self._running = ExitStack()

    def start(self) -> None:
        """Open the buses, power the nodes on. Raises BusError, and leaves nothing open, if a bus does not."""
        with ExitStack() as opened:
            runners = []
            for bus in self.hand.buses:
                port = opened.enter_context(CanPort(bus))
                stations = [self._stations[patch.name] for patch in self.hand.patches_on(bus.name)]
                runner = NodeRunner(port, [station.connect(port.send) for station in stations])
                runner.start()
                opened.callback(runner.stop)
                runners.append(runner)
            self._running = opened.pop_all()
        self._runners = runners

    def stop(self) -> None:
        """Nodes to pre-operational, threads joined, buses closed. Raises what ended a thread early. Stopping
        twice is fine."""
        self._running.close()

    @property
    def failed(self) -> bool:
        """Whether a bus has ended early; :meth:`stop` raises why."""
        return any(runner.failed for runner in self._runners)

    @property
    def patches(self) -> dict[str, SimulatedPatch]:
        """The simulated patches by name."""
        return {name: station.source for name, station in self._stations.items()}

    def report(self) -> tuple[NodeReport, ...]:
        """Where each node stands, in the order of the file."""
        return tuple(station.report() for station in self._stations.values())

    def truth_m(self, patch: str, device_time_us: int) -> Float:
        """(U, N, 3) true electrodes of the scan whose summary carried ``device_time_us``, metres.

        Raises LookupError for a patch that is not in the hand, or a scan that was not sent, or too long ago.
        """
        source = self._stations[patch].source
        try:
            return source.truth_m(source.read_ns(device_time_us))
        except LookupError as error:
            raise LookupError(f"{patch}: {error}") from None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


class _Station:
    """A node, its analogue front end, and a count of what it sends."""

    def __init__(self, config: PatchConfig, profile: PatchProfile, source: SimulatedPatch) -> None:
        self.source = source
        self._profile = profile
        self._config = config
        self._node: PatchNode | None = None
        self._frames = self._pdos = 0

    def connect(self, send: Callable[[int, bytes], None]) -> PatchNode:
        """A new node on the patch, sending by ``send``."""
        config, source = self._config, self.source
        pdos = {chunk_cob_id(config.node_id), summary_cob_id(config.node_id)}

        def counted(can_id: int, data: bytes) -> None:
            send(can_id, data)
            self._frames += 1
            self._pdos += can_id in pdos
            if not source.started and node.scans_sent:
                source.start(source.last_read_ns)

        node = PatchNode(
            config.node_id,
            source.scene.layout,
            source,
            send=counted,
            serial=config.node_id if config.serial is None else config.serial,
            profile=self._profile,
        )
        self._node = node
        return node

    def report(self) -> NodeReport:
        node, config = self._node, self._config
        state = NmtState.INITIALISING if node is None else node.nmt_state
        scans = 0 if node is None else node.scans_sent
        return NodeReport(config.name, config.node_id, state, self._frames, self._pdos, scans)
