"""``skinnode monitor --remote`` and ``skinnode view --remote``, over a real daemon."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import time
from collections.abc import Awaitable, Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

import skinnode as sk
from skinnode.monitor.live_source import RemoteSource
from skinnode.monitor.widgets import Dialog
from skinnode.view.drawing_thread import DrawingThread
from skinnode.view.tick import Tick
from tests.commands import run_here
from tests.monitor.conftest import PROGRAM, in_app, press, screen_of
from tests.monitor.conftest import eventually as eventually_in
from tests.remote.conftest import PATIENCE_S, Process, eventually
from tests.view.conftest import sdk as sdk

pytestmark = pytest.mark.system_time

WIDE = (140, 40)


def on_screen(port: int, play: Callable[[Pilot[Any]], Awaitable[None]], **options: Any) -> list[str]:
    """Show the hand of a daemon as the command does, and return the faults of the session."""
    with sk.connect("hand", port=port, timeout_s=PATIENCE_S) as hand, RemoteSource(hand) as source:
        return in_app(source, play, size=WIDE, **options).faults.lines


class Monitor:
    """``skinnode monitor --json`` in a process of its own."""

    def __init__(self, port: int) -> None:
        arguments = ["--remote", "hand", "--zenoh-port", str(port), "--json"]
        self.lines: list[dict[str, Any]] = []
        self._process = subprocess.Popen(
            [*PROGRAM, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def until(self, happens: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Read lines until ``happens(line)`` is true; return that line."""
        assert self._process.stdout is not None
        for text in self._process.stdout:
            self.lines.append(json.loads(text))
            if happens(self.lines[-1]):
                return self.lines[-1]
        raise AssertionError(self._process.communicate()[1])

    def stop(self) -> tuple[int, list[str]]:
        """Press Ctrl-C; return the exit status and the lines on stderr."""
        self._process.send_signal(signal.SIGINT)
        return self.end()

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()

    def end(self) -> tuple[int, list[str]]:
        """Wait for the end; return the exit status and the lines on stderr."""
        _, said = self._process.communicate(timeout=PATIENCE_S)
        return self._process.returncode, said.splitlines()


@pytest.fixture
def monitor(port: int) -> Iterator[Callable[[], Monitor]]:
    """Start the command; all that still run are killed at the end."""
    running: list[Monitor] = []

    def run_one() -> Monitor:
        running.append(Monitor(port))
        return running[-1]

    yield run_one
    for each in running:
        each.kill()


def conditions(line: dict[str, Any]) -> set[str]:
    return {patch["condition"] for patch in line["patches"].values()}


def refused(port: int) -> tuple[int, list[str], str]:
    done = run_here("monitor", "--remote", "hand", "--zenoh-port", str(port), "--json", "--seconds", "1")
    return done.returncode, done.stdout.splitlines(), done.stderr


async def appears(pilot: Pilot[Any], happens: Callable[[], object]) -> bool:
    return await eventually_in(pilot, happens, within_s=PATIENCE_S)


@pytest.mark.long
def test_json_says_what_a_daemon_does_not_send(
    start: Callable[..., Process], monitor: Callable[[], Monitor]
) -> None:
    daemon = start(period_ms=100).wait_until_up()
    shown = monitor()
    newest = shown.until(lambda line: len(shown.lines) > 2 and line["fields_hz"] > 0)
    shown.stop()
    assert newest["away"] is None
    assert set(newest["patches"]) == {"p0", "p1"}
    for patch in newest["patches"].values():
        assert patch["condition"] == "operational"
        assert 0 < patch["rate_hz"] < 15  # a host that is held up skips scans
        assert patch["fields_lost"] == 0
        assert 0 < patch["transit_s"] < 5
        assert 0 < patch["latency_s"] < 5
        assert {patch[name] for name in ("torn", "corrupt", "missed", "skipped", "chunks_lost")} == {None}
    bus = newest["buses"]["can0"]
    assert bus["frames_hz"] is None
    assert 0 < bus["load"] < 1
    assert json.loads(daemon.tell("stats"))["dropped"] == 0


def test_the_screen_of_a_remote_hand(start: Callable[..., Process], port: int) -> None:
    start().wait_until_up()

    async def play(pilot: Pilot[Any]) -> None:
        assert await appears(pilot, lambda: "fields/s" in screen_of(pilot))
        assert await appears(pilot, lambda: screen_of(pilot).count("operational") >= 2)
        text = screen_of(pilot)
        assert "hand (remote)" in text
        assert "frames/s not available" in text
        assert "no fault reported" in text
        assert "nothing lost" not in text
        assert "nothing happened" not in text
        await press(pilot, "z")
        assert await appears(pilot, lambda: "0 fields lost, " in screen_of(pilot))
        assert any(
            line.split()[-3:] == ["losses", "not", "available"] for line in screen_of(pilot).split("\n")
        )
        keys = screen_of(pilot).split("\n")[-1]
        assert not any(word in keys for word in ("tare", "reset", "record"))
        for key, said in (
            ("t", "hand 'hand': its daemon does not accept commands; start it with skinnode host --publish"),
            ("n", "hand 'hand': its daemon does not accept commands; start it with skinnode host --publish"),
            ("r", "a remote hand cannot be recorded: run skinnode record --listen on its machine"),
        ):
            pilot.app.simulate_key(key)
            assert await appears(pilot, lambda said=said: said in screen_of(pilot).split("\n")[-1])
            assert not isinstance(pilot.app.screen, Dialog)

    on_screen(port, play)


def test_keys_command_the_nodes_of_a_remote_hand(start: Callable[..., Process], port: int) -> None:
    daemon = start(commands=True).wait_until_up()

    async def play(pilot: Pilot[Any]) -> None:
        boot_ups = json.loads(await asyncio.to_thread(daemon.tell, "boot_ups"))
        await press(pilot, "2", "t")
        assert isinstance(pilot.app.screen, Dialog)
        assert "Tare p1?" in pilot.app.screen.text
        await press(pilot, "y")
        assert await appears(pilot, lambda: "p1: tared; the new baseline is in use" in screen_of(pilot))
        baselines = json.loads(await asyncio.to_thread(daemon.tell, "baselines"))
        assert (baselines["p0"], baselines["p1"] > 0) == (0, True)
        pilot.app.simulate_key("n")
        assert await appears(pilot, lambda: isinstance(pilot.app.screen, Dialog))
        assert "Reset the node of p1?" in getattr(pilot.app.screen, "text", "")
        await press(pilot, "y")
        assert await appears(
            pilot, lambda: "p1: reset; the host brings its node up again" in screen_of(pilot)
        )
        assert await appears(pilot, lambda: "p1 1 rejoin" in screen_of(pilot))
        after = json.loads(await asyncio.to_thread(daemon.tell, "boot_ups"))
        assert (after["p0"], after["p1"] > boot_ups["p1"]) == (boot_ups["p0"], True)

    on_screen(port, play)


@pytest.mark.long
def test_the_screen_says_that_the_daemon_is_away_and_goes_on_when_it_is_back(
    start: Callable[..., Process], port: int
) -> None:
    daemon = start().wait_until_up()

    async def play(pilot: Pilot[Any]) -> None:
        assert await appears(pilot, lambda: screen_of(pilot).count("operational") >= 2)
        await asyncio.to_thread(daemon.kill)
        assert await appears(pilot, lambda: "DAEMON AWAY" in screen_of(pilot))
        text = screen_of(pilot)
        assert "load and frames/s not available" in text
        assert "away: no daemon has published hand 'hand' for" in text
        assert text.count("lost: daemon away") == 2
        assert "nothing known" in text
        assert "nothing touches" not in text
        assert await appears(
            pilot, lambda: "host no daemon has published hand 'hand' for" in screen_of(pilot)
        )
        pilot.app.simulate_key("t")
        assert await appears(pilot, lambda: "does not accept commands" in screen_of(pilot).split("\n")[-1])
        await asyncio.to_thread(lambda: (daemon.start(), daemon.wait_until_up()))
        assert await appears(pilot, lambda: "host its daemon is back" in screen_of(pilot))
        assert await appears(pilot, lambda: screen_of(pilot).count("operational") >= 2)
        assert "DAEMON AWAY" not in screen_of(pilot)

    faults = on_screen(port, play)
    assert {"p0: lost", "p1: lost"} <= set(faults)
    # with the newest reason, which may already be that of a daemon that is back and starting
    assert [line for line in faults if line.startswith("can0: away: ")], faults


@pytest.mark.long
def test_json_goes_on_when_the_daemon_is_back(
    start: Callable[..., Process], monitor: Callable[[], Monitor]
) -> None:
    daemon = start(period_ms=100).wait_until_up()
    shown = monitor()
    shown.until(lambda line: conditions(line) == {"operational"})
    daemon.kill()
    away = shown.until(lambda line: line["away"] and line["fields_hz"] == 0)
    daemon.start()
    daemon.wait_until_up()
    shown.until(lambda line: line["away"] is None and conditions(line) == {"operational"})
    status, said = shown.stop()
    assert status == 1
    assert away["away"].startswith("no daemon has published hand 'hand' for ")
    assert away["buses"]["can0"]["load"] is None
    assert conditions(away) == {"lost"}
    events = [event for line in shown.lines for event in line["events"]]
    assert sum(event.startswith("host: no daemon has published hand") for event in events) == 1
    assert "host: its daemon is back" in events
    assert {"fault: p0: lost", "fault: p1: lost"} <= set(said)


@pytest.mark.long
def test_a_daemon_with_another_hand_is_one_line(
    start: Callable[..., Process], monitor: Callable[[], Monitor]
) -> None:
    first = start().wait_until_up()
    shown = monitor()
    shown.until(lambda line: conditions(line) == {"operational"})
    first.kill()
    start(patches=3).wait_until_up()
    status, said = shown.end()
    assert status == 2
    assert said == ["error: hand 'hand': its daemon has restarted with another hand file; connect again"]


@pytest.mark.parametrize("command", ["monitor", "view"])
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--router", "tcp/robot:7447"], "--router: got 'tcp/robot:7447', allowed: only with --remote"),
        (["--zenoh-port", "18000"], "--zenoh-port: got 18000, allowed: only with --remote"),
        (["--remote", "hand", "--zenoh-port", "80"], "--zenoh-port: got 80, allowed: an integer from 1024"),
        (["--remote", "hand", "--router", "robot"], "--router: got 'robot', allowed: an endpoint such as"),
        (
            ["--remote", "hand", "--zenoh-config", "/nowhere"],
            "--zenoh-config: got '/nowhere', allowed: a Zen",
        ),
        (["--remote", ""], "hand: got '', allowed: the name of a hand: printable characters, not all blank"),
        (["--remote", "\udcff"], "hand: got '\\udcff', allowed: the name of a hand"),
        (["--remote", "hand", "--channel", "can1"], "--channel: got 'can1', allowed: only without --remote"),
        (["--remote", "hand", "--speed", "2"], "--speed: got 2.0, allowed: only with --replay"),
        (
            ["--remote", "hand", "--replay", "run.log"],
            "--replay: got both it and --remote, allowed: one of HAND",
        ),
    ],
)
def test_a_wrong_option_is_one_line(
    command: str, arguments: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skinnode.view.viewer_process.require_viewer", lambda: None)
    hand = [] if "--remote" in arguments else ["--simulate"]
    out = ["--json"] if command == "monitor" else ["--save", "/nowhere/x.rrd"]
    done = run_here(command, *hand, *arguments, *out)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert said in done.stderr


def test_a_wrong_name_is_one_line(start: Callable[..., Process], port: int) -> None:
    start(name="left hand").wait_until_up()
    status, lines, said = refused(port)
    assert (status, lines) == (2, [])
    assert said == "error: hand: got 'hand', allowed: one of the published hands: 'left hand'\n"


def test_a_missing_extra_is_one_line(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "skinnode.remote.session.find_spec", lambda name: None if name == "zenoh" else find_spec(name)
    )
    status, lines, said = refused(port)
    assert (status, lines) == (2, [])
    assert said == (
        "error: --remote: got no package eclipse-zenoh, allowed: the packages of the zenoh extra "
        "(install: sh install.sh zenoh)\n"
    )


def test_the_drawing_of_a_remote_hand(start: Callable[..., Process], port: int) -> None:
    """Fields arrive at the drawing bit for bit; while the daemon is away, nothing is drawn as current."""
    daemon = start().wait_until_up()
    ticks: list[Tick] = []

    def views() -> list[Any]:
        return [tick.view for tick in ticks if tick.view is not None]

    with sk.connect("hand", port=port, timeout_s=PATIENCE_S) as hand, RemoteSource(hand) as source:
        every = hand.fields(capacity=10_000)
        with DrawingThread(source, ticks.append, rate_hz=200.0) as thread:
            eventually(lambda: thread.counts.drawn > 20)
            eventually(lambda: {patch.condition for patch in views()[-1].patches} == {"operational"})
            assert views()[-1].buses[0].load is not None
            daemon.kill()
            eventually(lambda: views()[-1].away is not None)
            time.sleep(0.5)
        assert thread.failure is None
        published = []  # a host that is held up may assemble one scan in two parts
        while (field := every.get(0.0)) is not None:
            assert field.stamp is not None
            published.append((field.stamp.patch, field.stamp.scan, field.displacement_m.tobytes()))
    drawn = [(name, field) for tick in ticks for name, field in tick.fields.items()]
    assert len(drawn) + thread.counts.left_out + thread.counts.dropped == len(published)
    for name, field in drawn:
        assert field.stamp is not None
        assert (name, field.stamp.scan, field.displacement_m.tobytes()) in published
    last = views()[-1]
    assert {patch.condition for patch in last.patches} == {"lost"}
    assert last.buses[0].load is None


def test_the_view_saves_a_remote_hand(
    start: Callable[..., Process], port: int, tmp_path: Path, sdk: None
) -> None:
    start().wait_until_up()
    path = tmp_path / "hand.rrd"
    done = run_here(
        "view", "--remote", "hand", "--zenoh-port", str(port), "--save", str(path), "--seconds", "3"
    )
    assert done.returncode in (0, 1), done.stderr
    from tests.view.test_rrd import Rows

    rows = Rows(path)
    for name in ("p0", "p1"):
        assert len(rows.scans(f"/skin/hand/{name}/surface")) > 10
    health = rows.in_time("/health")[-1]["TextDocument:text"].as_py()[0]
    assert "not available" in health
