"""pytest plugin with fixtures for a simulated hand, its host, ground truth, faults and clock.

::

    def test_a_press_is_felt(skin_hand, skin_host, skin_truth):
        skin_hand("hand.toml", scene="press.toml")
        host = skin_host()
        field = host.fields(timeout_s=5).get()
        assert skin_truth(field).wrench[2] < 0

The ``--skin-bus`` option selects the CAN bus for all tests; by default, tests run in virtual time on a
simulated bus. When a test fails, the plugin saves the bus trace, the scene, the ground truth and a plot, and
names the folder in the test report.
"""

from __future__ import annotations

import random
import re
import uuid
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

if TYPE_CHECKING:  # at run time, a test imports numba and NumPy only if it needs them
    from skinnode.config import HandConfig
    from skinnode.host import Host
    from skinnode.model.frames import FieldFrame
    from vcan_sim.bus_attacker import InjectedOnBus
    from vcan_sim.faults import Injected
    from vcan_sim.fleet import Fleet
    from vcan_sim.scenes import PatchTruth, SceneConfig

BUSES: Final = {
    "timed": ("timed", ""),
    "virtual": ("virtual", ""),
    "udp_multicast": ("udp_multicast", ""),
    "vcan0": ("socketcan", "vcan{}"),
}
"""python-can interface and channel for each value of ``--skin-bus``. Braces are replaced by the number of the
bus in the hand. If the channel is empty, each test uses a random channel."""
TRUTH_READINGS: Final = 200
"""Number of most recent readings per patch whose ground truth is saved if a test fails."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the command-line options of the plugin."""
    group = parser.getgroup("skinnode", "simulated robot skin")
    group.addoption(
        "--skin-bus",
        choices=tuple(BUSES),
        default="timed",
        help="CAN bus of the simulated hand: timed (virtual time, default), virtual, udp_multicast or vcan0",
    )
    group.addoption(
        "--skin-kept",
        metavar="DIR",
        default="skin-kept",
        help="folder for the trace, scene, ground truth and plot of failed tests (default: skin-kept)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the ``skin_bus`` marker."""
    config.addinivalue_line(
        "markers", f"skin_bus(*buses): run this test only on these buses: {', '.join(BUSES)}"
    )


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test if its ``skin_bus`` marker does not list the selected bus."""
    chosen = item.config.getoption("--skin-bus")
    for marker in item.iter_markers("skin_bus"):
        if not marker.args:
            raise pytest.UsageError(f"skin_bus: got no bus, must be one or more of {', '.join(BUSES)}")
        for bus in marker.args:
            if bus not in BUSES:
                raise pytest.UsageError(f"skin_bus: got {bus!r}, must be one of {', '.join(BUSES)}")
        if chosen not in marker.args:
            pytest.skip(f"only on {', '.join(marker.args)}; --skin-bus is {chosen}")


class SkinTest:
    """Simulated hand, host and bus traces of one test.

    Args:
        bus: Value of the ``--skin-bus`` option.
        open_until_end: Exit stack that is closed at the end of the test.
    """

    def __init__(self, bus: str, open_until_end: ExitStack) -> None:
        self.bus = bus
        self.fleet: Fleet | None = None
        self.scene: SceneConfig | None = None
        self._open = open_until_end
        self._traces: list[Callable[[], str]] = []

    def start(
        self, hand: HandConfig | Path | str, scene: SceneConfig | Path | str | None, options: dict[str, Any]
    ) -> Fleet:
        """Power on the nodes of a simulated hand."""
        from skinnode.config import HandConfig, load_hand
        from vcan_sim.fleet import Fleet
        from vcan_sim.scenes import SceneConfig, load_scene
        from vcan_sim.scenes.library import scene_file

        if self.fleet is not None:
            raise RuntimeError("skin_hand: called twice, but a test can have only one hand")
        plan = self._on_bus(hand if isinstance(hand, HandConfig) else load_hand(Path(hand)))
        if isinstance(scene, SceneConfig | None):
            self.scene = scene
        else:
            self.scene = load_scene(scene_file(Path(scene), "scene"), plan)
        for bus in plan.buses:
            self._traces.append(self._trace(bus))
        self.fleet = self._open.enter_context(Fleet(plan, scene=self.scene, **options))
        return self.fleet

    def started(self, needs: str) -> Fleet:
        """Return the running hand; ``needs`` is the name of the fixture that requires it."""
        if self.fleet is None:
            raise RuntimeError(f"{needs}: there is no hand yet; call skin_hand first")
        return self.fleet

    def bring_up(self, options: dict[str, Any]) -> Host:
        """Start a host for the hand. The host is closed at the end of the test."""
        from skinnode.host import Host

        return self._open.enter_context(Host.from_config(self.started("skin_host").hand, **options))

    def connect(self, bus: str | None = None) -> Any:
        """Open an endpoint on one of the hand's buses. The endpoint is closed at the end of the test."""
        from skinnode.transport import open_can_bus

        hand = self.started("skin_can").hand
        config = hand.buses[0] if bus is None else hand.bus(bus)
        return self._open.enter_context(open_can_bus(config))

    def keep(self, folder: Path) -> list[str]:
        """Save the test's bus trace, ground truth, scene and plot, and return the file names."""
        folder.mkdir(parents=True, exist_ok=True)
        kept = ["trace.log"]
        (folder / "trace.log").write_text("".join(trace() for trace in self._traces), encoding="utf-8")
        if self.fleet is not None:
            kept += self._keep_truth(self.fleet, folder)
        return kept

    def _keep_truth(self, fleet: Fleet, folder: Path) -> list[str]:
        import numpy as np

        truth: dict[str, Any] = {}
        for name, patch in fleet.patches.items():
            times_ns = patch.read_times_ns()[-TRUTH_READINGS:]
            truth[f"{name} time_ns"] = np.array(times_ns, np.int64)
            truth[f"{name} displacement_m"] = np.array([patch.displacement_m(t_ns) for t_ns in times_ns])
        np.savez_compressed(folder / "truth.npz", **truth)
        kept = ["truth.npz"]
        if self.scene is not None:
            (folder / "scene.json").write_text(self.scene.model_dump_json(indent=1), encoding="utf-8")
            kept.append("scene.json")
            if self.scene.touches:
                kept += self._keep_plot(self.scene, fleet, folder)
        return kept

    def _keep_plot(self, scene: SceneConfig, fleet: Fleet, folder: Path) -> list[str]:
        try:
            from vcan_sim.scenes.plot import write_plot

            write_plot(scene, fleet.hand, folder / "scene.png")
        except ImportError:  # matplotlib is an optional dependency
            return []
        return ["scene.png"]

    def _on_bus(self, hand: HandConfig) -> HandConfig:
        interface, channel = BUSES[self.bus]
        buses = [
            bus.model_copy(
                update={"interface": interface, "channel": channel.format(number) or self._own(bus.name)}
            )
            for number, bus in enumerate(hand.buses)
        ]
        return hand.model_copy(update={"buses": tuple(buses)})

    def _own(self, name: str) -> str:
        """Return a random channel name, so that parallel tests do not share a bus."""
        if self.bus == "udp_multicast":
            return f"239.75.{random.randrange(256)}.{random.randrange(1, 255)}"
        return f"{name}-{uuid.uuid4().hex[:8]}"

    def _trace(self, bus: Any) -> Callable[[], str]:
        """Start recording the frames on a bus, and return a function that returns the trace as text."""
        from skinnode.process import clock
        from vcan_sim.trace import Listener, Trace

        if self.bus != "timed":
            return self._open.enter_context(Listener(bus)).text
        from vcan_sim.timed_bus import BitRates
        from vcan_sim.timed_interface import segment
        from vcan_sim.virtual_time import VirtualClock

        virtual = clock.current()
        assert isinstance(virtual, VirtualClock)
        rates = BitRates(bus.bitrate_bps, bus.data_bitrate_bps if bus.fd else None)
        return Trace(segment(bus.channel, virtual, rates)).text


class SkinFaults:
    """Fault injection for a test's simulated hand."""

    def __init__(self, test: SkinTest) -> None:
        self._test = test

    def inject(self, place: str | None = None, **faults: Any) -> None:
        """Replace the faults of one patch, one bus or all patches.

        Args:
            place: Name of the patch or bus; None for all patches.
            **faults: Fields of :class:`vcan_sim.faults.Faults`, such as ``lost=0.01`` or ``unplugged=True``;
                for a bus, fields of :class:`vcan_sim.bus_attacker.BusFaults`.

        Raises:
            ConfigError: If there is no such patch or bus, or if a fault is unknown or out of range.
        """
        from dataclasses import fields

        from skinnode.errors import ConfigError, Shown
        from vcan_sim.bus_attacker import BusFaults
        from vcan_sim.faults import Faults

        fleet = self._test.started("skin_faults")
        on_bus = place is not None and self._is_bus(place)
        known = [field.name for field in fields(BusFaults if on_bus else Faults)]
        for name in faults:
            if name not in known:
                raise ConfigError(name, Shown("an unknown fault"), f"one of {', '.join(known)}")
        if on_bus and place is not None:
            fleet.inject_bus(place, BusFaults(**faults))
        else:
            fleet.inject(Faults(**faults), place)

    def clear(self, place: str | None = None) -> None:
        """End the faults of one patch, one bus or all patches."""
        self.inject(place)

    def injected(self, patch: str) -> Injected:
        """Return the counts of faults injected into the node of a patch."""
        return self._test.started("skin_faults").injected(patch)

    def injected_bus(self, bus: str) -> InjectedOnBus:
        """Return the counts of faults injected into a bus."""
        return self._test.started("skin_faults").injected_bus(bus)

    def _is_bus(self, place: str) -> bool:
        fleet = self._test.started("skin_faults")
        return place not in fleet.patches and place in [bus.name for bus in fleet.hand.buses]


_TEST: Final = pytest.StashKey[SkinTest]()


@pytest.fixture
def skin_clock(request: pytest.FixtureRequest) -> Iterator[Any]:
    """The ``skinnode.process.clock`` module. With ``--skin-bus timed``, the test runs in virtual time."""
    from skinnode.process import clock
    from vcan_sim.virtual_time import VirtualClock

    if request.config.getoption("--skin-bus") != "timed":
        yield clock
        return
    with VirtualClock():
        yield clock


@pytest.fixture
def _skin_test(request: pytest.FixtureRequest, skin_clock: Any) -> Iterator[SkinTest]:
    with ExitStack() as opened:
        test = SkinTest(request.config.getoption("--skin-bus"), opened)
        request.node.stash[_TEST] = test
        yield test


@pytest.fixture
def skin_hand(_skin_test: SkinTest) -> Callable[..., Fleet]:
    """Function that powers on a simulated hand: ``skin_hand(hand, scene=None, **options) -> Fleet``.

    ``hand`` and ``scene`` are files or configurations; ``scene`` may also be the name of a shipped scene.
    The ``options`` are arguments of :class:`vcan_sim.fleet.Fleet`. ``--skin-bus`` overrides the interface and
    channel of every bus.
    """

    def start(
        hand: HandConfig | Path | str, scene: SceneConfig | Path | str | None = None, **options: Any
    ) -> Fleet:
        return _skin_test.start(hand, scene, options)

    return start


@pytest.fixture
def skin_host(_skin_test: SkinTest) -> Callable[..., Host]:
    """Function that starts a host for the simulated hand: ``skin_host(**options) -> Host``.

    ``options`` are arguments of :meth:`skinnode.host.Host.from_config`.
    """
    return lambda **options: _skin_test.bring_up(options)


@pytest.fixture
def skin_can(_skin_test: SkinTest) -> Callable[..., Any]:
    """Function that opens a python-can endpoint on one of the hand's buses: ``skin_can(bus=None)``.

    ``bus`` is the name of the bus; default: the first bus. The function returns a ``can.BusABC``, which is
    closed at the end of the test.
    """
    return _skin_test.connect


@pytest.fixture
def skin_truth(_skin_test: SkinTest) -> Callable[[FieldFrame | None], PatchTruth]:
    """Function that returns the ground truth of a field. The hand must play a scene."""

    def truth(field: FieldFrame | None) -> PatchTruth:
        if field is None:  # as returned by Host.latest before the first field
            raise ValueError("field: got None, must be a field from a host; wait for the first field")
        if field.stamp is None:
            raise ValueError("field: got a field without a stamp, must be a field from a host")
        fleet = _skin_test.started("skin_truth")
        return fleet.truth(field.stamp.patch, field.stamp.device_time_us)

    return truth


@pytest.fixture
def skin_faults(_skin_test: SkinTest) -> SkinFaults:
    """Object that injects faults: ``inject(patch, lost=0.1)``, ``clear(patch)``, ``injected(patch)``."""
    return SkinFaults(_skin_test)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Save a simulated hand's data and list the files if the test or its set-up fails."""
    report = yield
    test = item.stash.get(_TEST, None)
    if test is not None and report.when in ("setup", "call") and report.failed:
        name = re.sub(r"[^\w.-]+", "_", item.nodeid)[-150:]
        folder = Path(item.config.getoption("--skin-kept")) / name
        try:
            kept = ", ".join(test.keep(folder))
            report.sections.append(("simulated hand", f"kept in {folder}: {kept}"))
        except Exception as error:
            report.sections.append(("simulated hand", f"could not save the data in {folder}: {error}"))
    return report
