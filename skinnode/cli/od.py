"""``skinnode od NODE [INDEX[:SUB]]``: the object dictionary of a node, read, written, dumped and compared."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._bus import Bitrate, Bus, Channel, Fd, Hand, Interface, Json, Node
from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.conformance.eds_reader import EdsEntry
    from skinnode.diagnose.data_sheet import DataSheet
    from skinnode.diagnose.object_dictionary import Difference, Reading
    from skinnode.host.sdo_client import RemoteOd


def od(
    node: Node,
    address: Annotated[
        str | None,
        typer.Argument(help="0x1018 or 0x1018:4; default: the whole dictionary.", metavar="INDEX[:SUB]"),
    ] = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    hand: Hand = None,
    bus: Bus = None,
    write: Annotated[
        str | None, typer.Option(help="Write this, typed as the EDS says, and read it back.", metavar="VALUE")
    ] = None,
    as_hex: Annotated[
        bool, typer.Option("--hex", help="Show and take values as raw bytes in hexadecimal.")
    ] = False,
    eds: Annotated[
        Path | None, typer.Option(help="Names and types; not needed for a patch of ours.", metavar="FILE")
    ] = None,
    dcf: Annotated[
        Path | None, typer.Option(help="Write all that can be configured as a DCF.", metavar="FILE")
    ] = None,
    diff: Annotated[
        Path | None, typer.Option(help="Show what differs from this EDS or DCF.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Read or write objects of a node. Indices are hexadecimal, with or without 0x.

    Without INDEX it dumps the whole dictionary. Exit status 0 if done, 1 if
    --diff found differences, 2 if the node did not answer or refused.
    """
    from skinnode.cli._bus import find_node
    from skinnode.cli._console import print_json, progress
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.data_sheet import data_sheet_of, load_data_sheet
    from skinnode.diagnose.dcf import expected
    from skinnode.diagnose.object_dictionary import (
        compare,
        dump,
        dump_standard,
        entries_at,
        parse_address,
    )
    from skinnode.errors import ConfigError
    from skinnode.files.output_file import require_writable

    place, node_id = find_node(node, interface, channel, bitrate, fd, hand, bus)
    where = None if address is None else parse_address(address)
    if write is not None and where is None:
        raise ConfigError("--write", write, "only with INDEX[:SUB]")
    if diff is not None and (where is not None or write is not None or dcf is not None):
        raise ConfigError("--diff", str(diff), "only by itself, because it compares the whole dictionary")
    if dcf is not None and where is not None:
        raise ConfigError("--dcf", str(dcf), "only without INDEX, because it takes the whole dictionary")
    if dcf is not None:
        require_writable("--dcf", dcf)
    wanted = None
    if diff is not None:
        compared = load_data_sheet(diff)
        _note(compared)
        wanted = expected(compared)
    with progress(as_json) as tell, BusConnection(place.bus) as line:
        remote = line.od(node_id)
        line.require_answer(node_id)
        if wanted is not None:
            found = compare(remote, wanted, node_id, tell)
        else:
            sheet = data_sheet_of(remote, eds) if dcf is not None else _sheet_if_any(remote, eds)
            _note(sheet)
            if where is None:
                bare = not sheet.eds.entries
                readings = list(dump_standard(remote, tell) if bare else dump(remote, sheet.eds, tell))
            else:
                index = where[0]
                entries = entries_at(sheet.eds, *where, lambda: int(remote.read(index, 0, "u8")))
                if write is not None:
                    _write(remote, entries, write, as_hex, node_id)
                readings = _read(remote, entries)
    if wanted is not None:
        _tell_differences(found, as_json)
        if found:
            raise typer.Exit(1)
        return
    if dcf is not None:
        _write_dcf(dcf, readings, sheet, node_id, place.bus.bitrate_bps, place.patch_name(node_id))
    elif as_json:
        print_json([_as_json(reading) for reading in readings])
    else:
        _print(readings, as_hex, single=where is not None)
        if where is None and not sheet.eds.entries and not sheet.note:
            typer.echo(f"note: node {node_id} is not a skinnode patch; --eds FILE names all its objects")


def _note(sheet: DataSheet) -> None:
    if sheet.note:
        typer.echo(f"note: {sheet.note}", err=True)


def _sheet_if_any(remote: RemoteOd, eds: Path | None) -> DataSheet:
    """Return the sheet of the node. It has no entries for a third-party device without an EDS, or a node that
    refuses to say which it is: CiA 301 then names the objects."""
    from skinnode.conformance.eds_reader import Eds
    from skinnode.diagnose.data_sheet import DataSheet, data_sheet_of
    from skinnode.errors import NodeError, ProfileError

    try:
        return data_sheet_of(remote, eds)
    except ProfileError:
        if eds is not None:
            raise
        why = ""
    except NodeError as error:
        why = f"{error}: objects are named by CiA 301 alone"
    return DataSheet(Eds("", {}, frozenset(), {}, ()), "", note=why)


def _read(remote: RemoteOd, entries: list[EdsEntry]) -> list[Reading]:
    """One object alone must be there; of several the refusal of one is told beside the others."""
    from skinnode.diagnose.object_dictionary import read_entry

    if len(entries) == 1 and entries[0].access != "wo":
        remote.read_bytes(entries[0].index, entries[0].subindex)
    return [read_entry(remote, entry) for entry in entries if entry.access != "wo"]


def _write(remote: RemoteOd, entries: list[EdsEntry], text: str, as_hex: bool, node_id: int) -> None:
    from skinnode.diagnose.object_dictionary import encode
    from skinnode.errors import ConfigError

    if len(entries) != 1:
        raise ConfigError(
            "INDEX", f"0x{entries[0].index:04X}", "INDEX:SUB, because this object is an array or a record"
        )
    (entry,) = entries
    if as_hex:
        try:
            data = bytes.fromhex(text)
        except ValueError:
            raise ConfigError("--write", text, "bytes in hexadecimal, such as 'e8 03'") from None
    else:
        data = encode(entry, text, node_id)
    remote.write_bytes(entry.index, entry.subindex, data)


def _write_dcf(
    file: Path, readings: list[Reading], sheet: DataSheet, node_id: int, bitrate: int, name: str
) -> None:
    from skinnode.diagnose.dcf import as_dcf
    from skinnode.files.output_file import write_text
    from skinnode.text.words import counted

    made = as_dcf(sheet, readings, node_id, bitrate, name or f"node {node_id}")
    write_text("--dcf", file, made.text)
    refused = [reading for reading in readings if reading.refused and reading.refused != "no data"]
    typer.echo(f"{counted(made.values, 'value')} of node {node_id} in {file}")
    for reading in made.as_bytes:
        where = f"0x{reading.index:04X}:{reading.subindex}"
        typer.echo(
            f"note: CiA 306 cannot express {where}: its bytes are in a comment, which other tools skip"
        )
    for reading in refused:
        typer.echo(f"note: 0x{reading.index:04X}:{reading.subindex} {reading.refused}")


def _print(readings: list[Reading], as_hex: bool, *, single: bool) -> None:
    from skinnode.cli._console import console, table
    from skinnode.diagnose.object_dictionary import hex_text

    out = console()
    listed = table("object", "name", "type", "access", "value")
    for reading in readings:
        raw = as_hex and reading.data is not None
        whole = single and len(readings) == 1
        value = (reading.data or b"").hex(" ") if raw and whole else hex_text(reading.data or b"")
        listed.add_row(
            f"{reading.index:04X}:{reading.subindex}",
            reading.name,
            reading.data_type,
            reading.access,
            value if raw else reading.text,
        )
    out.print(listed)


def _tell_differences(found: list[Difference], as_json: bool) -> None:
    from dataclasses import asdict

    from skinnode.cli._console import console, print_json, table

    if as_json:
        print_json([asdict(difference) for difference in found])
        return
    if not found:
        typer.echo("no differences")
        return
    listed = table("object", "name", "node", "file")
    for item in found:
        listed.add_row(f"{item.index:04X}:{item.subindex}", item.name, item.node, item.file)
    console().print(listed)
    typer.echo(counted(len(found), "difference"))


def _as_json(reading: Reading) -> dict[str, object]:
    return {
        "index": reading.index,
        "subindex": reading.subindex,
        "name": reading.name,
        "type": reading.data_type,
        "access": reading.access,
        "value": reading.value,
        "hex": None if reading.data is None else reading.data.hex(),
        "refused": reading.refused or None,
    }
