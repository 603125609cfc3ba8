"""Programs, routers and daemons that are killed or stopped: who notices, who loses what, and who returns."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from typing import Any

import pytest

import skinnode as sk
from skinnode.host import Condition
from skinnode.host.events import EventSubscription
from tests.remote.conftest import Process, eventually
from tests.remote.ports import free_ports

pytestmark = pytest.mark.system_time


def received(hand: sk.RemoteHand) -> int:
    return sum(each.received for each in hand.stats().patches.values())


def new(events: EventSubscription) -> list[str]:
    found = []
    while (event := events.get(0.0)) is not None:
        found.append(event.what)
    return found


def counts(program: Process) -> Any:
    return json.loads(program.tell("counts"))


@pytest.mark.long
def test_a_program_is_killed(start: Callable[..., Process], run: Callable[..., Process], port: int) -> None:
    daemon = start(period_ms=25).wait_until_up()
    victim = run("program.py", "hand", str(port)).wait_until_up()
    with sk.connect("hand", port=port) as hand:
        for _ in range(2):
            before = received(hand)
            victim.restart()
            victim.wait_until_up()
            eventually(lambda: counts(victim)["patches"]["p0"]["received"] > 5)
            assert received(hand) > before
        assert [each.lost for each in hand.stats().patches.values()] == [0, 0]
        assert hand.away is None
        assert json.loads(daemon.tell("stats"))["dropped"] == 0


@pytest.mark.long
def test_a_stopped_program_harms_nobody(
    start: Callable[..., Process], run: Callable[..., Process], port: int
) -> None:
    daemon = start(period_ms=25).wait_until_up()
    stopped = run("program.py", "hand", str(port)).wait_until_up()
    eventually(lambda: counts(stopped)["patches"]["p0"]["received"] > 5)
    with sk.connect("hand", port=port) as hand:
        stopped.process.send_signal(signal.SIGSTOP)
        before = received(hand)
        eventually(lambda: received(hand) > before + 250)  # for longer than the lease of the connection
        stats = json.loads(daemon.tell("stats"))
        assert [each.lost for each in hand.stats().patches.values()] == [0, 0]
        assert stats["dropped"] == 0
        stopped.process.send_signal(signal.SIGCONT)
        seen = counts(stopped)["patches"]["p0"]["sequence"]
        eventually(lambda: counts(stopped)["patches"]["p0"]["sequence"] > seen + 20)
        each = counts(stopped)["patches"]["p0"]
        assert each["runs"] == 1
        assert each["received"] + each["lost"] <= each["sequence"]
        eventually(lambda: counts(stopped)["away"] is None)


@pytest.mark.long
def test_a_program_may_start_before_the_daemon(
    start: Callable[..., Process], run: Callable[..., Process], port: int
) -> None:
    program = run("program.py", "hand", str(port))
    daemon = start()  # both take about as long to load; the daemon then brings up its hand
    daemon.wait_until_up()
    program.wait_until_up()
    eventually(lambda: counts(program)["patches"]["p1"]["received"] > 5)


@pytest.mark.long
def test_the_daemon_is_killed_and_returns(start: Callable[..., Process], port: int) -> None:
    daemon = start().wait_until_up()
    with sk.connect("hand", port=port) as hand:
        fields, events = hand.fields(), hand.events()
        eventually(lambda: received(hand) > 10)
        daemon.kill()
        eventually(lambda: hand.away is not None, 2.0)
        assert "no daemon has published hand 'hand' for" in str(hand.away)
        health = hand.health("p0")
        assert health.condition is Condition.LOST
        assert "no daemon" in health.reason
        assert "no daemon" in str(hand.bus_health("can0").away)
        while fields.get(0.1) is not None:  # waits, and does not end
            pass
        eventually(lambda: "away" in new(events), 2.0)
        daemon.start()
        daemon.wait_until_up()
        assert fields.get(10.0) is not None
        eventually(lambda: "back" in new(events))
        eventually(lambda: hand.health("p0").condition is Condition.OPERATIONAL)
        eventually(lambda: all(each.runs == 2 for each in hand.stats().patches.values()))
        assert [each.lost for each in hand.stats().patches.values()] == [0, 0]


@pytest.mark.long
def test_the_router_is_killed_and_returns(
    start: Callable[..., Process], run: Callable[..., Process], port: int
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_ports(1)}"
    router = run("router.py", json.dumps({"listen": endpoint})).wait_until_up()
    daemon = start(router=endpoint, period_ms=25).wait_until_up()
    with sk.connect("hand", port=port) as near, sk.connect("hand", router=endpoint, timeout_s=30.0) as far:
        eventually(lambda: received(far) > 10)
        router.kill()
        eventually(lambda: far.away is not None, 2.0)
        assert near.away is None  # programs on the daemon's machine do not need the router
        missing = far.stats().patches["p0"]
        published = json.loads(daemon.tell("stats"))["published"]["p0"]
        eventually(lambda: json.loads(daemon.tell("stats"))["published"]["p0"] > published + 20)
        router.start()
        router.wait_until_up()
        eventually(lambda: far.stats().patches["p0"].received > missing.received + 10)
        eventually(lambda: far.away is None)
        each = far.stats().patches["p0"]
        assert each.lost >= 15
        assert each.runs == 1
        assert each.received + each.lost == each.sequence - missing.sequence + missing.received + missing.lost
        assert [each.lost for each in near.stats().patches.values()] == [0, 0]
