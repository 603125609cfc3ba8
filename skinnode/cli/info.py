"""``skinnode info NODE``: shows all information about a node on one screen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import Bitrate, Bus, Channel, Fd, Hand, Interface, Json, Node

if TYPE_CHECKING:
    from skinnode.diagnose.node_info import NodeInfo, PatchInfo


def info(
    node: Node,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    hand: Hand = None,
    bus: Bus = None,
    eds: Annotated[
        Path | None, typer.Option(help="EDS of a device other than a patch.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Print the identity, layout, baseline, errors, PDOs, wires and configuration of one node.

    The command only reads. The exit status is 0 if the node reports no fault, and 1 if the node has an error,
    faulty wires or no baseline. The exit status is 2 if the node does not answer.
    """
    from skinnode.cli._bus import find_node
    from skinnode.cli._console import print_json, progress
    from skinnode.diagnose.bus_connection import BusConnection
    from skinnode.diagnose.data_sheet import load_data_sheet
    from skinnode.diagnose.node_info import read_info

    place, node_id = find_node(node, interface, channel, bitrate, fd, hand, bus)
    sheet = None
    if eds is not None:
        sheet, *_, note = load_data_sheet(eds)
        if note:
            typer.echo(f"note: {note}", err=True)
    with progress(as_json) as tell, BusConnection(place.bus) as connection:
        tell(f"reading node {node_id}")
        found = read_info(connection, node_id, sheet)
    if as_json:
        from dataclasses import asdict

        print_json({**asdict(found), "patch_name": place.patch_name(node_id) or None, "faults": found.faults})
    else:
        _print(found, place.patch_name(node_id))
    if found.faults:
        raise typer.Exit(1)


def _print(found: NodeInfo, patch_name: str) -> None:
    from skinnode.canopen.emergency import register_text
    from skinnode.cli._console import console, table

    out = console()
    title = f"node {found.node_id}" + (f" ({patch_name})" if patch_name else "")
    out.print(title, style="bold", end="")
    out.print(f"  {found.state} (by {found.state_known_by})")
    grid = table("", "")
    grid.show_header = False
    register = found.error_register or 0
    rows = [
        ("device", f"{found.name or 'unnamed'}, type 0x{found.device_type or 0:X}"),
        ("identity", _identity(found)),
        ("versions", f"hardware {found.hardware_version or '?'}, software {found.software_version or '?'}"),
        *(_patch_rows(found.patch) if found.patch is not None else ()),
        ("error register", f"0x{register:02X} {register_text(register)}"),
        ("error history", "\n".join(found.errors) or "empty"),
        ("heartbeat", f"every {found.heartbeat_ms} ms" if found.heartbeat_ms else "none"),
        ("watches", ", ".join(found.heartbeats_watched) or "no heartbeats"),
        ("guarded", found.guarding),
        ("if alone", f"goes {found.on_communication_error} (0x1029)"),
        ("SYNC", found.sync),
        ("PDOs", _pdos(found)),
        ("storing", found.storing),
    ]
    for name, value in rows:
        grid.add_row(name, value)
    out.print(grid)
    for fault in found.faults:
        out.print(f"fault: {fault}")


def _identity(found: NodeInfo) -> str:
    from skinnode.text.words import known

    vendor, product, revision = (
        value or 0 for value in (found.vendor_id, found.product_code, found.revision)
    )
    return (
        f"vendor {vendor:08X}, product {product:08X}, revision {revision >> 16}.{revision & 0xFFFF}, "
        f"serial {known(found.serial)}"
    )


def _pdos(found: NodeInfo) -> str:
    off = [f"{pdo.direction}{pdo.number}" for pdo in found.pdos if not pdo.enabled]
    on = [text for pdo, text in zip(found.pdos, found.pdo_texts, strict=True) if pdo.enabled]
    return "\n".join([*on, f"off: {', '.join(off)}"] if off else on) or "none"


def _patch_rows(patch: PatchInfo) -> list[tuple[str, str]]:
    mode = "all chunks"
    if patch.send_changed_only:
        refresh = (
            f"all chunks every {patch.send_refresh_scans} scans"
            if patch.send_refresh_scans
            else "never all chunks"
        )
        mode = f"chunks that changed by more than {patch.send_threshold_codes} codes, {refresh}"
    when = f"every {patch.period_ms} ms on its own timer" if patch.period_ms else "on SYNC"
    averaged = f", mean of {patch.averaging}" if patch.averaging > 1 else ""
    wires = [
        f"{name} {', '.join(map(str, faulty))}"
        for name, faulty in (
            ("upper open", patch.open_upper),
            ("upper shorted", patch.shorted_upper),
            ("lower open", patch.open_lower),
            ("lower shorted", patch.shorted_lower),
        )
        if faulty
    ]
    return [
        (
            "layout",
            f"{patch.upper_wires} upper × {patch.lower_wires} lower wires of {patch.upper_electrodes} and "
            f"{patch.lower_electrodes} electrodes; {patch.layout}, hash 0x{patch.layout_hash:08X}, "
            f"{patch.resistivity_ohm_per_m:.3g} ohm/m",
        ),
        (
            "codes",
            f"{patch.code_bits} bits, R/R0 from {patch.code_lo:g} to {patch.code_hi:g}, "
            f"PDOs of up to {patch.pdo_bytes} bytes",
        ),
        ("baseline", _baseline(patch)),
        ("scans", f"{when}{averaged}; sends {mode}"),
        ("wires", "; ".join(wires) or "none open, none shorted"),
        ("self-test", patch.self_test),
        (
            "rejected frames",
            ", ".join(f"{name}: {count}" for name, count in patch.rejected.items()) or "none",
        ),
    ]


def _baseline(patch: PatchInfo) -> str:
    if patch.baseline_ohm is None:
        return "none: skinnode tare"
    least, median, greatest = patch.baseline_ohm
    missing = f"; {patch.baseline_missing} crossings without R0" if patch.baseline_missing else ""
    return f"{least:.4g} to {greatest:.4g} ohm, median {median:.4g}{missing}"
