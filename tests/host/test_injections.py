"""An exception at every call that a thread of the host makes into other code costs what it was made for: the
other patches, or the other bus, go on, the victim comes back, and a counter names the defect.

The calls are found, not listed: in a run of each stimulus a profile function writes them down. An ordinary
run takes a few of them by lot, ``--all-injections`` every one, once and three times running (half an hour);
``-s`` prints them.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest

from skinnode.config import HandConfig, parse_hand
from skinnode.errors import BusError, SkinError
from skinnode.host import Host, supervisor
from skinnode.host.containment import Defects
from skinnode.host.sdo_streams import Client
from skinnode.process import clock
from skinnode.record import Recorder
from skinnode.transport import CanPort, Frame

from .conftest import SMALL, Rack
from .injector import Edge, Injector, kind_of

pytestmark = pytest.mark.system_time

SAMPLE: Final = 12
LONGEST_S: Final = 20.0
"""Within an ordinary run."""
BACK_S: Final = 20.0
"""Within which all patches stream again, on a machine that has other things to do as well."""
REACHED_S: Final = 3.0
"""Within which a call is made again under the same stimulus; not all of them are."""

GUARDS: Final = {
    "containment.": "the guard itself",
    "patch_stream.PatchStream._leave": "gives the token back by one deque.append: the last line of its guard",
    "mainline.Mainline.__init__.<locals>.<lambda>": "reports what the receiver met: part of its guard",
    "tap.ContainedTap": "the guard of a tap; what the tap itself calls is injected",
}
"""Functions whose calls are not injected, and why."""

NEVER_RAISE: Final = {
    "lock.__exit__": "raised there, the lock would never be released, which C code does not do",
    "lock.release": "the same",
    "bus.BusABC.__del__": "Python prints what a destructor raises, and goes on",
    "containment.keep_on": "the guard itself",
}
"""Calls that are not injected, whoever makes them, and why."""


class Port(CanPort):
    """Fails to receive when told to."""

    failing = ""

    def recv_batch(self, timeout_s: float, most: int = 1) -> list[Frame]:
        if Port.failing and Port.failing == self.config.name:
            Port.failing = ""
            raise BusError(f"{self.config.name}: unplugged")
        return super().recv_batch(timeout_s, most)


class Bench:
    """A running host of two buses with two patches each, its nodes, and somebody else on the first bus."""

    def __init__(self, host: Host, recorder: Recorder, outsider: CanPort, injector: Injector) -> None:
        self.host, self.recorder, self.outsider, self.injector = host, recorder, outsider, injector
        self.callback = host.on_field(lambda field: None)
        self.threads = self.alive()
        self.stimuli: dict[str, Callable[[], None]] = {
            "running": lambda: None,
            "reset": lambda: self.outsider.send(0, bytes([0x81, 5])),
            "tare": lambda: self.host.tare("p0"),
            "away": self.unplug,
        }

    def told_elsewhere(self) -> tuple[int, int, int]:
        """What the recorder and the callback count."""
        return self.recorder.stats().dropped, self.recorder._defects.count, self.callback.failed

    def unplug(self) -> None:
        Port.failing = "can0"

    @staticmethod
    def alive() -> set[str]:
        """Threads that the host must never lose. Those of the pool, and that reopen, come and go."""
        names = (thread.name for thread in threading.enumerate())
        return {name for name in names if kind_of(name) not in ("", "rejoin", "reopen", "bring-up")}

    def all_stream(self, within_s: float = BACK_S) -> bool:
        """Whether each patch gives a field of a scan that begins from now on, and runs."""
        since_ns, end_s = clock.monotonic_ns(), clock.monotonic() + within_s
        while clock.monotonic() < end_s:
            fields = [self.host.latest(patch.name) for patch in self.host.hand.patches]
            stamps = [field.stamp for field in fields if field is not None and field.stamp is not None]
            running = all(node.phase == "running" for node in self.host.stats().nodes.values())
            if running and len(stamps) == 4 and all(stamp.t_sync_ns > since_ns for stamp in stamps):
                return True
            clock.sleep(0.02)
        return False

    def wait_for(self, stimulus: str) -> None:
        """Until its consequences are over."""
        end_s = clock.monotonic() + 0.4
        while clock.monotonic() < end_s:
            clock.sleep(0.02)
        assert self.all_stream()


@contextmanager
def bench(hand: HandConfig, rack: Rack, injector: Injector, folder: Path) -> Iterator[Bench]:
    with ExitStack() as stack:
        outsider = stack.enter_context(CanPort(hand.buses[0]))
        with injector.installed():
            folder.mkdir()
            recorder = stack.enter_context(Recorder(hand, folder / "run.log"))
            host = stack.enter_context(Host.from_config(hand, open_port=Port, tap=recorder))
            running = Bench(host, recorder, outsider, injector)
            assert running.all_stream()
            yield running
            begin_s = clock.monotonic()
            stack.close()
        assert clock.monotonic() - begin_s < BACK_S
    assert not [thread.name for thread in threading.enumerate() if kind_of(thread.name)]


@pytest.fixture
def injector(monkeypatch: pytest.MonkeyPatch) -> Injector:
    """One that is put back wherever an exception that it raised is dealt with."""
    injector = Injector()
    report, give_up = Defects.report, Client.give_up

    def reported(defects: Defects, doing: str, error: Exception) -> None:
        injector.again()
        report(defects, doing, error)

    def given_up(client: Client, index: int, subindex: int) -> None:
        injector.again()
        give_up(client, index, subindex)

    class Pool(ThreadPoolExecutor):
        def submit(self, job: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            def profiled() -> Any:
                injector.again()
                return job(*args, **kwargs)

            return super().submit(profiled)

    monkeypatch.setattr(Defects, "report", reported)
    monkeypatch.setattr(Client, "give_up", given_up)
    pool = {"pool": lambda threads, name: Pool(threads, thread_name_prefix=name)}
    monkeypatch.setattr(supervisor, "clock", SimpleNamespace(**{**vars(clock), **pool}))
    return injector


@pytest.fixture
def four(make_hand: Callable[..., HandConfig]) -> HandConfig:
    table = make_hand().model_dump(mode="json")
    channel = table["buses"][0]["channel"]
    table["buses"] = [{"name": f"can{i}", "channel": f"{channel}-{i}"} for i in range(2)]
    table["patches"] = [
        {"name": f"p{i}", "node_id": 5 + i % 2, "bus": f"can{i // 2}", "layout": SMALL, "tolerances": "exact"}
        for i in range(4)
    ]
    table["sync"]["period_ms"] = 100
    table["bring_up"]["heartbeat_ms"] = 1000  # nobody is lost because the machine is busy
    return parse_hand(table)


def may_be_injected(edge: Edge) -> bool:
    return edge.callee not in NEVER_RAISE and not any(edge.caller.startswith(guard) for guard in GUARDS)


@contextmanager
def closing_noted(wrong: list[str]) -> Iterator[None]:
    """Add what a bench that does not close raises to ``wrong``."""
    try:
        yield
    except Exception as error:
        wrong.append(f"the host does not close: {type(error).__name__}: {error}")


def found(running: Bench) -> dict[Edge, tuple[str, int]]:
    """Every call that a thread of the host makes: the first stimulus under which it does, and how often."""
    edges: dict[Edge, tuple[str, int]] = {}
    for stimulus, give in running.stimuli.items():
        running.injector.edges.clear()
        give()
        running.wait_for(stimulus)
        for edge, count in list(running.injector.edges.items()):
            edges.setdefault(edge, (stimulus, count))
    return edges


@pytest.mark.timeout(7200)
@pytest.mark.long
def test_an_exception_at_any_call_of_a_bring_up_does_not_end_the_start_of_the_host(
    four: HandConfig,
    rack_of: Callable[[HandConfig], Rack],
    injector: Injector,
    request: pytest.FixtureRequest,
) -> None:
    rack = rack_of(four)
    for patch in four.patches:
        rack.plug(patch.name)
    every = request.config.getoption("--all-injections")
    lot = random.Random(request.config.getoption("--injection-seed"))

    def starts() -> None:
        with injector.installed(), Host.from_config(four):
            injector.disarm()

    starts()
    candidates = sorted(
        edge for edge in injector.edges if edge.thread == "bring-up" and may_be_injected(edge)
    )
    print(f"\n{len(candidates)} calls")
    assert len(candidates) > 20
    for edge in candidates if every else lot.sample(candidates, 5):
        injector.arm(edge, 0, 1)
        starts()
        print(f"{edge} (raised {injector.fired} times)", flush=True)


def inject(running: Bench, edge: Edge, stimulus: str, skip: int, times: int) -> str | None:
    """Raise there, and see what it costs: what is wrong about that, or None; an edge that is not reached
    costs nothing."""
    host = running.host
    before, at_first = host.stats(), {name: stats.count for name, stats in host.stats().defects.items()}
    elsewhere = running.told_elsewhere()
    running.injector.arm(edge, skip, times)
    try:
        running.stimuli[stimulus]()
    except SkinError as error:
        return f"{stimulus}: {error}"
    end_s = clock.monotonic() + REACHED_S
    while running.injector.armed is not None and clock.monotonic() < end_s:
        clock.sleep(0.005)
    running.injector.disarm()
    fired = running.injector.fired
    if not running.all_stream():
        nodes = {name: (node.phase, node.complaint) for name, node in host.stats().nodes.items()}
        return f"not all patches stream again: {nodes}"
    lost = running.threads - running.alive()
    if lost:
        return f"threads ended: {lost}"
    after = host.stats()
    named = {name for name, stats in after.defects.items() if stats.count != at_first[name]}
    complained = any(node.failures != before.nodes[name].failures for name, node in after.nodes.items())
    away = any(bus.outages != before.buses[name].outages for name, bus in after.buses.items())
    if fired and not (named or complained or away or running.told_elsewhere() != elsewhere):
        return "no counter names it"
    victims = named | ({"p0"} if stimulus != "running" else set())
    buses = victims & set(host.stats().buses) | ({"can0"} if stimulus == "away" else set())
    for patch in host.hand.patches:
        if patch.name in victims or patch.bus in buses:
            continue
        if after.nodes[patch.name].rejoins != before.nodes[patch.name].rejoins:
            return f"{patch.name} was brought up anew, though the defect was of {sorted(victims)}"
    return None


@pytest.mark.timeout(7200)
@pytest.mark.long
def test_an_exception_at_any_call_costs_what_it_was_made_for(
    four: HandConfig,
    rack_of: Callable[[HandConfig], Rack],
    injector: Injector,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    rack = rack_of(four)
    for patch in four.patches:
        rack.plug(patch.name)
    every = request.config.getoption("--all-injections")
    lot = random.Random(request.config.getoption("--injection-seed"))
    with bench(four, rack, injector, tmp_path / "0") as running:
        edges = found(running)
    candidates = sorted(edge for edge in edges if may_be_injected(edge))
    lot.shuffle(candidates)
    print(f"\n{len(edges)} calls, {len(candidates)} of them may be injected")
    todo = [(edge, times) for edge in candidates for times in ((1, 3) if every else (lot.choice((1, 3)),))]
    del todo[len(todo) if every else SAMPLE :]
    wrong: list[str] = []
    end_s = clock.monotonic() + (float("inf") if every else LONGEST_S)
    while todo and clock.monotonic() < end_s:  # a bench goes on until something is wrong
        with closing_noted(wrong), bench(four, rack, injector, tmp_path / str(len(todo))) as running:
            while todo and clock.monotonic() < end_s:
                edge, times = todo.pop()
                stimulus, count = edges[edge]
                problem = inject(running, edge, stimulus, lot.randrange(min(3, count)), times)
                line = f"{edge} x{times} ({stimulus}, raised {running.injector.fired} times)"
                print(line, problem or "", flush=True)
                if problem:
                    wrong.append(f"{line}: {problem}")
                    break
    assert not wrong, "\n".join(wrong)
