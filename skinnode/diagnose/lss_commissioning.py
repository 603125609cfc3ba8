"""A node gets its node-ID and its bit rate by LSS."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen import nmt
from skinnode.canopen.lss import LssAddress
from skinnode.canopen.sdo import upload_request
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.diagnose.discovery import find_unconfigured
from skinnode.errors import ConfigError
from skinnode.host.lss_master import LssFailed

BOOT_S: Final = 5.0
"""How long a node may take to boot at its new node-ID."""

_ASKED_S: Final = 0.15
_ASK_DEVICE_TYPE: Final = upload_request(od.DEVICE_TYPE, 0)


@dataclass(frozen=True, slots=True)
class Commissioned:
    """What was done."""

    address: LssAddress
    node_id_before: int | None
    """None for a node that had none."""
    node_id: int | None
    """The new one; None where it stays."""
    bitrate_bps: int | None
    """From the next power-on on; None where it stays."""
    stored: bool
    booted: bool
    """At the new node-ID; also True where that stays."""
    faults: tuple[str, ...]


def only_unconfigured(connection: BusConnection) -> LssAddress:
    """The one node that has no node-ID. Raises ConfigError where there is none, or several."""
    found, more = find_unconfigured(connection)
    if len(found) != 1 or more:
        serials = ", ".join(str(address.serial_number) for address in found)
        if not found:
            raise ConfigError("--serial", None, "a serial number, because no node without a node-ID answers")
        there = f"{len(found)}{' and more' if more else ''} nodes have no node-ID (serials {serials})"
        raise ConfigError("--serial", None, f"a serial number, because {there}")
    return found[0]


def commission(
    connection: BusConnection,
    address: LssAddress,
    *,
    node_id: int | None,
    bitrate_bps: int | None,
    store: bool,
    agreed: Callable[[int | None], bool],
) -> Commissioned | None:
    """Set what is given; ``agreed`` is told the present node-ID before anything is written, and None is
    returned where it says no. Raises ConfigError for a node-ID that is taken or a node that is not there,
    LssFailed where it refuses.
    """
    if node_id is not None and connection.ask_all(node_id, _ASK_DEVICE_TYPE, _ASKED_S):
        raise ConfigError("--node-id", node_id, "one that no other node has")
    if not connection.lss.select(address):
        raise ConfigError("--serial", address.serial_number, "the serial number of a node on this bus")
    faults: list[str] = []
    stored = False
    boot_ups = 0 if node_id is None else connection.listener.node(node_id).boot_ups
    try:
        before = connection.lss.node_id()
        if not agreed(before):
            return None
        if bitrate_bps is not None:
            connection.lss.set_bit_rate(bitrate_bps)
        if node_id is not None:
            connection.lss.set_node_id(node_id)
        if store:
            try:
                connection.lss.store()
                stored = True
            except LssFailed as error:
                faults.append(f"not stored, so lost at power-off: {error}")
    finally:  # a node without a node-ID boots when it is let go
        connection.lss.release()
    booted = True
    if node_id is not None and node_id != before:
        if before is not None:
            time.sleep(0.01)  # the switch to waiting comes first
            connection.link.send(od.NMT_COB_ID, nmt.encode(nmt.NmtCommand.RESET_COMMUNICATION, before))
        booted = connection.wait_until(lambda: connection.listener.node(node_id).boot_ups > boot_ups, BOOT_S)
        if not booted:
            faults.append(f"no boot-up message of node {node_id} within {BOOT_S:g} s")
    return Commissioned(address, before, node_id, bitrate_bps, stored, booted, tuple(faults))
