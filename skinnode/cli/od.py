"""``skinnode od NODE [INDEX[:SUB]]``: reads, writes, dumps and compares a node's object dictionary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import Bitrate, Bus, Channel, Fd, Hand, Interface, Json, Node
from skinnode.text.words import counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from skinnode.cli._bus import Place
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
        str | None,
        typer.Option(
            help="Write this value with the data type in the EDS, and read it back.", metavar="VALUE"
        ),
    ] = None,
    as_hex: Annotated[
        bool, typer.Option("--hex", help="Print and accept values as raw bytes in hexadecimal.")
    ] = False,
    eds: Annotated[
        Path | None,
        typer.Option(
            help="EDS with names and types; not needed for a patch of this project.", metavar="FILE"
        ),
    ] = None,
    dcf: Annotated[
        Path | None, typer.Option(help="Write all configurable values to a DCF.", metavar="FILE")
    ] = None,
    diff: Annotated[
        Path | None, typer.Option(help="Print the differences from this EDS or DCF.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Read or write objects of a node. Indices are hexadecimal, with or without 0x.

    Without INDEX, the command dumps the whole dictionary. The exit status is 0 on success, 1 if --diff found
    differences, and 2 if the node did not answer or refused the request.
    """
    from skinnode.cli._bus import find_node
    from skinnode.cli._console import print_json, progress
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.data_sheet import data_sheet_of
    from skinnode.diagnose.object_dictionary import parse_address
    from skinnode.files.output_file import require_writable

    place, node_id = find_node(node, interface, channel, bitrate, fd, hand, bus)
    where = None if address is None else parse_address(address)
    _require_combination(where, write, dcf, diff)
    if diff is not None:
        _diff(place, node_id, diff, as_json)
        return
    if dcf is not None:
        require_writable("--dcf", dcf)
    with progress(as_json) as tell, BusConnection(place.bus) as connection:
        remote = connection.od(node_id)
        connection.require_answer(node_id)
        sheet = data_sheet_of(remote, eds) if dcf is not None else _sheet_if_any(remote, eds)
        _note(sheet)
        if where is None:
            readings = _dump(remote, sheet, tell)
        else:
            readings = _access(remote, sheet, where, write, as_hex, node_id)
    if dcf is not None:
        _write_dcf(dcf, readings, sheet, node_id, place.bus.bitrate_bps, place.patch_name(node_id))
    elif as_json:
        print_json([_as_json(reading) for reading in readings])
    else:
        _print(readings, as_hex, single=where is not None)
        if where is None and not sheet.eds.entries and not sheet.note:
            typer.echo(
                f"note: node {node_id} is not a skinnode patch; to name all its objects, add --eds FILE"
            )


def _require_combination(
    where: tuple[int, int | None] | None, write: str | None, dcf: Path | None, diff: Path | None
) -> None:
    """Raise ConfigError if the options conflict."""
    from skinnode.errors import ConfigError

    if write is not None and where is None:
        raise ConfigError("--write", write, "only with INDEX[:SUB]")
    if diff is not None and (where is not None or write is not None or dcf is not None):
        raise ConfigError(
            "--diff", str(diff), "without INDEX, --write and --dcf, because it compares the whole dictionary"
        )
    if dcf is not None and where is not None:
        raise ConfigError("--dcf", str(dcf), "only without INDEX, because it covers the whole dictionary")


def _diff(place: Place, node_id: int, file: Path, as_json: bool) -> None:
    """Compare the whole dictionary with ``file``; exit with status 1 if values differ."""
    from skinnode.cli._console import progress
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.data_sheet import load_data_sheet
    from skinnode.diagnose.dcf import expected
    from skinnode.diagnose.object_dictionary import compare

    sheet = load_data_sheet(file)
    _note(sheet)
    wanted = expected(sheet)
    with progress(as_json) as tell, BusConnection(place.bus) as connection:
        connection.require_answer(node_id)
        found = compare(connection.od(node_id), wanted, node_id, tell)
    _print_differences(found, as_json)
    if found:
        raise typer.Exit(1)


def _dump(remote: RemoteOd, sheet: DataSheet, tell: Callable[[str], None]) -> list[Reading]:
    """Read the whole dictionary: the objects in the EDS or, without an EDS, the CiA 301 objects."""
    from skinnode.diagnose.object_dictionary import dump, dump_standard

    return list(dump(remote, sheet.eds, tell) if sheet.eds.entries else dump_standard(remote, tell))


def _access(
    remote: RemoteOd,
    sheet: DataSheet,
    where: tuple[int, int | None],
    write: str | None,
    as_hex: bool,
    node_id: int,
) -> list[Reading]:
    """Write an object if ``write`` is given, then read the object."""
    from skinnode.diagnose.object_dictionary import entries_at

    entries = entries_at(sheet.eds, *where, lambda: int(remote.read(where[0], 0, "u8")))
    if write is not None:
        _write(remote, entries, write, as_hex, node_id)
    return _read(remote, entries)


def _note(sheet: DataSheet) -> None:
    if sheet.note:
        typer.echo(f"note: {sheet.note}", err=True)


def _sheet_if_any(remote: RemoteOd, eds: Path | None) -> DataSheet:
    """Return the EDS of the node.

    The EDS is empty if no EDS file is given for a third-party device, or if the node refuses to identify
    itself. Objects then have only their CiA 301 names.
    """
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
        why = f"{error}: objects have only their CiA 301 names"
    return DataSheet(Eds("", {}, frozenset(), {}, ()), "", note=why)


def _read(remote: RemoteOd, entries: list[EdsEntry]) -> list[Reading]:
    """Read the objects.

    A refused read raises SdoAbort if only one object is read; otherwise, it is listed among the results.
    """
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
            f"note: CiA 306 cannot express {where}; the bytes are in a comment, which other tools skip"
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


def _print_differences(found: list[Difference], as_json: bool) -> None:
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
