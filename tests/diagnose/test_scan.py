"""Who is on a bus: what is there is found, what is not there is not, and nobody is disturbed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from skinnode.canopen import indices as od
from skinnode.canopen.lss import NOT_CONFIGURED, LssAddress, LssCommand
from skinnode.config import BusConfig
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.diagnose.discovery import discover
from skinnode.node import NmtState, PatchNode, VolatileMemory
from skinnode.node.lss import LssSlave
from skinnode.transport import CanPort

from .conftest import LAYOUT, run

Powered = Callable[..., list[PatchNode]]
ConnectionOn = Callable[[BusConfig], BusConnection]


def test_finds_every_node_with_its_identity(
    any_bus: BusConfig, powered: Powered, connection_on: ConnectionOn
) -> None:
    powered(any_bus, 1, 64, 127)
    connection = connection_on(any_bus)
    connection.od(64).write(od.HEARTBEAT_PRODUCER, 0, "u16", 50)
    connection.link.send(0, bytes((1, 64)))  # NMT start
    found = discover(connection)
    assert [(n.node_id, n.serial, n.name) for n in found.nodes] == [
        (1, 1, "skinnode patch"),
        (64, 64, "skinnode patch"),
        (127, 127, "skinnode patch"),
    ]
    assert [(n.state, n.state_known_by) for n in found.nodes] == [
        ("pre-operational", "guarding"),
        ("operational", "heartbeat"),
        ("pre-operational", "guarding"),
    ]
    assert {(n.vendor_id, n.product_code, n.revision) for n in found.nodes} == {(0, 0x534B494E, 0x10001)}
    assert [n.duplicate for n in found.nodes] == ["", "", ""]
    assert found.unconfigured == ()
    assert found.seconds < 3.0


def test_a_heartbeat_every_four_seconds_is_waited_for(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn
) -> None:
    powered(bus, 5)
    connection_on(bus).od(5).write(od.HEARTBEAT_PRODUCER, 0, "u16", 4000)
    (found,) = discover(connection_on(bus)).nodes
    assert (found.state, found.state_known_by) == ("pre-operational", "heartbeat")


def test_a_slow_bus_can_carry_the_requests(bus: BusConfig, connection_on: ConnectionOn) -> None:
    """At 50 kbit/s, a frame of 8 bytes takes at least 2.16 ms."""
    connection = connection_on(bus.model_copy(update={"bitrate_bps": 50_000}))
    times_ns: list[int] = []
    connection.link.listen_to_sent(
        lambda frame: times_ns.append(frame.t_ns) if 0x601 <= frame.can_id <= 0x67F else None
    )
    discover(connection)
    assert len(times_ns) == 2 * 127
    assert times_ns[126] - times_ns[0] > 126 * 2 * 2_160_000  # each request, and a response to each


@pytest.mark.long
def test_nodes_without_a_node_id_are_told_apart_and_wait_again(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn
) -> None:
    serials = (0, 7, 0xDEADBEEF)
    nodes = [powered(bus, NOT_CONFIGURED, serial=serial)[0] for serial in serials]
    addresses = [LssAddress(0, 0x534B494E, 0x10001, serial) for serial in serials]

    def finds_all() -> bool:
        """Search once: a node that does not answer in time is not found."""
        found = discover(connection_on(bus))
        assert set(found.unconfigured) <= set(addresses)
        return sorted(found.unconfigured) == addresses and not found.more_unconfigured

    assert any(finds_all() for _ in range(5))
    assert {node.nmt_state for node in nodes} == {NmtState.INITIALISING}
    assert any(finds_all() for _ in range(5))


def test_a_node_that_serves_fastscan_alone_is_found(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As CANopenNode does: no answer to *identify non-configured remote slave*."""
    serve = LssSlave.on_request

    def fastscan_alone(slave: LssSlave, data: bytes) -> bytes | None:
        return None if data[0] == LssCommand.IDENTIFY_NOT_CONFIGURED else serve(slave, data)

    monkeypatch.setattr(LssSlave, "on_request", fastscan_alone)
    powered(bus, NOT_CONFIGURED, serial=7)
    assert discover(connection_on(bus)).unconfigured == (LssAddress(0, 0x534B494E, 0x10001, 7),)


@pytest.mark.system_time  # on a bus with exact times, the two answers collide
def test_two_nodes_with_one_node_id(bus: BusConfig, powered: Powered) -> None:
    powered(bus, 9, serial=111)
    powered(bus, 9, serial=222)
    done = run(["scan"], bus)
    assert done.status == 1
    assert "two nodes have this node-ID" in done.stdout
    assert "serials 111 and 222" in " ".join(done.stdout.split())


def test_a_stopped_node_is_found_by_its_heartbeat(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn
) -> None:
    powered(bus, 5)
    connection = connection_on(bus)
    connection.od(5).write(od.HEARTBEAT_PRODUCER, 0, "u16", 100)
    connection.link.send(0, bytes((2, 5)))  # NMT stop
    (node,) = discover(connection).nodes
    assert (node.node_id, node.answers, node.state) == (5, False, "stopped")


def test_a_node_that_a_master_guards_is_not_asked_by_remote_frame(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn
) -> None:
    powered(bus, 5)
    connection = connection_on(bus)
    connection.od(5).write(od.GUARD_TIME, 0, "u16", 100)
    connection.od(5).write(od.LIFE_TIME_FACTOR, 0, "u8", 3)
    with CanPort(bus) as listener:
        (node,) = discover(connection).nodes
        remotes = []
        while (frame := listener.recv(0.0)) is not None:
            remotes += [frame.can_id] if frame.remote else []
    assert node.state == "unknown"
    assert "might start life guarding" in node.state_known_by
    assert remotes == []


def test_hand_says_who_is_missing_or_another(bus: BusConfig, powered: Powered, tmp_path: Path) -> None:
    powered(bus, 5, 6)
    hand = tmp_path / "hand.toml"
    hand.write_text(
        f'[[buses]]\nname = "b"\ninterface = "{bus.interface}"\nchannel = "{bus.channel}"\n'
        '[[patches]]\nname = "thumb"\nnode_id = 5\nbus = "b"\nserial = 77\n'
        '[[patches]]\nname = "index"\nnode_id = 6\nbus = "b"\n'
        '[[patches]]\nname = "palm"\nnode_id = 7\nbus = "b"\n'
    )
    done = run(["scan", "--json", "--hand", hand])
    assert done.status == 1
    assert [node["patch"] for node in done.json["nodes"]] == ["thumb", "index"]
    assert done.json["faults"] == [
        "patch 'thumb': node 5 has serial 5, not 77",
        "patch 'palm': no node 7",
    ]


@pytest.mark.long
def test_an_empty_bus_is_a_fault(bus: BusConfig) -> None:
    done = run(["scan"], bus)
    assert done.status == 1
    assert "no node answered" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--interface", "no-such"], "interface"),
        (["--interface", "virtual", "--bitrate", "5"], "--bitrate: got 5, allowed: a bit rate from"),
        (["--channel", ""], "--channel: got '', allowed: a name of printable characters"),
        (["--channel", "a\x1b"], "--channel: got 'a\\x1b', allowed: a name of printable characters"),
        (["--interface", ""], "--interface: got '', allowed: a name of printable characters"),
        (["--bus", "can1"], "--bus: got 'can1', allowed: only with a hand file"),
        (["--hand", "no/such.toml"], "hand file"),
    ],
)
def test_what_cannot_run_is_status_2(arguments: list[str], line: str) -> None:
    done = run(["scan", *arguments])
    assert done.status == 2
    assert line in done.stderr


def test_nothing_is_changed_in_a_node(bus: BusConfig, powered: Powered, connection_on: ConnectionOn) -> None:
    """Uploads, LSS questions and remote frames are all that is sent."""
    powered(bus, 5, memory=VolatileMemory(), layout=LAYOUT)
    sent: list[tuple[int, bytes, bool]] = []
    with CanPort(bus) as listener:
        discover(connection_on(bus))
        while (frame := listener.recv(0.0)) is not None:
            if frame.can_id & 0x780 in (0x600, 0x700, 0x000) or frame.can_id == 0x7E5:
                sent.append((frame.can_id, frame.data, frame.remote))
    assert {can_id for can_id, _, remote in sent if remote} == {0x705}
    sdo = {data[0] & 0xE0 for can_id, data, _ in sent if can_id & 0x780 == 0x600}
    assert sdo == {0x40, 0x60}  # upload, and its segments
    assert 0x000 not in {can_id for can_id, _, _ in sent}
    # Identify non-configured, and the question of fastscan that asks whether there is anybody.
    lss = {data for can_id, data, _ in sent if can_id == 0x7E5}
    assert lss == {b"\x4c" + bytes(7), b"\x51\0\0\0\0\x80\0\0"}
