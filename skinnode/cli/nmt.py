"""``skinnode nmt NODE|all COMMAND``: change the NMT state of nodes, and see whether they follow."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from skinnode.cli._bus import Bitrate, Bus, Channel, Fd, Hand, Interface, Json, nodes

_COMMANDS = "start stop pre-operational reset-node reset-communication"


def _nodes_or_all(ctx: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    everybody = [("all", "every node of the bus")] if "all".startswith(incomplete) else []
    return nodes(ctx, incomplete) + everybody


def nmt(
    node: Annotated[
        str,
        typer.Argument(
            help="Node-ID, patch of --hand, or all.", metavar="NODE|all", autocompletion=_nodes_or_all
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
    """Start, stop or reset nodes; tell their state before and after, from heartbeat or guarding.

    Exit status 0 if every node followed, 1 if one did not, 2 if it could not run.
    """
    from skinnode.cli._bus import find_bus, find_node
    from skinnode.cli._console import console, print_json, progress, table
    from skinnode.errors import BusError, ConfigError
    from skinnode.technician.line import Line
    from skinnode.technician.nmt import Command, command_nodes
    from skinnode.technician.survey import survey

    if command not in _COMMANDS.split():
        raise ConfigError("COMMAND", command, _COMMANDS.replace(" ", ", "))
    place = find_bus(interface, channel, bitrate, fd, hand, bus)
    node_ids = [] if node == "all" else [find_node(node, place)]
    with progress(as_json) as tell, Line(place.bus) as line:
        if node == "all":
            node_ids = [found.node_id for found in survey(line, tell).nodes]
            if not node_ids:
                raise BusError(f"{place.bus.name}: got no answer from any node, allowed: one at least")
        tell(command)
        changes = command_nodes(line, node_ids, Command(command), at_once=node == "all")
    if as_json:
        print_json([asdict(change) for change in changes])
    else:
        listed = table("node", "before", "after", "known by", right=("node",))
        for change in changes:
            known = change.known_by if change.followed else f"DID NOT FOLLOW: {change.known_by}"
            listed.add_row(str(change.node_id), change.before, change.after, known)
        console().print(listed)
    if not all(change.followed for change in changes):
        raise typer.Exit(1)
