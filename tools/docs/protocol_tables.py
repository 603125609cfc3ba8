"""Generates the tables of the protocol page from the modules that implement the protocol."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable
from typing import Final

import markdown_text as md
import numpy as np
from canopen.sdo.exceptions import SdoAbortedError

from skinnode.bus_load.timing import fd_worst_case_bits, worst_case_bits
from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode
from skinnode.canopen.dictionary import Entry, Object, highest
from skinnode.canopen.emergency import EmcyCode, error_text
from skinnode.node.rejected import Rejected
from skinnode.protocol.chunk import pack_scan
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.command import pack_command
from skinnode.protocol.eds_files import REFERENCE_PROFILES, eds_name
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan_check import check_of_codes
from skinnode.protocol.summary import SummaryFlag, pack_checked_summary

PROFILE: Final = REFERENCE_PROFILES[0]
NODE_ID: Final = 4
_BITRATE_BPS, _DATA_BITRATE_BPS = 1_000_000, 5_000_000
_HIGHEST: Final = highest(0, 0).name
"""Name of sub-index 0 in most objects. The tables omit this sub-index, because its value can be derived
from the other sub-indices."""
_PLUS_NODE_ID: Final = " + node\u2011ID"
_FEW: Final = 3
"""Maximum number of similar entries listed in separate rows; longer runs share one row."""


def cob_ids() -> str:
    """List the CAN identifiers of a patch, highest bus priority first."""
    rows = (
        ("NMT command", od.NMT_COB_ID, od.NMT_COB_ID, "NMT master → node", 2),
        ("SYNC", od.SYNC_COB_ID, od.SYNC_COB_ID, "producer → node", "1 (counter)"),
        ("EMCY", od.emcy_cob_id(0), od.emcy_cob_id(NODE_ID), "node →", 8),
        ("TIME", od.TIME_COB_ID, od.TIME_COB_ID, "producer → node", 6),
        ("TPDO1, chunk", od.chunk_cob_id(0), od.chunk_cob_id(NODE_ID), "node →", "8; CAN FD up to 64"),
        ("RPDO1, command", od.command_cob_id(0), od.command_cob_id(NODE_ID), "→ node", 6),
        ("TPDO2, summary", od.summary_cob_id(0), od.summary_cob_id(NODE_ID), "node →", 8),
        ("SDO response", od.sdo_response_cob_id(0), od.sdo_response_cob_id(NODE_ID), "node →", 8),
        ("SDO request", od.sdo_request_cob_id(0), od.sdo_request_cob_id(NODE_ID), "→ node", 8),
        ("heartbeat, boot-up", od.heartbeat_cob_id(0), od.heartbeat_cob_id(NODE_ID), "node →", 1),
        ("LSS response", od.LSS_RESPONSE_COB_ID, od.LSS_RESPONSE_COB_ID, "node →", 8),
        ("LSS request", od.LSS_REQUEST_COB_ID, od.LSS_REQUEST_COB_ID, "→ node", 8),
    )
    head = ("frame", "COB-ID", f"node {NODE_ID}", "direction", "bytes")
    return md.table(
        head,
        (
            (
                name,
                md.c_hex(base, 3) + (_PLUS_NODE_ID if own != base else ""),
                md.c_hex(own, 3),
                way,
                str(size),
            )
            for name, base, own, way, size in rows
        ),
    )


def formats() -> str:
    """Compare the four wire formats for the reference patch."""
    rows = []
    for profile in REFERENCE_PROFILES:
        frame_s = worst_case_bits(8) / _BITRATE_BPS
        chunk_s = frame_s
        if profile.bus == "fd":
            nominal, data = fd_worst_case_bits(profile.chunk_bytes)
            chunk_s = nominal / _BITRATE_BPS + data / _DATA_BITRATE_BPS
        scan_s = profile.n_chunks * chunk_s + frame_s
        step = CodeScale(profile.code_bits).step
        rows.append(
            (
                md.code(eds_name(profile)),
                str(profile.codes_per_chunk),
                f"{profile.n_chunks} × {profile.chunk_bytes} bytes + 1",
                f"{scan_s * 1e3:.2f}",
                f"{1 / scan_s:.0f}",
                f"{step * 1e6:.2g} ppm",
            )
        )
    head = (
        "data sheet",
        "codes per chunk",
        "frames per scan",
        "worst-case ms per scan",
        "scans/s on a full bus",
        "step",
    )
    return md.table(head, rows)


def example_scan() -> str:
    """Show the bytes of some frames from a scan of a pressed patch."""
    scale, scan = CodeScale(16), 7
    resistance = np.full((PROFILE.rows, PROFILE.columns), 1500.0)
    baseline = resistance.copy()
    resistance[0, 1] = 1380.0  # 0.92 of R0
    resistance[0, 2] = np.inf
    codes = encode(resistance, baseline, scale)
    frames = pack_scan(codes, scan, PROFILE)
    shown = (
        (od.chunk_cob_id(NODE_ID), frames[0], "chunk 0: crossings 0/0, 0/1, 0/2"),
        (od.chunk_cob_id(NODE_ID), frames[1], "chunk 1: crossings 0/3, 0/4, 0/5"),
        (od.chunk_cob_id(NODE_ID), frames[-1], "chunk 99: crossings 9/27, 9/28, 9/29"),
        (
            od.summary_cob_id(NODE_ID),
            pack_checked_summary(
                scan, SummaryFlag.WIRE_FAULT, PROFILE.n_chunks, 560_000, check_of_codes(codes, PROFILE)
            ),
            "summary: 100 chunks, a wire fault, device time 560 000 µs, scan check",
        ),
        (od.command_cob_id(NODE_ID), pack_command(tare=True), "command: tare"),
        (od.command_cob_id(NODE_ID), pack_command(single_scan=True), "command: one scan now"),
    )
    lines = [f"{cob_id:03X}  {data.hex(' ').upper():<23}  {text}" for cob_id, data, text in shown]
    values = ", ".join(f"{int(code)} (`{int(code):04X}`)" for code in codes[0, :3])
    return (
        "```text\n" + "\n".join(lines) + "\n```\n\n"
        f"Resistances of {resistance[0, 0]:g} ohm, {resistance[0, 1]:g} ohm and infinity, with a baseline of "
        f"{baseline[0, 0]:g} ohm, have the codes {values}; on the bus, the low byte is sent first. "
        f"The code of an open wire is {scale.open}, that of a short circuit is {scale.short}, and that of a "
        f"value out of range is {scale.over_range}."
    )


def summary_flags() -> str:
    """List the flag bits in the second byte of a summary."""
    return _enum_table(SummaryFlag, ("bit", "name", "meaning"), 2)


def pdos() -> str:
    """List the PDO parameters and their values after a reset."""
    objects = {item.index: item for item in PROFILE.objects()}
    names = {(e.index, e.subindex): e.name for item in objects.values() for e in item.entries}
    rows = []
    for kind, parameter, mapping, count in (
        ("TPDO", od.TPDO1_PARAMETER, od.TPDO1_MAPPING, PROFILE.tpdos),
        ("RPDO", od.RPDO1_PARAMETER, od.RPDO1_MAPPING, PROFILE.rpdos),
    ):
        for number in range(count):
            item, mapped = objects[parameter + number], objects[mapping + number]
            entries = [int(mapped[sub].default or 0) for sub in range(1, int(mapped[0].default or 0) + 1)]
            objects_in = ", ".join(
                f"{names[entry >> 16, entry >> 8 & 0xFF]} (`{entry >> 16:04X}:{entry >> 8 & 0xFF}`)"
                for entry in entries
            )
            inhibit = "" if kind == "RPDO" else f"{int(item[od.PDO_INHIBIT_TIME].default or 0) / 10:g} ms"
            rows.append(
                (
                    f"{kind}{number + 1}",
                    _default(item[od.PDO_COB_ID]),
                    str(item[od.PDO_TYPE].default),
                    inhibit,
                    objects_in or "nothing",
                )
            )
    return md.table(("PDO", "COB-ID", "type", "inhibit", "mapped"), rows)


def communication() -> str:
    return _dictionary(item for item in PROFILE.objects() if item.index < 0x2000)


def manufacturer() -> str:
    return _dictionary(item for item in PROFILE.objects() if item.index >= 0x2000)


def emergencies() -> str:
    """List the EMCY error codes that a node sends."""
    rows = (
        (md.c_hex(code), error_text(code, ours=True), md.c_hex(code.register_bit, 2))
        for code in EmcyCode
        if code
    )
    return md.table(("code", "meaning", "bit of 0x1001, in addition to bit 0"), rows)


def aborts() -> str:
    """List the abort codes that the SDO server sends."""
    rows = (
        (md.c_hex(code, 8), SdoAbortedError.CODES.get(code, code.name.replace("_", " ").capitalize()))
        for code in AbortCode
    )
    return md.table(("code", "meaning"), rows)


def rejected() -> str:
    """List the sub-indices of object 0x2040."""
    names = {entry.subindex: entry.name for entry in _find(PROFILE, od.REJECTED_FRAMES).entries}
    docs = md.member_docs(Rejected)
    rows = ((str(kind.value), names[kind.value], docs[kind.name]) for kind in Rejected)
    return md.table(("sub", "counter", "counts frames that are"), rows)


def _enum_table(kind: type[enum.IntFlag], head: tuple[str, ...], digits: int) -> str:
    docs = md.member_docs(kind)
    return md.table(
        head,
        ((md.c_hex(item.value, digits), name, docs[name]) for name, item in kind.__members__.items()),
    )


def _find(profile: PatchProfile, index: int) -> Object:
    return next(item for item in profile.objects() if item.index == index)


def _shape(item: Object) -> list[tuple[object, ...]]:
    return [(e.subindex, e.data_type, e.access, e.default, e.mappable) for e in item.entries]


def _family(item: Object) -> str:
    """Return an object's name without its trailing number, for example `Codes of upper wire`."""
    return item.name.rstrip("0123456789")


def _dictionary(objects: Iterable[Object]) -> str:
    """Return a table with one row per entry; similar consecutive entries or objects share a row."""
    runs: list[list[Object]] = []
    for item in objects:
        if runs and _family(item) == _family(runs[-1][-1]) and _shape(item) == _shape(runs[-1][0]):
            runs[-1].append(item)
        else:
            runs.append([item])
    rows: list[tuple[str, ...]] = []
    for run in runs:
        first, last = run[0], run[-1]
        many = len(run) > 1
        index = md.c_hex(first.index) + (f" – {last.index:04X}" if many else "")
        name = _and_on(first.name, last.name) if many else first.name
        if len(first.entries) == 1:
            rows.append((f"**{index}**", "0", f"**{name}**", *_columns(first.entries[0])))
            continue
        rows.append((f"**{index}**", "", f"**{name}**", first.type.name.lower(), "", "", ""))
        for group in _alike(e for e in first.entries if e.name != _HIGHEST):
            subs = str(group[0].subindex)
            label = group[0].name
            if len(group) > 1:
                subs, label = f"{subs}–{group[-1].subindex}", _and_on(label, group[-1].name)
            rows.append(("", subs, label, *_columns(group[0])))
    return md.table(("index", "sub", "name", "type", "access", "default", "PDO"), rows)


def _and_on(first: str, last: str) -> str:
    """Combine two names that differ only in their last word."""
    return f"{first} … {last.rpartition(' ')[2]}"


def _alike(entries: Iterable[Entry]) -> list[list[Entry]]:
    groups: list[list[Entry]] = []
    for entry in entries:
        key = (entry.data_type, entry.access, entry.default, entry.mappable, entry.plus_node_id)
        if groups and key == _key(groups[-1][0]) and entry.subindex > 1:
            groups[-1].append(entry)
        else:
            groups.append([entry])
    return [part for group in groups for part in ([group] if len(group) > _FEW else [[e] for e in group])]


def _key(entry: Entry) -> tuple[object, ...]:
    return (entry.data_type, entry.access, entry.default, entry.mappable, entry.plus_node_id)


def _columns(entry: Entry) -> tuple[str, ...]:
    return entry.data_type.name, entry.access, _default(entry), "yes" if entry.mappable else ""


def _default(entry: Entry) -> str:
    value = entry.default
    if value is None:
        return ""
    if isinstance(value, int) and (entry.name.startswith("COB-ID") or value > 0xFFFF):
        return md.c_hex(value, 3) + (_PLUS_NODE_ID if entry.plus_node_id else "")
    return f"{value:g}" if isinstance(value, float) else str(value)


TABLES: Final[dict[str, Callable[[], str]]] = {
    "cob-ids": cob_ids,
    "formats": formats,
    "example-scan": example_scan,
    "summary-flags": summary_flags,
    "pdos": pdos,
    "communication-objects": communication,
    "patch-objects": manufacturer,
    "emergencies": emergencies,
    "abort-codes": aborts,
    "rejected-frames": rejected,
}
