"""Nodes get their node-ID by serial number, keep it, and nobody else's is taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from skinnode.canopen.lss import NOT_CONFIGURED
from skinnode.config import BusConfig
from skinnode.node import NmtState, PatchNode, VolatileMemory
from skinnode.protocol.profile import PatchProfile

from .conftest import LAYOUT, boards, run

Powered = Callable[..., list[PatchNode]]


def test_the_only_node_without_a_node_id_gets_one(any_bus: BusConfig, powered: Powered) -> None:
    (node,) = powered(any_bus, NOT_CONFIGURED, serial=7)
    done = run(["lss", "list", "--json"], any_bus)
    address = {"vendor_id": 0, "product_code": 0x534B494E, "revision_number": 0x10001, "serial_number": 7}
    assert done.json["unconfigured"] == [{**address, "bus": any_bus.channel}]
    done = run(["lss", "set", "--node-id", "5", "--yes"], any_bus)
    assert done.status == 0
    assert done.stdout == "serial 7: node-ID none → 5, stored\n"
    assert (node.node_id, node.nmt_state) == (5, NmtState.PRE_OPERATIONAL)
    assert run(["lss", "list"], any_bus).stdout == "0 nodes without a node-ID\n"


def test_a_node_of_revision_1_0_is_found_by_its_serial_number(bus: BusConfig, powered: Powered) -> None:
    old = replace(PatchProfile.from_layout(LAYOUT), checked=False)
    powered(bus, 6, serial=8, profile=old)
    done = run(["lss", "set", "--serial", "8", "--node-id", "9", "--json", "--yes"], bus)
    assert done.status == 0
    assert done.json["address"]["revision_number"] == 0x10000
    assert done.json["node_id"] == 9


def test_it_is_kept_over_a_power_cycle(bus: BusConfig) -> None:
    memory = VolatileMemory()
    with boards(bus, NOT_CONFIGURED, serial=7, memory=memory):
        assert run(["lss", "set", "--serial", "7", "--node-id", "5", "--yes"], bus).status == 0
    with boards(bus, NOT_CONFIGURED, serial=7, memory=memory) as (node,):
        assert run(["od", "5", "1018:4", "--json"], bus).json[0]["value"] == 7
        assert node.node_id == 5


def test_a_node_is_moved_by_its_serial_number(bus: BusConfig, powered: Powered) -> None:
    (moved,), (other,) = powered(bus, 5, serial=7), powered(bus, 6, serial=8)
    done = run(["lss", "set", "--serial", "7", "--node-id", "9", "--json", "--yes"], bus)
    assert done.status == 0
    assert (done.json["node_id_before"], done.json["node_id"], done.json["booted"]) == (5, 9, True)
    assert (moved.node_id, other.node_id) == (9, 6)


def test_it_asks_first(bus: BusConfig, powered: Powered) -> None:
    (node,) = powered(bus, 5, serial=7)
    done = run(["lss", "set", "--serial", "7", "--node-id", "9"], bus, answers="n\n")
    assert done.status == 2
    assert "nothing was changed" in done.stderr
    assert node.node_id == 5
    assert run(["lss", "set", "--serial", "7", "--node-id", "9"], bus, answers="y\n").status == 0
    assert node.node_id == 9


def test_a_node_without_memory_says_that_it_forgets(bus: BusConfig, powered: Powered) -> None:
    (node,) = powered(bus, NOT_CONFIGURED, serial=7, memory=None)
    done = run(["lss", "set", "--node-id", "5", "--yes"], bus)
    assert done.status == 1
    assert "not stored and will be lost at power-off" in done.stdout
    assert node.node_id == 5


def test_what_is_refused(bus: BusConfig, powered: Powered) -> None:
    powered(bus, 5, serial=7)
    for arguments, line in (
        (["--serial", "7", "--node-id", "5"], "--node-id: got 5, allowed: a node-ID that no other node has"),
        (["--serial", "8", "--node-id", "6"], "--serial: got 8, allowed: the serial number of a node"),
        (["--node-id", "6"], "because the search for nodes without a node-ID found none"),
        (["--serial", "7"], "--node-id, --bit-rate"),
        (["--serial", "7", "--bit-rate", "123"], "--bit-rate: got 123, allowed: 1000000, 800000"),
        (["--serial", "7", "--bit-rate", "500000"], "bit rate 500000: got error code 1"),
    ):
        done = run(["lss", "set", "--yes", *arguments], bus)
        assert done.status == 2
        assert line in done.stderr


def test_several_without_a_node_id_need_a_serial_number(bus: BusConfig, powered: Powered) -> None:
    first = powered(bus, NOT_CONFIGURED, serial=7)[0]
    second = powered(bus, NOT_CONFIGURED, serial=8)[0]
    done = run(["lss", "set", "--node-id", "5", "--yes"], bus)
    assert done.status == 2
    assert "because 2 nodes have no node-ID (serials 7, 8)" in done.stderr
    assert run(["lss", "set", "--serial", "8", "--node-id", "5", "--yes"], bus).status == 0
    assert (first.node_id, second.node_id) == (NOT_CONFIGURED, 5)
