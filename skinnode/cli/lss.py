"""``skinnode lss``: sets the node-ID and bit rate of nodes by serial number, over the bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._help import App
from skinnode.cli._options import Bitrate, Bus, Channel, Fd, Hand, Interface, Json, node_ids

if TYPE_CHECKING:
    from skinnode.canopen.lss import LssAddress
    from skinnode.cli._bus import Place
    from skinnode.diagnose.lss_commissioning import Commissioned

app = App(help="Layer setting services: set the node-ID and bit rate of nodes.", no_args_is_help=True)


@app.command(name="list")
def list_nodes(
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    hand: Hand = None,
    bus: Bus = None,
    as_json: Json = False,
) -> None:
    """Find nodes without a node-ID by LSS fastscan, on one bus or every bus of the hand.

    No node is changed.
    """
    from skinnode.cli._bus import find_buses
    from skinnode.cli._console import console, print_json, progress, table
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.discovery import find_unconfigured
    from skinnode.text.words import counted

    found: list[tuple[str, LssAddress]] = []
    more = False
    places = find_buses(interface, channel, bitrate, fd, hand, bus)
    with progress(as_json) as tell:
        for place in places:
            tell(f"{place.bus.name}: fastscan")
            with BusConnection(place.bus) as connection:
                there, and_more = find_unconfigured(connection)
            found += [(place.bus.name, address) for address in there]
            more |= and_more
    if as_json:
        addresses = [{**address._asdict(), "bus": name} for name, address in found]
        print_json({"unconfigured": addresses, "more": more})
        return
    if found:
        head = ["bus"] if len(places) > 1 else []
        listed = table(*head, "serial", "vendor", "product", "revision", right=("serial",))
        for name, item in found:
            revision = f"{item.revision_number >> 16}.{item.revision_number & 0xFFFF}"
            row = [str(item.serial_number), f"{item.vendor_id:08X}", f"{item.product_code:08X}", revision]
            listed.add_row(*([name] if head else []), *row)
        console().print(listed)
    typer.echo(f"{counted(len(found), 'node')} without a node-ID" + (", and more" if more else ""))


@app.command(name="set")
def set_node(
    serial: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=0xFFFF_FFFF,
            help="Serial number of the node; default: the only node without a node-ID.",
        ),
    ] = None,
    node_id: Annotated[
        int | None,
        typer.Option(min=1, max=127, help="New node-ID.", metavar="N", autocompletion=node_ids),
    ] = None,
    bit_rate: Annotated[
        int | None, typer.Option(help="New bit rate, used from the next power-on.", metavar="BPS")
    ] = None,
    store: Annotated[bool, typer.Option(help="Store both settings, so that they survive power-off.")] = True,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
    vendor: Annotated[
        int | None, typer.Option(help="Vendor-ID of a device other than a patch.", metavar="N")
    ] = None,
    product: Annotated[
        int | None, typer.Option(help="Product code of a device other than a patch.", metavar="N")
    ] = None,
    revision: Annotated[
        int | None, typer.Option(help="Revision number of a device other than a patch.", metavar="N")
    ] = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    hand: Hand = None,
    bus: Bus = None,
    as_json: Json = False,
) -> None:
    """Set and store the node-ID of one node, its bit rate, or both.

    A node that already has a node-ID is reset, so that the new node-ID takes effect. The exit status is 0 on
    success, 1 if the node did not store its settings or did not boot, 2 if the command could not run.
    """
    from skinnode.canopen import indices as od
    from skinnode.canopen.lss import BIT_RATES_BPS, LssAddress
    from skinnode.cli._bus import find_buses
    from skinnode.cli._console import print_json, progress
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.lss_commissioning import Commissioning, commission, only_unconfigured
    from skinnode.errors import ConfigError, Shown

    if node_id is None and bit_rate is None:
        raise ConfigError("--node-id, --bit-rate", None, "at least one of the two options")
    if bit_rate is not None and bit_rate not in BIT_RATES_BPS.values():
        allowed = ", ".join(str(rate) for rate in BIT_RATES_BPS.values())
        raise ConfigError("--bit-rate", bit_rate, allowed)
    place = _bus_of(find_buses(interface, channel, bitrate, fd, hand, bus), serial, node_id)
    with BusConnection(place.bus) as connection:
        if serial is None:
            with progress(as_json) as tell:
                tell("fastscan")
                address = only_unconfigured(connection)
        else:
            named = LssAddress(
                od.VENDOR_ID if vendor is None else vendor,
                od.PRODUCT_CODE if product is None else product,
                od.REVISION_NUMBER if revision is None else revision,
                serial,
            )
            ours = vendor is None and product is None and revision is None
            address = connection.lss.select_patch(serial) or named if ours else named

        def agreed(before: int | None) -> bool:
            return yes or _confirmed(address.serial_number, before, node_id, bit_rate, store)

        done = commission(connection, address, Commissioning(node_id, bit_rate, store), agreed)
    if done is None:
        raise ConfigError("--yes", Shown("no"), "yes at the prompt; nothing was changed")
    if as_json:
        from dataclasses import asdict

        print_json({**asdict(done), "address": done.address._asdict()})
    else:
        _print(done)
    if done.faults:
        raise typer.Exit(1)


def _bus_of(places: list[Place], serial: int | None, node_id: int | None) -> Place:
    """Return the bus of the patch with the serial number or, failing that, with the node-ID."""
    from skinnode.errors import NOTHING, ConfigError

    for number, key in ((serial, "serial"), (node_id, "node_id")):
        if number is not None and len(places) > 1:
            fitting = [
                place for place in places if any(getattr(patch, key) == number for patch in place.patches)
            ]
            places = fitting or places
    if len(places) > 1:
        raise ConfigError("--bus", NOTHING, f"one of {', '.join(place.bus.name for place in places)}")
    return places[0]


def _confirmed(
    serial: int, before: int | None, node_id: int | None, bit_rate: int | None, store: bool
) -> bool:
    changes = []
    if node_id is not None:
        changes.append(f"node-ID {before or 'none'} → {node_id}")
    if bit_rate is not None:
        changes.append(f"bit rate → {bit_rate} from the next power-on")
    changes.append("stored" if store else "not stored")
    return bool(typer.confirm(f"serial {serial}: {', '.join(changes)}. Proceed?", err=True))


def _print(done: Commissioned) -> None:
    what = []
    if done.node_id is not None:
        what.append(f"node-ID {done.node_id_before or 'none'} → {done.node_id}")
    if done.bitrate_bps is not None:
        what.append(f"bit rate {done.bitrate_bps} from the next power-on")
    what.append("stored" if done.stored else "not stored")
    typer.echo(f"serial {done.address.serial_number}: {', '.join(what)}")
    for fault in done.faults:
        typer.echo(f"fault: {fault}")
