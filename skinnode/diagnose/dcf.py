"""Writes and reads the configuration of one device as a DCF (CiA 306), preserving every byte of the values.

Numbers and printable ASCII strings are written to ``ParameterValue`` as CiA 306 specifies, and values of type
OCTET_STRING or DOMAIN are written there in hexadecimal. CiA 306 has no notation for other strings: INI
readers would change non-ASCII characters, leading or trailing blanks, and comment characters. The bytes of
such a string are written as a comment, which :func:`expected` reads and other tools skip::

    ;ParameterBytes=63 61 66 c3 a9
"""

from __future__ import annotations

import configparser
import io
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

from skinnode.canopen import indices as od
from skinnode.canopen.eds_encoding import for_people, octets, octets_text
from skinnode.conformance.eds_reader import Eds, EdsEntry
from skinnode.diagnose.data_sheet import DataSheet
from skinnode.diagnose.object_dictionary import NOT_CONFIGURATION, Reading

_BYTES_KEY: Final = ";ParameterBytes"
_BYTES_LINE: Final = re.compile(r"^;(ParameterBytes=)", re.MULTILINE)
_SECTION: Final = re.compile(r"([0-9A-Fa-f]{4})(?:sub([0-9A-Fa-f]{1,2}))?", re.IGNORECASE)
_VALUES: Final = ("parametervalue", "parameterbytes", _BYTES_KEY.lower())
_COMMISSIONING: Final = "DeviceComissioning"  # CiA 306 spells the name with one m
_STRINGS: Final = {"VISIBLE_STRING": "ascii", "UNICODE_STRING": "utf-16-le"}
_OCTETS: Final = ("OCTET_STRING", "DOMAIN")
_VISIBLE_STRING: Final = 0x09
_AMBIGUOUS: Final = ";#$%\"'\\"
"""Characters with a special meaning in some INI readers (comment, formula, substitution, quote, escape)."""


class Dcf(NamedTuple):
    """Text of a DCF, and information about the values in it."""

    text: str
    values: int
    """Number of values in the file that were read from the node."""
    as_bytes: tuple[Reading, ...]
    """Values that CiA 306 cannot express and that are therefore written as comments."""


def as_dcf(sheet: DataSheet, readings: Sequence[Reading], node_id: int, bitrate_bps: int, name: str) -> Dcf:
    """Return the DCF of a device: its EDS with commissioning data and the values of its writable objects.

    The text is meant for a UTF-8 file, even if the EDS has a different encoding.

    Args:
        sheet: EDS of the device.
        readings: Values read from the node.
        node_id: Node-ID of the node.
        bitrate_bps: Bit rate of the bus, in bit/s.
        name: Name of the node.
    """
    parser = _parser(sheet.text)
    sections = {title.lower(): title for title in parser.sections()}
    written, as_bytes = 0, []
    for reading in readings:
        title = sections.get(f"{reading.index:04x}sub{reading.subindex:x}") or (
            sections.get(f"{reading.index:04x}") if reading.subindex == 0 else None
        )
        if title is None:
            continue
        data = reading.content
        if not _is_configuration(reading):
            default = next((v for k, v in parser.items(title) if k.lower() == "defaultvalue"), None)
            foreign = reading.data_type in _STRINGS and default and not default.isascii()
            if foreign and data is not None:
                parser.set(title, _BYTES_KEY, data.hex(" "))
            continue
        for key in [key for key, _ in parser.items(title) if key.lower() in _VALUES]:
            parser.remove_option(title, key)
        if data is None:
            continue
        value = _standard_form(reading, data)
        written += 1
        if value is not None:
            parser.set(title, "ParameterValue", value)
        else:
            as_bytes.append(reading)
            parser.set(title, _BYTES_KEY, data.hex(" "))
    name = octets_text(name.encode(sheet.codec, "replace"))
    _commission(parser, sections, node_id, bitrate_bps, name)
    text = io.StringIO()
    parser.write(text, space_around_delimiters=False)
    return Dcf(for_people(text.getvalue(), sheet.codec), written, tuple(as_bytes))


def expected(sheet: DataSheet) -> Eds:
    """Return the EDS with each default value replaced by the value that a DCF specifies for the object."""
    parser = _parser(_BYTES_LINE.sub(r"\1", sheet.text))
    entries = dict(sheet.eds.entries)
    for section in parser.sections():
        match = _SECTION.fullmatch(section)
        key = None if match is None else (int(match[1], 16), int(match[2] or "0", 16))
        if key is None or key not in entries:
            continue
        options = {name.lower(): value for name, value in parser.items(section)}
        entries[key] = _with_value(entries[key], options.get("parametervalue"), options.get("parameterbytes"))
    return replace(sheet.eds, entries=entries)


def _with_value(entry: EdsEntry, value: str | None, as_bytes: str | None) -> EdsEntry:
    if as_bytes is not None:
        try:
            return replace(entry, given=bytes.fromhex(as_bytes))
        except ValueError:
            return entry  # not written by this program
    if value and entry.data_type == _VISIBLE_STRING:  # trailing NULs would be in ParameterBytes
        return replace(entry, given=octets(value.strip()))
    return replace(entry, default=value.strip()) if value else entry


def _is_configuration(reading: Reading) -> bool:
    """Return whether the object is part of the configuration that a tool downloads from a DCF to a node."""
    measured = reading.index in (*NOT_CONFIGURATION, od.BASELINE_DOMAIN)
    command = (reading.index, reading.subindex) in od.COMMANDS
    return reading.access in ("rw", "rww", "rwr") and not measured and not command


def _standard_form(reading: Reading, data: bytes) -> str | None:
    """Return the value in CiA 306 notation; None if this would change its bytes.

    Integers of 10 or more are written in hexadecimal, and reals as their bit patterns, as conforming tools
    expect.
    """
    if reading.data_type in _STRINGS:
        return _plain(data, _STRINGS[reading.data_type])
    if reading.data_type in _OCTETS:
        return data.hex().upper() or None
    if isinstance(reading.value, float):
        return f"0x{int.from_bytes(data, 'little'):0{2 * len(data)}X}"
    if isinstance(reading.value, int):
        return str(reading.value) if reading.value < 10 else f"0x{reading.value:X}"
    return None


def _plain(data: bytes, codec: str) -> str | None:
    """Decode a string; None if an INI reader might change it."""
    try:
        text = data.decode(codec)
    except UnicodeDecodeError:
        return None
    plain = text.isascii() and text.isprintable() and text == text.strip() and text.encode(codec) == data
    return text if plain and text and not any(sign in text for sign in _AMBIGUOUS) else None


def _commission(
    parser: configparser.ConfigParser, sections: dict[str, str], node_id: int, bitrate_bps: int, name: str
) -> None:
    title = sections.get(_COMMISSIONING.lower(), _COMMISSIONING)
    if not parser.has_section(title):
        parser.add_section(title)
    for key, value in (
        ("NodeID", str(node_id)),
        ("NodeName", name),
        ("Baudrate", str(bitrate_bps // 1000)),
        ("NetNumber", "0"),
        ("NetworkName", ""),
        ("CANopenManager", "0"),
    ):
        parser.set(title, key, value)


def _parser(text: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(
        interpolation=None, strict=False, comment_prefixes=(";",), delimiters=("=",), allow_no_value=True
    )
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(text)
    return parser
