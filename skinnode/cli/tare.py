"""``skinnode tare [PATCH…]``: sets the baselines of patches to their current resistances."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import Bitrate, Bus, Channel, Fd, Hand, Interface, Json, nodes

if TYPE_CHECKING:
    from collections.abc import Callable

    from skinnode.cli._bus import Place
    from skinnode.diagnose.tare import Tared


def tare(
    patches: Annotated[
        list[str] | None,
        typer.Argument(
            help="Names of patches in the --hand file, or node-IDs; default: all patches of the hand.",
            metavar="[PATCH]...",
            autocompletion=nodes,
            show_default=False,
        ),
    ] = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    hand: Hand = None,
    bus: Bus = None,
    as_json: Json = False,
) -> None:
    """Set the baselines R0 of patches to their current resistances.

    Do not touch the skin while the command runs.

    Taring uses SDO and works with or without a host on the bus; a running host reads the new baselines
    and continues. A baseline is lost at power-off unless it is stored (0x1010). The command refuses to tare a
    patch whose baseline is a file named in hand.toml. The exit status is 0 if every patch was tared, 1 if any
    was not, and 2 if the command could not run.
    """
    from skinnode.cli._bus import find_buses, node_among
    from skinnode.cli._console import print_json, progress
    from skinnode.errors import NOTHING, ConfigError

    places = find_buses(interface, channel, bitrate, fd, hand, bus)
    if patches:
        found = [node_among(patch, places, "PATCH") for patch in patches]
    elif hand is not None:
        found = [(place, patch.node_id) for place in places for patch in place.patches]
    else:
        raise ConfigError("PATCH", NOTHING, "names of patches or node-IDs, or --hand for a whole hand")
    wanted = list(dict.fromkeys((place.bus.name, node_id) for place, node_id in found))
    with progress(as_json) as tell:
        done = [
            result
            for place in places
            for result in _tare_on(
                place, [node_id for name, node_id in wanted if name == place.bus.name], tell
            )
        ]
    if as_json:
        from dataclasses import asdict

        print_json(
            [{**asdict(result), "problem": result.problem or None, "tared": result.done} for result in done]
        )
    else:
        _print(done)
    if not all(result.done for result in done):
        raise typer.Exit(1)


def _tare_on(place: Place, node_ids: list[int], tell: Callable[[str], None]) -> list[Tared]:
    """Tare the nodes on one bus. The bus is opened only if at least one of the nodes can be tared."""
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.tare import Tared, refusal, tare

    named = {patch.node_id: patch for patch in place.patches}
    refused = {
        node_id: why
        for node_id in node_ids
        if node_id in named and (why := refusal(named[node_id], place.bus))
    }
    done = {
        node_id: Tared(place.patch_name(node_id), node_id, place.bus.name, why)
        for node_id, why in refused.items()
    }
    if len(refused) < len(node_ids):
        with BusConnection(place.bus) as connection:
            for node_id in node_ids:
                if node_id not in refused:
                    period_s = 0.0 if place.hand is None else place.hand.sync.period_s
                    done[node_id] = tare(
                        connection,
                        node_id,
                        place.patch_name(node_id),
                        sync_period_s=period_s,
                        progress=tell,
                    )
    return [done[node_id] for node_id in node_ids]


def _print(done: list[Tared]) -> None:
    from skinnode.cli._console import console, table

    listed = table("patch", "node", "bus", "result", right=("node",))
    for item in done:
        listed.add_row(item.patch, str(item.node_id), item.bus, _result(item))
    console().print(listed)


def _result(item: Tared) -> str:
    if not item.done:
        return f"NOT TARED: {item.problem}"
    from skinnode.model.baseline_change import TOUCHED

    change = "" if item.median_change is None else f", median change {100 * item.median_change:+.3f} %"
    text = f"tared: {item.crossings} crossings, median R0 {item.median_ohm:.4g} ohm{change}"
    if item.touched_crossings:
        text += f"; warning: {item.touched_crossings} crossings changed by up to "
        text += f"{100 * item.touched_change:.2g} %, {TOUCHED}"
    return text
