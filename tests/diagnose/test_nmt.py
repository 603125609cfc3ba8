"""NMT commands: nodes follow, and one that does not is told."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from skinnode.canopen import indices as od
from skinnode.config import BusConfig
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.node import NmtState, PatchNode
from skinnode.transport import CanPort

from .conftest import run

Powered = Callable[..., list[PatchNode]]
ConnectionOn = Callable[[BusConfig], BusConnection]


@pytest.mark.parametrize("heartbeat_ms", [0, 100])
def test_a_node_follows(
    any_bus: BusConfig, powered: Powered, connection_on: ConnectionOn, heartbeat_ms: int
) -> None:
    (node,) = powered(any_bus, 5)
    connection_on(any_bus).od(5).write(od.HEARTBEAT_PRODUCER, 0, "u16", heartbeat_ms)
    by = "heartbeat" if heartbeat_ms else "guarding"
    for command, before, after, state in (
        ("start", "pre-operational", "operational", NmtState.OPERATIONAL),
        ("pre-operational", "operational", "pre-operational", NmtState.PRE_OPERATIONAL),
        ("stop", "pre-operational", "stopped", NmtState.STOPPED),
    ):
        done = run(["nmt", "5", command, "--json"], any_bus)
        assert done.status == 0
        change = {"node_id": 5, "before": before, "after": after, "followed": True, "known_by": by}
        assert done.json == [{**change, "bus": any_bus.channel}]
        assert node.nmt_state is state


def test_a_stopped_node_is_reset(bus: BusConfig, powered: Powered, connection_on: ConnectionOn) -> None:
    (node,) = powered(bus, 5)
    connection = connection_on(bus)
    connection.od(5).write(od.HEARTBEAT_PRODUCER, 0, "u16", 100)
    connection.link.send(0, bytes((2, 5)))
    assert connection.wait_until(lambda: node.nmt_state is NmtState.STOPPED, 5.0)
    done = run(["nmt", "5", "reset-node", "--json"], bus)
    assert done.status == 0
    (change,) = done.json
    assert (change["before"], change["after"]) == ("stopped", "pre-operational")
    assert change["known_by"] == "boot-up message, guarding"  # 0x1017 is 0 again


def test_all_nodes_at_once(bus: BusConfig, powered: Powered) -> None:
    nodes = powered(bus, 5, 6, 7)
    done = run(["nmt", "all", "start"], bus)
    assert done.status == 0
    assert {node.nmt_state for node in nodes} == {NmtState.OPERATIONAL}
    assert done.stdout.count("operational") >= 6


def test_a_node_that_does_not_follow(
    bus: BusConfig, powered: Powered, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skinnode.diagnose.nmt_commands.FOLLOW_S", 0.3)
    (node,) = powered(bus, 5)
    monkeypatch.setattr(node, "_on_nmt", lambda data, t_ns: None)
    node._reload()
    done = run(["nmt", "5", "start"], bus)
    assert done.status == 1
    assert "DID NOT FOLLOW: by guarding, not operational" in " ".join(done.stdout.split())


def test_nobody_or_nonsense(bus: BusConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinnode.diagnose.nmt_commands.BOOT_S", 0.2)
    monkeypatch.setattr("skinnode.diagnose.bus_connection.LONGEST_HEARTBEAT_S", 0.2)
    with CanPort(bus):  # acknowledges each frame, which would otherwise be sent again and again
        done = run(["nmt", "5", "reset-node"], bus)
        assert done.status == 1
        assert "no boot-up message" in done.stdout
        assert run(["nmt", "all", "start"], bus).status == 2
    done = run(["nmt", "5", "go"], bus)
    assert done.status == 2
    assert "COMMAND: got 'go', allowed: start, stop" in done.stderr
