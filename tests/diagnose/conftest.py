"""Real nodes on a bus, a technician's line beside them, and the commands as a user runs them."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skinnode.config import BusConfig
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NodeRunner, PatchNode, VolatileMemory
from skinnode.process import clock
from skinnode.transport import CanPort
from tests.conftest import BETWEEN_PROCESSES, bus_on
from vcan_sim.virtual_time import VirtualClock

TIMED = "timed"
LAYOUT = PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=2, lower_wires=6, lower_electrodes=2)


@pytest.fixture(autouse=True)
def virtual_time(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run the test in virtual time, unless code that knows only the system's clock takes part in it."""
    marked = any(request.node.get_closest_marker(name) for name in ("system_time", "vcan"))
    parameters = request.node.callspec.params if hasattr(request.node, "callspec") else {}
    if marked or parameters.get("any_bus", TIMED) != TIMED:
        yield
        return
    with VirtualClock():
        yield


def interface_in_this_time() -> str:
    """The interface of a bus within this process."""
    return TIMED if isinstance(clock.current(), VirtualClock) else "virtual"


class Rest:
    """A patch that nobody touches; ``change`` may spoil what is read."""

    def __init__(self, layout: PatchLayout, change: Callable[[Float], Float] = lambda ohm: ohm) -> None:
        self._ohm, self.change = resistance_ohm(layout, layout.upper_m), change

    def read(self, t_ns: int) -> Float:
        return self.change(self._ohm)


@contextmanager
def boards(bus: BusConfig, *node_ids: int, **options: Any) -> Iterator[list[PatchNode]]:
    """Patches with these node-IDs, each with its node-ID as serial number unless ``serial`` is given."""
    layout = options.pop("layout", LAYOUT)
    with CanPort(bus) as port:
        nodes = [
            PatchNode(
                node_id,
                layout,
                options.get("source") or Rest(layout),
                send=port.send,
                serial=options.get("serial", node_id),
                memory=options.get("memory", VolatileMemory()),
                profile=options.get("profile"),
            )
            for node_id in node_ids
        ]
        with NodeRunner(port, nodes):
            yield nodes


@pytest.fixture
def bus() -> BusConfig:
    """A bus of its own."""
    return BusConfig(name="can7", interface=interface_in_this_time(), channel=uuid.uuid4().hex)


@pytest.fixture(params=[TIMED, *BETWEEN_PROCESSES])
def any_bus(request: pytest.FixtureRequest, multicast_group: str) -> BusConfig:
    """Each interface that a test can have to itself."""
    return bus_on(request.param, multicast_group)


@pytest.fixture
def powered() -> Iterator[Callable[..., list[PatchNode]]]:
    """:func:`boards` that stay on until the end of the test."""
    with ExitStack() as stack:
        yield lambda bus, *node_ids, **options: stack.enter_context(boards(bus, *node_ids, **options))


@pytest.fixture
def connection_on() -> Iterator[Callable[[BusConfig], BusConnection]]:
    with ExitStack() as stack:
        yield lambda bus: stack.enter_context(BusConnection(bus))


@dataclass(frozen=True)
class Done:
    """A command that has ended."""

    status: int
    stdout: str
    stderr: str

    @property
    def json(self) -> Any:
        return json.loads(self.stdout)


def run(arguments: Sequence[object], bus: BusConfig | None = None, answers: str | None = None) -> Done:
    """``skinnode`` with these arguments in this process, where a virtual bus is one; status and error line
    as the entry point makes them of an exception."""
    from skinnode.cli.main import app
    from skinnode.errors import SkinError

    where = [] if bus is None else ["--interface", bus.interface, "--channel", bus.channel]
    result = CliRunner().invoke(app, [*map(str, arguments), *where], input=answers)
    if isinstance(result.exception, (SkinError, ValueError, OSError)):
        return Done(2, result.stdout, f"error: {result.exception}")
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return Done(result.exit_code, result.stdout, result.stderr)


SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}


@pytest.fixture
def hand_file(tmp_path: Path) -> Callable[..., Path]:
    """A hand of two small patches on a bus of its own; ``first`` are further lines of the first."""

    def make(first: str = "", layout: str = "staggered") -> Path:
        sizes = ", ".join(f"{key} = {value}" for key, value in SMALL.items())
        file = tmp_path / f"{uuid.uuid4().hex}.toml"
        file.write_text(
            f'[[buses]]\nname = "can0"\ninterface = "{interface_in_this_time()}"\n'
            f'channel = "{uuid.uuid4().hex}"\n'
            "[sync]\nperiod_ms = 50\n"
            f'[[patches]]\nname = "thumb"\nnode_id = 5\nrelative_noise = 1e-4\n{first}\n'
            f'layout = {{ preset = "{layout}", {sizes} }}\n'
            f'[[patches]]\nname = "index"\nnode_id = 6\nrelative_noise = 1e-4\n'
            f'layout = {{ preset = "staggered", {sizes} }}\n'
            "[simulation]\nconverter_noise = 1e-4\ncycle_s = 3600.0\n"
        )
        return file

    return make


@pytest.fixture
def on() -> Iterator[Callable[[Any], Any]]:
    """Whatever is entered stays so until the end of the test."""
    with ExitStack() as stack:
        yield stack.enter_context
