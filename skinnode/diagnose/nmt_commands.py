"""Sends NMT commands (CiA 301, 7.2.8) and observes their effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import AFTER_COMMAND, ALL_NODES, NmtCommand, encode, state_name
from skinnode.diagnose.bus_connection import BusConnection, State
from skinnode.process import clock

FOLLOW_S: Final = 1.5
"""Maximum time for a node to report its new state, in s, in addition to two heartbeat periods."""

BOOT_S: Final = 5.0
"""Maximum boot time of a node, in s."""

_GUARD_EACH_S: Final = 0.1


class Command(StrEnum):
    """An NMT command."""

    START = "start"
    STOP = "stop"
    PRE_OPERATIONAL = "pre-operational"
    RESET_NODE = "reset-node"
    RESET_COMMUNICATION = "reset-communication"

    @property
    def resets(self) -> bool:
        """Whether the command resets the node."""
        return self in (Command.RESET_NODE, Command.RESET_COMMUNICATION)


_SPECIFIERS: Final = {
    Command.START: NmtCommand.START,
    Command.STOP: NmtCommand.STOP,
    Command.PRE_OPERATIONAL: NmtCommand.ENTER_PRE_OPERATIONAL,
    Command.RESET_NODE: NmtCommand.RESET_NODE,
    Command.RESET_COMMUNICATION: NmtCommand.RESET_COMMUNICATION,
}


@dataclass(frozen=True, slots=True)
class Change:
    """Effect of an NMT command on one node."""

    node_id: int
    before: str
    after: str
    followed: bool
    known_by: str
    """How the new state was determined; if the command failed, the reason."""


@dataclass(frozen=True, slots=True)
class _Watch:
    """State and settings of a node before an NMT command."""

    node_id: int
    heartbeat_s: float | None
    guarding: bool
    before: State
    boot_ups: int


def command_nodes(
    connection: BusConnection, node_ids: Sequence[int], command: Command, *, at_once: bool
) -> list[Change]:
    """Send an NMT command to nodes, and wait for its effect.

    Args:
        connection: The bus.
        node_ids: The nodes.
        command: The command.
        at_once: Whether to address all nodes on the bus with one message instead of one message per node.

    Raises:
        BusError: The bus failed.
    """
    watches = [_watch(connection, node_id) for node_id in node_ids]
    sent_ns = clock.monotonic_ns()
    for node_id in [ALL_NODES] if at_once else node_ids:
        connection.link.send(od.NMT_COB_ID, encode(_SPECIFIERS[command], node_id))
    if command.resets:
        return [_booted(connection, watch, sent_ns) for watch in watches]
    return [_followed(connection, watch, command, sent_ns) for watch in watches]


def _watch(connection: BusConnection, node_id: int) -> _Watch:
    """Determine a node's state and settings before the command; stopped nodes do not answer SDO requests."""
    heartbeat_s = connection.heartbeat_s(node_id)
    guarding = not connection.guarded(node_id)
    before = connection.state(node_id, heartbeat_s, guarding=guarding)
    return _Watch(node_id, heartbeat_s, guarding, before, connection.listener.node(node_id).boot_ups)


def _followed(connection: BusConnection, watch: _Watch, command: Command, sent_ns: int) -> Change:
    """Wait until the node reports the commanded state or the time limit expires."""
    wanted, since_ns = AFTER_COMMAND[_SPECIFIERS[command]], sent_ns
    end_s = clock.monotonic() + FOLLOW_S + 2 * (watch.heartbeat_s or 0.0)
    while True:
        now = connection.state(watch.node_id, watch.heartbeat_s, guarding=watch.guarding, since_ns=since_ns)
        if now.state == wanted:
            return Change(watch.node_id, str(watch.before), str(now), True, now.how)
        if clock.monotonic() > end_s:
            why = now.how if now.state is None else f"by {now.how}, not {state_name(wanted)}"
            return Change(watch.node_id, str(watch.before), str(now), False, why)
        since_ns = clock.monotonic_ns()
        connection.wait_until(lambda: False, _GUARD_EACH_S)


def _booted(connection: BusConnection, watch: _Watch, sent_ns: int) -> Change:
    """Wait for the node's boot-up message, and determine its NMT state."""
    node_id = watch.node_id
    if not connection.wait_until(lambda: connection.listener.node(node_id).boot_ups > watch.boot_ups, BOOT_S):
        why = f"no boot-up message within {BOOT_S:g} s"
        now = connection.listener.newest_beat(node_id, sent_ns)
        after = "silent" if now is None else state_name(now.state)
        return Change(node_id, str(watch.before), after, False, why)
    booted_ns = clock.monotonic_ns()
    heartbeat_s = connection.heartbeat_s(node_id)  # the reset may have changed the heartbeat period
    guarding = not connection.guarded(node_id)
    now_in = connection.state(node_id, heartbeat_s, guarding=guarding, since_ns=booted_ns)
    how = "boot-up message" + (f", {now_in.how}" if now_in.state is not None else "")
    return Change(node_id, str(watch.before), str(now_in), True, how)
