"""Simulated nodes of a hand. The nodes on a bus share one port and one thread."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from threading import Lock
from types import TracebackType
from typing import Final, Self

from skinnode.canopen.indices import chunk_cob_id, summary_cob_id
from skinnode.config import HandConfig, PatchConfig
from skinnode.errors import ConfigError
from skinnode.model.layout import Float
from skinnode.node import NmtState, NodeRunner
from skinnode.node.patch.source import ResistanceSource
from skinnode.protocol.profile import PatchProfile
from vcan_sim.bus_attacker import BusFaults, InjectedOnBus
from vcan_sim.default_scene import Scene
from vcan_sim.fault_player import FaultPlayer
from vcan_sim.faults import NO_FAULTS, Faults, Injected, check_places
from vcan_sim.faulty_bus import FaultyBus, FaultyPort, Passed
from vcan_sim.faulty_node import Emit, FaultyNode
from vcan_sim.fleet_faults import FleetFaults, Places
from vcan_sim.scenes import PatchTruth, SceneConfig, bind_scene, schedule_of
from vcan_sim.sensor import SimulatedPatch, SkinMotion
from vcan_sim.skin.imperfections import EXACT, Imperfections
from vcan_sim.tally import Tally

PREPARED_S: Final = 120.0
"""Duration (s) of the first part of a scene, for which contact mechanics are computed before the nodes start.
The rest is computed on demand."""


@dataclass(frozen=True, slots=True)
class NodeReport:
    """State of a simulated node, and its counters since start-up."""

    patch: str
    node_id: int
    nmt_state: NmtState
    frames_sent: int
    pdos_sent: int
    """Number of PDOs (chunks and summaries) sent."""
    scans_sent: int
    """Number of complete scans sent."""
    overruns: int
    """Number of scans skipped because the two preceding scans had not been sent yet."""
    slow_overruns: int
    """Number of scans skipped because this machine was too busy."""


class Fleet:
    """Simulated patches of a hand, each with a CANopen node.

    Nothing touches a patch until its node has sent a scan, so the tare at power-on measures the skin at rest.
    :meth:`start` opens the buses and powers on the nodes. :meth:`stop` sets the nodes to pre-operational and
    closes the buses. A ``with`` block calls both.

    Args:
        hand: Hand configuration, including its ``[simulation]`` settings.
        interface: python-can interface; default: the interface in the hand file.
        channel: Channel of the bus; default: the channel in the hand file.
        faults: Initial faults of every node. :meth:`inject` replaces them.
        wire_up: Function that returns the resistance source for the converter of a simulated patch; default:
            the patch itself.
        unchecked: Names of the patches that use protocol revision 1.0, which has no check in the summary.
        imperfections: Manufacturing errors, common to all patches or by patch name; default: the
            scene's imperfections. The random errors differ from patch to patch.
        scene: Scene to play instead of the random strokes of ``[simulation]``. It starts on all patches at
            once, as soon as any node has sent its first scan.

    Raises:
        ConfigError: If a channel is given for a hand with several buses; if ``imperfections`` or
            ``unchecked`` names an unknown patch; if ``imperfections`` reduces the gap between two electrodes
            too much; or if the scene contains a touch or a fault that is impossible on its patch or bus.
    """

    def __init__(  # noqa: PLR0913 - keyword arguments, most of which are rarely used
        self,
        hand: HandConfig,
        *,
        interface: str | None = None,
        channel: str | None = None,
        faults: Faults = NO_FAULTS,
        wire_up: Callable[[SimulatedPatch], ResistanceSource] = lambda patch: patch,
        unchecked: Collection[str] = (),
        imperfections: Imperfections | Mapping[str, Imperfections] | None = None,
        scene: SceneConfig | None = None,
    ) -> None:
        self.hand = hand.on(interface, channel)
        if imperfections is None:
            imperfections = EXACT if scene is None else scene.patch_imperfections()
        names = [patch.name for patch in hand.patches]
        sizes = _by_patch(imperfections, names)
        for name in unchecked:
            if name not in names:
                raise ConfigError("unchecked", name, f"a patch of the hand: {', '.join(names)}")
        self._scenes = {} if scene is None else bind_scene(scene, self.hand)
        self._beginning = Lock()
        self._stations = {
            patch.name: _Station(
                patch,
                replace(
                    PatchProfile.from_config(patch, hand.bus(patch.bus)), checked=patch.name not in unchecked
                ),
                SimulatedPatch(self._skin(patch, number), imperfections=sizes.get(patch.name, EXACT)),
                wire_up,
                faults.seed,
                self._begin,
            )
            for number, patch in enumerate(hand.patches)
        }
        self._runners: list[NodeRunner] = []
        self._ports: dict[str, FaultyPort] = {}
        self._running = ExitStack()
        self._segments = {
            bus.name: FaultyBus(bus, [patch.node_id for patch in self.hand.patches_on(bus.name)])
            for bus in self.hand.buses
        }
        self.faults: Final = FleetFaults(self._places(), faults)
        """Current faults of the patches and buses, and a log of their changes."""
        schedule = None if scene is None else schedule_of(scene, self.hand)
        self._player = FaultPlayer(schedule, self.faults) if schedule and schedule.faults else None

    def _places(self) -> Places:
        """Return the places where faults can be injected: patches and buses."""
        stations, segments = self._stations, self._segments
        return Places(
            tuple(stations),
            tuple(segments),
            lambda name, faults: stations[name].check(faults),
            lambda name, faults: stations[name].inject(faults),
            lambda name, faults: segments[name].check(faults),
            lambda name, faults: segments[name].inject(faults),
        )

    def _skin(self, patch: PatchConfig, number: int) -> SkinMotion:
        """Return the motion of a patch's skin: the scene, or random strokes if there is no scene."""
        if self._scenes:
            return self._scenes[patch.name]
        return Scene(patch.layout.build(), self.hand.simulation, number)

    def _begin(self, source: SimulatedPatch) -> None:
        """Start the scene on all patches, or the random strokes on one patch."""
        t_ns = source.last_read_ns
        with self._beginning:
            if self._player is not None and not source.started:
                self._player.begin(t_ns)
            for each in self.patches.values() if self._scenes else (source,):
                if not each.started:
                    each.start(t_ns)

    def start(self) -> None:
        """Compute the initial part of the scene, open the buses and power on the nodes.

        A stopped fleet can be started again. Its scene was not paused in the meantime, so it continues at the
        current time.

        Raises:
            BusError: If a bus cannot be opened. Buses already opened are closed again.
        """
        for scene in self._scenes.values():
            scene.prepare(PREPARED_S)
        with ExitStack() as opened:
            runners, ports = [], {}
            if self._player is not None:
                self._player.start()
                opened.callback(self._player.stop)
            for bus in self.hand.buses:
                port = ports[bus.name] = opened.enter_context(FaultyPort(bus))
                opened.callback(self._segments[bus.name].stop)
                self._segments[bus.name].connect(port)
                stations = [self._stations[patch.name] for patch in self.hand.patches_on(bus.name)]
                runner = NodeRunner(port, [station.connect(port.send) for station in stations])
                runner.start()
                opened.callback(runner.stop)
                runners.append(runner)
            self._running = opened.pop_all()
        self._runners, self._ports = runners, ports

    def stop(self) -> None:
        """Set the nodes to pre-operational, join the threads and close the buses. Can be called repeatedly.

        If a thread has failed, raises its error.
        """
        for runner in self._runners:  # in parallel, because each takes up to 0.1 s
            runner.request_stop()
        self._running.close()

    @property
    def failed(self) -> bool:
        """Whether any bus thread has failed. If so, :meth:`stop` raises its error."""
        return any(runner.failed for runner in self._runners)

    @property
    def patches(self) -> dict[str, SimulatedPatch]:
        """Simulated patches by name."""
        return {name: station.source for name, station in self._stations.items()}

    def report(self) -> tuple[NodeReport, ...]:
        """Return the counters of each node, in the order of the hand file."""
        return tuple(station.report() for station in self._stations.values())

    def inject(self, faults: Faults, patch: str | None = None) -> None:
        """Replace the faults of one patch or of all patches. The initial random seed remains in use.

        Args:
            faults: New faults.
            patch: Name of the patch; None for all patches.

        Raises:
            ConfigError: If the patch is unknown, or if a fault refers to a wire that a patch does not have.
        """
        patches = self._stations if patch is None else (patch,)
        self.faults.set_patches(dict.fromkeys(patches, faults))

    def inject_bus(self, bus: str, faults: BusFaults) -> None:
        """Replace the faults of a bus.

        Args:
            bus: Name of the bus.
            faults: New faults.

        Raises:
            ConfigError: If the bus is unknown, or does not support these faults.
        """
        self.faults.set_bus(bus, faults)

    def injected(self, patch: str) -> Injected:
        """Return the counts of the faults injected into the node of a patch."""
        return self._stations[patch].injected()

    def injected_bus(self, bus: str) -> InjectedOnBus:
        """Return the counts of the faults injected into a bus."""
        return self._segments[bus].injected()

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the nonzero counts of injected faults for each patch and each bus.

        The number of PDOs is not included, because sending a PDO is not a fault.
        """
        found: dict[str, Injected | InjectedOnBus] = {
            name: self.injected_bus(name) for name in self._segments
        }
        found = {**found, **{name: self.injected(name) for name in self._stations}}
        return {
            place: {name: count for name, count in asdict(found[place]).items() if count and name != "pdos"}
            for place in (*self._stations, *self._segments)
        }

    def tally(self, patch: str) -> Tally:
        """Return the frame counts of a patch's node, by kind; they are updated as the node runs."""
        return self._stations[patch].tally()

    def passed(self, bus: str) -> Passed:
        """Return the numbers of frames that the nodes on a bus have sent and received, by kind."""
        return self._ports[bus].passed

    def bus_off(self, bus: str, *, off: bool) -> None:
        """Start or end the bus-off state of the nodes' CAN controller."""
        self.faults.set_bus(bus, replace(self.faults.bus(bus), bus_off=off))

    def truth_m(self, patch: str, device_time_us: int) -> Float:
        """Return the true positions of the upper electrodes at the time of a scan.

        Args:
            patch: Name of the patch.
            device_time_us: Device time in the scan's summary, in µs.

        Returns:
            (U, N, 3) float64, m: positions including the imperfections of the patch.

        Raises:
            LookupError: If the patch is unknown, or the scan was never sent or is too old.
        """
        return self._at_scan(patch, device_time_us, SimulatedPatch.truth_m)

    def displacement_m(self, patch: str, device_time_us: int) -> Float:
        """Return the true displacement of the upper electrodes at the time of a scan.

        Args:
            patch: Name of the patch.
            device_time_us: Device time in the scan's summary, in µs.

        Returns:
            (U, N, 3) float64, m: :meth:`truth_m` minus the true positions at rest.

        Raises:
            LookupError: If the patch is unknown, or the scan was never sent or is too old.
        """
        return self._at_scan(patch, device_time_us, SimulatedPatch.displacement_m)

    def _at_scan(self, patch: str, device_time_us: int, at: Callable[[SimulatedPatch, int], Float]) -> Float:
        source = self._stations[patch].source
        try:
            return at(source, source.read_ns(device_time_us))
        except LookupError as error:
            raise LookupError(f"{patch}: {error}") from None

    def truth(self, patch: str, device_time_us: int) -> PatchTruth:
        """Return the ground truth at the time of a scan: displacement, contacts, pressure and wrench.

        See :meth:`truth_at` for the effects of the imperfections.

        Args:
            patch: Name of the patch.
            device_time_us: Device time in the scan's summary, in µs.

        Raises:
            LookupError: If the fleet has no scene, the patch is unknown, or the scan was never sent or is too
                old.
        """
        self._require_scene()
        source = self._stations[patch].source
        try:
            t_ns = source.read_ns(device_time_us)
        except LookupError as error:
            raise LookupError(f"{patch}: {error}") from None
        return self.truth_at(patch, t_ns)

    def truth_at(self, patch: str, t_ns: int) -> PatchTruth:
        """Return the ground truth at a given time: displacement, contacts, pressure and wrench.

        The displacement is that of the simulated patch, as in :meth:`displacement_m`: it includes creep and
        hysteresis, and each upper wire is evaluated at the time at which a scan that starts at ``t_ns``
        samples it. The contacts and the wrench are those of the scene at ``t_ns``, on an elastic skin without
        imperfections.

        Args:
            patch: Name of the patch.
            t_ns: Monotonic time, in ns.

        Raises:
            LookupError: If the fleet has no scene, or the patch is unknown.
        """
        self._require_scene()
        source = self._stations[patch].source
        t_s = source.scene_s(t_ns)
        truth = self._scenes[patch].truth(-1.0 if t_s is None else t_s)
        return replace(truth, displacement_m=source.displacement_m(t_ns))

    def scene_s(self, t_ns: int) -> float | None:
        """Return the scene time (s) that corresponds to a monotonic time; None before the scene starts.

        Args:
            t_ns: Monotonic time, in ns.
        """
        times = [patch.scene_s(t_ns) for patch in self.patches.values()]
        return max((time for time in times if time is not None), default=None)

    def _require_scene(self) -> None:
        if not self._scenes:
            raise LookupError("this fleet has no scene; for the strokes of [simulation], use truth_m")

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def _by_patch(
    imperfections: Imperfections | Mapping[str, Imperfections], patches: list[str]
) -> Mapping[str, Imperfections]:
    """Return the imperfections of each patch. Raises ConfigError if a patch is unknown."""
    if isinstance(imperfections, Imperfections):
        return dict.fromkeys(patches, imperfections)
    for name in imperfections:
        if name not in patches:
            raise ConfigError("imperfections", name, f"a patch of the hand: {', '.join(patches)}")
    return imperfections


class _Station:
    """Simulated patch, its node and the counts of frames sent by the node."""

    def __init__(  # noqa: PLR0913 - the parts of a node
        self,
        config: PatchConfig,
        profile: PatchProfile,
        source: SimulatedPatch,
        wire_up: Callable[[SimulatedPatch], ResistanceSource],
        seed: int,
        begin: Callable[[SimulatedPatch], None],
    ) -> None:
        self.source, self._begin = source, begin
        self._converter = wire_up(source)
        self._profile, self._config = profile, config
        self._pdo_ids = {chunk_cob_id(config.node_id), summary_cob_id(config.node_id)}
        self._node: FaultyNode | None = None
        self._faults = Faults(seed=seed)
        self._frames = self._pdos = 0

    def connect(self, emit: Emit) -> FaultyNode:
        """Create the node of the patch, which sends its frames through ``emit``."""
        config = self._config
        self._node = FaultyNode(
            config.node_id,
            self.source.scene.layout,
            self._converter,
            emit=emit,
            on_sent=self._on_sent,
            serial=config.node_id if config.serial is None else config.serial,
            profile=self._profile,
            faults=self._faults,
            temperature_per_k=self.source.skin.imperfections.temperature_per_k,
            on_repeat=self.source.note_repeat,
        )
        return self._node

    def check(self, faults: Faults) -> None:
        check_places(faults, self._config.name, self.source.scene.layout.shape, self._profile.n_chunks)

    def inject(self, faults: Faults) -> None:
        self._faults = faults
        if self._node is not None:
            self._node.faults = faults

    def injected(self) -> Injected:
        return Injected() if self._node is None else replace(self._node.injected)

    def tally(self) -> Tally:
        return Tally() if self._node is None else self._node.tally

    def _on_sent(self, can_id: int) -> None:
        self._frames += 1
        self._pdos += can_id in self._pdo_ids
        source, node = self.source, self._node
        if not source.started and node is not None and node.scans_sent:
            self._begin(source)

    def report(self) -> NodeReport:
        node, config = self._node, self._config
        state = NmtState.INITIALISING if node is None else node.nmt_state
        counts = (0, 0, 0) if node is None else (node.scans_sent, node.overruns, node.slow_overruns)
        return NodeReport(config.name, config.node_id, state, self._frames, self._pdos, *counts)
