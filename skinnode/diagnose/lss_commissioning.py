"""Sets the node-ID and bit rate of a node by LSS (CiA 305)."""

from __future__ import annotations

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
from skinnode.process import clock

BOOT_S: Final = 5.0
"""Maximum time for a node to boot with its new node-ID, in s."""

_ASKED_S: Final = 0.15
_ASK_DEVICE_TYPE: Final = upload_request(od.DEVICE_TYPE, 0)


@dataclass(frozen=True, slots=True)
class Commissioned:
    """Result of setting a node's node-ID or bit rate by LSS."""

    address: LssAddress
    node_id_before: int | None
    """Previous node-ID; None if the node had none."""
    node_id: int | None
    """New node-ID; None if unchanged."""
    bitrate_bps: int | None
    """New bit rate in bit/s, which takes effect at the next power-on; None if unchanged."""
    stored: bool
    booted: bool
    """Whether the node booted with its new node-ID; True if the node-ID is unchanged."""
    faults: tuple[str, ...]


def only_unconfigured(connection: BusConnection) -> LssAddress:
    """Return the LSS address of the only node without a node-ID.

    Raises:
        ConfigError: There is no such node, or more than one.
    """
    found, more = find_unconfigured(connection)
    if len(found) != 1 or more:
        serials = ", ".join(str(address.serial_number) for address in found)
        if not found:
            needed = "a serial number, because the search for nodes without a node-ID found none"
            raise ConfigError("--serial", None, needed)
        there = f"{len(found)}{' and more' if more else ''} nodes have no node-ID (serials {serials})"
        raise ConfigError("--serial", None, f"a serial number, because {there}")
    return found[0]


@dataclass(frozen=True, slots=True)
class Commissioning:
    """Node settings to be changed by LSS."""

    node_id: int | None
    """New node-ID; None to keep the current one."""
    bitrate_bps: int | None
    """New bit rate, in bit/s; None to keep the current one."""
    store: bool
    """Whether to store the settings in non-volatile memory."""


def commission(
    connection: BusConnection,
    address: LssAddress,
    wanted: Commissioning,
    agreed: Callable[[int | None], bool],
) -> Commissioned | None:
    """Set the node-ID and the bit rate of a node by LSS.

    Args:
        connection: The bus.
        address: LSS address of the node.
        wanted: New settings.
        agreed: Callback that is given the current node-ID and returns whether to proceed.

    Returns:
        The result; None if ``agreed`` returned False, in which case the node keeps its settings.

    Raises:
        ConfigError: The new node-ID is in use, or no node has the LSS address.
        LssFailed: The node refuses a setting or does not respond.
    """
    node_id = wanted.node_id
    if node_id is not None and connection.ask_all(node_id, _ASK_DEVICE_TYPE, _ASKED_S):
        raise ConfigError("--node-id", node_id, "a node-ID that no other node has")
    if not connection.lss.select(address):
        raise ConfigError("--serial", address.serial_number, "the serial number of a node on this bus")
    boot_ups = 0 if node_id is None else connection.listener.node(node_id).boot_ups
    try:
        before = connection.lss.node_id()
        if not agreed(before):
            return None
        fault = _configure(connection, wanted)
    finally:  # a node without a node-ID boots when it leaves LSS configuration mode
        connection.lss.release()
    faults = [fault] if fault else []
    booted = True
    if node_id is not None and node_id != before:
        if before is not None:
            clock.sleep(0.01)  # the node must first switch to LSS waiting mode
            connection.link.send(od.NMT_COB_ID, nmt.encode(nmt.NmtCommand.RESET_COMMUNICATION, before))
        booted = connection.wait_until(lambda: connection.listener.node(node_id).boot_ups > boot_ups, BOOT_S)
        if not booted:
            faults.append(f"no boot-up message from node {node_id} within {BOOT_S:g} s")
    stored = wanted.store and not fault
    return Commissioned(address, before, node_id, wanted.bitrate_bps, stored, booted, tuple(faults))


def _configure(connection: BusConnection, wanted: Commissioning) -> str:
    """Change the settings of the selected node; return the reason they were not stored, or ""."""
    if wanted.bitrate_bps is not None:
        connection.lss.set_bit_rate(wanted.bitrate_bps)
    if wanted.node_id is not None:
        connection.lss.set_node_id(wanted.node_id)
    if wanted.store:
        try:
            connection.lss.store()
        except LssFailed as error:
            return f"the settings were not stored and will be lost at power-off: {error}"
    return ""
