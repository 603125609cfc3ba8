"""``skinnode scan``: finds the nodes on a bus."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from skinnode.cli._options import Bitrate, Bus, Channel, Fd, Hand, Interface, Json

if TYPE_CHECKING:
    from skinnode.cli._bus import Place
    from skinnode.diagnose.discovery import Discovery, FoundNode


def scan(
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    hand: Hand = None,
    bus: Bus = None,
    as_json: Json = False,
) -> None:
    """Find every node on a bus: by SDO, by heartbeat, and by LSS if it has no node-ID.

    With --hand, the command scans every bus of the hand. The command changes nothing on the nodes and takes
    two seconds per bus, or longer if heartbeats are more than a second apart. The exit status is 0 if nodes
    were found and none of them has a fault. The exit status is 1 if no node was found, if two nodes share a
    node-ID, or if a node of the hand is missing or is a different device. The exit status is 2 if the scan
    could not run.
    """
    from skinnode.cli._bus import find_buses
    from skinnode.cli._console import print_json, progress
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.discovery import discover

    scans: list[tuple[Place, Discovery]] = []
    with progress(as_json) as tell:
        for place in find_buses(interface, channel, bitrate, fd, hand, bus):
            with BusConnection(place.bus) as connection:
                scans.append((place, discover(connection, tell)))
    named = len(scans) > 1
    faults = [
        f"{place.bus.name}: {fault}" if named else fault
        for place, found in scans
        for fault in _faults(found, place)
    ]
    if as_json:
        print_json(_as_json(scans, faults))
    else:
        _print(scans, faults)
    if faults:
        raise typer.Exit(1)


def _faults(found: Discovery, place: Place) -> list[str]:
    """Return the faults found by the scan, one line each."""
    from skinnode.diagnose.bus_connection import no_answer
    from skinnode.text.words import known

    faults = [
        f"node {node.node_id}: two nodes have this node-ID: {node.duplicate}"
        for node in found.nodes
        if node.duplicate
    ]
    there = {node.node_id: node for node in found.nodes}
    for patch in () if place.hand is None else place.hand.patches_on(place.bus.name):
        node = there.get(patch.node_id)
        if node is None:
            faults.append(f"patch {patch.name!r}: no node {patch.node_id}")
        elif not node.answers:
            answer = "does not answer" if not node.wrong_answer else no_answer(node.wrong_answer)
            faults.append(f"patch {patch.name!r}: node {patch.node_id} is {node.state} and {answer}")
        elif not node.is_patch:
            faults.append(
                f"patch {patch.name!r}: node {patch.node_id} is a different device ({node.name or 'unnamed'})"
            )
        elif patch.serial not in (None, node.serial):
            faults.append(
                f"patch {patch.name!r}: node {patch.node_id} has serial {known(node.serial)}, "
                f"not {patch.serial}"
            )
    if not found.nodes and not found.unconfigured:
        faults.insert(0, "no node answered; check cable, termination, supply and bit rate")
    return faults


def _as_json(scans: list[tuple[Place, Discovery]], faults: list[str]) -> dict[str, object]:
    """Return the scan results as JSON-compatible data; each node's entry includes the name of its bus."""
    from dataclasses import asdict

    first = scans[0][0].bus
    alone = {"interface": first.interface, "channel": first.channel} if len(scans) == 1 else {}
    return {
        **alone,
        "buses": [
            {"name": place.bus.name, "interface": place.bus.interface, "channel": place.bus.channel}
            for place, _ in scans
        ],
        "nodes": [
            {**asdict(node), "patch": place.patch_name(node.node_id) or None, "bus": place.bus.name}
            for place, found in scans
            for node in found.nodes
        ],
        "unconfigured": [
            {**address._asdict(), "bus": place.bus.name}
            for place, found in scans
            for address in found.unconfigured
        ],
        "more_unconfigured": any(found.more_unconfigured for _, found in scans),
        "faults": faults,
        "seconds": round(sum(found.seconds for _, found in scans), 3),
    }


def _print(scans: list[tuple[Place, Discovery]], faults: list[str]) -> None:
    from skinnode.cli._console import console

    out = console()
    for number, (place, found) in enumerate(scans):
        if number:
            out.print()
        _print_bus(found, place)
    for fault in faults:
        out.print(f"fault: {fault}")


def _print_bus(found: Discovery, place: Place) -> None:
    from skinnode.cli._console import console, table
    from skinnode.text.words import counted

    out = console()
    if found.nodes:
        listed = table(
            "node", "state", "device", "vendor:product", "revision", "serial", right=("node", "serial")
        )
        for node in found.nodes:
            listed.add_row(
                str(node.node_id),
                node.state,
                _device(node, place),
                _vendor_product(node.vendor_id, node.product_code),
                _revision(node.revision),
                "" if node.serial is None else str(node.serial),
            )
        out.print(listed)
    for address in found.unconfigured:
        out.print(
            f"without a node-ID: serial {address.serial_number}, "
            f"vendor:product {_vendor_product(address.vendor_id, address.product_code)}"
        )
    if found.more_unconfigured:
        out.print("there are more nodes without a node-ID; to find them, run: skinnode lss list")
    nodes = counted(len(found.nodes), "node")
    out.print(f"{nodes} on {place.bus.interface} {place.bus.channel}, {found.seconds:.1f} s")


def _device(node: FoundNode, place: Place) -> str:
    if node.answers:
        name = node.name or f"unnamed, {node.profile.replace('device ', '') or 'answers'}"
    else:
        name = "no valid answer" if node.wrong_answer else "does not answer"
    patch = place.patch_name(node.node_id)
    return f"{name} ({patch})" if patch else name


def _vendor_product(vendor_id: int | None, product_code: int | None) -> str:
    return f"{_hex(vendor_id)}:{_hex(product_code)}"


def _hex(value: int | None) -> str:
    return "?" if value is None else f"{value:08X}"


def _revision(value: int | None) -> str:
    return "" if value is None else f"{value >> 16}.{value & 0xFFFF}"
