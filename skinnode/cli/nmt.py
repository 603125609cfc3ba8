"""``skinnode nmt NODE|all COMMAND``: sends NMT commands to nodes and checks their new states."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import Bitrate, Bus, Channel, Fd, Hand, Interface, Json, nodes

if TYPE_CHECKING:
    from skinnode.cli._bus import Place
    from skinnode.diagnose.nmt_commands import Change

_COMMANDS = "start stop pre-operational reset-node reset-communication"


def _nodes_or_all(ctx: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    every_node = [("all", "every node on the bus")] if "all".startswith(incomplete) else []
    return nodes(ctx, incomplete) + every_node


def nmt(
    node: Annotated[
        str,
        typer.Argument(
            help="Node-ID, patch in the --hand file, or all.",
            metavar="NODE|all",
            autocompletion=_nodes_or_all,
        ),
    ],
    command: Annotated[
        str, typer.Argument(help=_COMMANDS.replace(" ", ", "), metavar="COMMAND", show_default=False)
    ],
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    hand: Hand = None,
    bus: Bus = None,
    as_json: Json = False,
) -> None:
    """Start, stop or reset nodes, and print their states before and after the command.

    `all` means every node on the bus or, with --hand, on every bus of the hand.

    The exit status is 0 if every node entered the commanded state, 1 if any did not, and 2 if the command
    could not run.
    """
    from skinnode.cli._bus import find_buses, find_node
    from skinnode.cli._console import console, print_json, progress, table
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.discovery import discover
    from skinnode.diagnose.nmt_commands import Command, command_nodes
    from skinnode.errors import BusError, ConfigError

    if command not in _COMMANDS.split():
        raise ConfigError("COMMAND", command, _COMMANDS.replace(" ", ", "))
    if node == "all":
        wanted = [(place, list[int]()) for place in find_buses(interface, channel, bitrate, fd, hand, bus)]
    else:
        place, node_id = find_node(node, interface, channel, bitrate, fd, hand, bus)
        wanted = [(place, [node_id])]
    changes: list[tuple[Place, Change]] = []
    with progress(as_json) as tell:
        for place, node_ids in wanted:
            with BusConnection(place.bus) as connection:
                if node == "all":
                    node_ids = [found.node_id for found in discover(connection, tell).nodes]
                tell(f"{place.bus.name}: {command}")
                done = (
                    command_nodes(connection, node_ids, Command(command), at_once=node == "all")
                    if node_ids
                    else []
                )
            changes += [(place, change) for change in done]
    if not changes:
        where = " and ".join(place.bus.name for place, _ in wanted)
        raise BusError(f"{where}: no node answered, so the command {command} was not sent")
    if as_json:
        print_json([{**asdict(change), "bus": place.bus.name} for place, change in changes])
    else:
        several = len(wanted) > 1
        listed = table(*(["bus"] if several else []), "node", "before", "after", "known by", right=("node",))
        for place, change in changes:
            known = change.known_by if change.followed else f"DID NOT FOLLOW: {change.known_by}"
            row = [str(change.node_id), change.before, change.after, known]
            listed.add_row(*([place.bus.name] if several else []), *row)
        console().print(listed)
    if not all(change.followed for _, change in changes):
        raise typer.Exit(1)
