"""Generates the C99 kit, which board firmware uses to pack scans and other masters use to assemble them.

The kit has three files. ``skinnode_patch.h`` and ``skinnode_patch.c`` are the same for every patch and are
kept as C files in the folder ``c``, so that they can be read, checked and compiled directly. All sizes,
indices and codes are in ``skinnode_patch_config.h``, which this module generates from the profile.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from fractions import Fraction
from importlib import resources
from pathlib import Path
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.emergency import EmcyCode
from skinnode.model.layout import PRESET_IDS, PatchLayout
from skinnode.protocol.command import SendMode
from skinnode.protocol.coordinates import pack_coordinates
from skinnode.protocol.device_time import TIME_SHIFT
from skinnode.protocol.objects import (
    DEFAULT_CODE_HI,
    DEFAULT_CODE_LO,
    DEFAULT_REFRESH_SCANS,
    DEFAULT_THRESHOLD_CODES,
)
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan_check import CRC_INITIAL
from skinnode.protocol.summary import PHASE_SHIFT, PHASES, SummaryFlag

CONFIG_NAME: Final = "skinnode_patch_config.h"
"""Name of the generated file."""
FIXED_NAMES: Final = ("skinnode_patch.h", "skinnode_patch.c")
"""Names of the files that do not depend on the patch."""
MARK: Final = "/* Written by skinnode eds --c."
"""Text at the beginning of each file. Only files with this text are overwritten."""

_OBJECTS: Final = {
    "DESCRIPTOR": (
        "ROWS COLUMNS UPPER_ELECTRODES LOWER_ELECTRODES CODE_BITS CODE_LO CODE_HI RESISTIVITY LAYOUT_ID"
        " LAYOUT_HASH SERIAL PDO_BYTES"
    ),
    "CHUNK": "CHUNK_INDEX CHUNK_SCAN",
    "SUMMARY": ("SUMMARY_SCAN SUMMARY_FLAGS SUMMARY_CHUNKS SUMMARY_TIME SUMMARY_TIME_64US SUMMARY_CHECK"),
    "SEND_POLICY": "SEND_MODE SEND_THRESHOLD SEND_REFRESH",
    "ACQUISITION": "ACQUISITION_PERIOD ACQUISITION_AVERAGING SELF_TEST TARE SINGLE_SCAN",
    "TIME_OF_DAY": "TIME_DAYS TIME_MS TIME_MESSAGES TIME_DEVICE_US",
    "SELF_TEST_RESULT": (
        "TEST_STATUS TEST_FAULTS TEST_READINGS TEST_NOISE TEST_OPEN_WIRES TEST_SHORTED_WIRES"
        " TEST_OUT_OF_RANGE TEST_UNTARED"
    ),
    "UPPER_WIRE_FAULTS": "",
    "LOWER_WIRE_FAULTS": "",
    "REJECTED_FRAMES": "",
    "CODES": "",
    "BASELINE": "",
    "COORDINATES": "",
    "BASELINE_DOMAIN": "",
}
"""Manufacturer objects and their sub-indices, as named in :mod:`skinnode.canopen.indices`."""

_COORDINATE_BYTES: Final = 12
"""Bytes per line of the generated array: the coordinates of one electrode."""

_Macros = dict[str, str | int]


def kit_files(profile: PatchProfile, layout: PatchLayout | None = None) -> dict[str, str]:
    """Return the contents of the kit's files, by file name.

    Args:
        profile: Dimensions of the patch.
        layout: Electrodes of the patch; None if only the sizes are known.
    """
    folder = resources.files(__package__) / "c"
    fixed = {name: (folder / name).read_text(encoding="ascii") for name in FIXED_NAMES}
    return {**fixed, CONFIG_NAME: config_header(profile, layout)}


def may_replace(file: Path) -> bool:
    """Return whether a kit file does not exist yet or begins with :data:`MARK`, and may therefore be written.

    Args:
        file: Path of the file.

    Raises:
        OSError: If the file exists but cannot be read.
    """
    if not file.exists():
        return True
    if not file.is_file():
        return False
    with file.open("rb") as existing:
        return existing.read(len(MARK)) == MARK.encode("ascii")


def config_header(profile: PatchProfile, layout: PatchLayout | None = None) -> str:
    """Return the contents of ``skinnode_patch_config.h``, which depends only on the arguments.

    Args:
        profile: Dimensions of the patch.
        layout: Electrodes of the patch; None if only the sizes are known.
    """
    bus = "PDO over CAN FD" if profile.bus == "fd" else "classic CAN"
    sizes = f"{profile.rows} x {profile.columns} wires with {profile.code_bits}-bit codes on {bus}"
    head = (
        f"{MARK} MIT licence.\n *\n * Sizes of a patch of {sizes}, and\n"
        " * numbers of the protocol. To change a size, run skinnode eds --c again.\n */\n"
        "#ifndef SKINNODE_PATCH_CONFIG_H\n#define SKINNODE_PATCH_CONFIG_H\n"
    )
    sections = "".join(f"\n/* --- {title} */\n{_lines(macros)}" for title, macros in _sections(profile))
    if layout is not None:
        sections += f"\n/* --- layout of the electrodes (0x2000:8 to 0x2000:10, 0x2300) */\n{_layout(layout)}"
    return f"{head}{sections}\n#endif /* SKINNODE_PATCH_CONFIG_H */\n"


def _lines(macros: _Macros) -> str:
    return "".join(
        f"#define SKN_{name} {value if isinstance(value, str) else f'{value}u'}\n"
        for name, value in macros.items()
    )


def _sections(profile: PatchProfile) -> Iterator[tuple[str, _Macros]]:
    yield "sizes of the patch", _sizes(profile)
    yield "chunks of a scan (TPDO1)", _chunks(profile)
    yield "code 0 is R/R0 = LO / ONE, the highest measurement is R/R0 = (LO + SPAN) / ONE", _scale()
    yield "COB-IDs of the pre-defined connection set, without the node-ID", _cob_ids()
    yield "identity (0x1018)", _identity(profile)
    yield "manufacturer objects: index, and sub-indices", dict(_objects())
    yield "flags of the summary", _flags()
    yield "values and defaults", _values(profile)
    yield "error codes of emergency messages", {f"EMCY_{code.name}": _hexadecimal(code) for code in EmcyCode}


def _sizes(profile: PatchProfile) -> _Macros:
    return {
        "ROWS": profile.rows,
        "COLUMNS": profile.columns,
        "UPPER_ELECTRODES": profile.upper_electrodes,
        "LOWER_ELECTRODES": profile.lower_electrodes,
        "CODE_BITS": profile.code_bits,
        "FD": int(profile.bus == "fd"),
    }


def _chunks(profile: PatchProfile) -> _Macros:
    return {
        "LINES": profile.lines,
        "CHUNKS_PER_LINE": profile.chunks_per_line,
        "CODES_PER_CHUNK": profile.codes_per_chunk,
        "CHUNKS": profile.n_chunks,
        "CHUNK_HEAD_BYTES": profile.chunk_head_bytes,
        "CHUNK_BYTES": profile.chunk_bytes,
        "INHIBIT_100US": profile.default_inhibit_100us,
    }


def _scale() -> _Macros:
    lo, span = Fraction(DEFAULT_CODE_LO), Fraction(DEFAULT_CODE_HI) - Fraction(DEFAULT_CODE_LO)
    one = max(lo.denominator, span.denominator)  # both are powers of two
    return {"CODE_SCALE_LO": int(lo * one), "CODE_SCALE_SPAN": int(span * one), "CODE_SCALE_ONE": one}


def _cob_ids() -> _Macros:
    ids = {
        "SYNC": od.SYNC_COB_ID,
        "EMCY": od.emcy_cob_id(0),
        "CHUNK": od.chunk_cob_id(0),
        "SUMMARY": od.summary_cob_id(0),
        "COMMAND": od.command_cob_id(0),
        "HEARTBEAT": od.heartbeat_cob_id(0),
    }
    return {f"COB_ID_{name}": _hexadecimal(value) for name, value in ids.items()}


def _identity(profile: PatchProfile) -> _Macros:
    return {
        "VENDOR_ID": od.VENDOR_ID,
        "PRODUCT_CODE": f"0x{od.PRODUCT_CODE:08X}UL",
        "REVISION_NUMBER": f"0x{profile.revision_number:08X}UL",
    }


def _objects() -> Iterator[tuple[str, str | int]]:
    for name, subs in _OBJECTS.items():
        yield f"OD_{name}", _hexadecimal(getattr(od, name))
        for sub in subs.split():
            yield f"SUB_{sub}", getattr(od, sub)


def _flags() -> _Macros:
    named = {flag.name: flag for flag in SummaryFlag if flag.name is not None}
    masks = {"CONVERSIONS": int(SummaryFlag.CONVERSIONS)}
    return {f"FLAG_{name}": f"0x{value:02X}u" for name, value in {**named, **masks}.items()}


def _values(profile: PatchProfile) -> _Macros:
    return {
        "PHASES": PHASES,
        "PHASE_SHIFT": PHASE_SHIFT,
        "TIME_SHIFT": TIME_SHIFT,
        "CRC_INITIAL": _hexadecimal(CRC_INITIAL),
        "MODE_FULL": int(SendMode.FULL),
        "MODE_CHANGED": int(SendMode.CHANGED),
        "DEFAULT_THRESHOLD": DEFAULT_THRESHOLD_CODES,
        "DEFAULT_REFRESH": DEFAULT_REFRESH_SCANS,
        "SIGNATURE_TARE": f"0x{od.TARE_SIGNATURE:08X}UL",
        "SIGNATURE_SELF_TEST": f"0x{od.SELF_TEST_SIGNATURE:08X}UL",
    }


def _layout(layout: PatchLayout) -> str:
    """Return the layout's macros and the coordinate array, which is compiled only on request."""
    (resistivity,) = struct.unpack("<I", struct.pack("<f", layout.resistivity_ohm_per_m))
    coordinates = pack_coordinates(layout)
    rows = [coordinates[at : at + _COORDINATE_BYTES] for at in range(0, len(coordinates), _COORDINATE_BYTES)]
    macros: _Macros = {
        "LAYOUT_ID": PRESET_IDS.get(layout.name, PRESET_IDS["custom"]),
        "LAYOUT_HASH": f"0x{layout.layout_hash:08X}UL",
        "RESISTIVITY_REAL32": f"0x{resistivity:08X}UL",
        "COORDINATES_BYTES": len(coordinates),
    }
    return (
        f"{_lines(macros)}#ifdef SKN_WITH_COORDINATES /* define it in one source file */\n"
        "static const unsigned char skn_coordinates[SKN_COORDINATES_BYTES] = {\n"
        + "".join(f"    {', '.join(f'0x{byte:02X}' for byte in row)},\n" for row in rows)
        + "};\n#endif\n"
    )


def _hexadecimal(value: int) -> str:
    return f"0x{value:04X}u"
