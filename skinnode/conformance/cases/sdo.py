"""Conformance cases SDO-01 to SDO-18: expedited and segmented transfer, and aborted requests."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable

from skinnode.conformance.case import NotApplicable, case
from skinnode.conformance.dut import GUARD_TIME, HEARTBEAT, Dut
from skinnode.conformance.eds_reader import SIGNED, UNSIGNED, EdsEntry
from skinnode.conformance.sdo import expedited, mux
from skinnode.conformance.tester import Failed
from skinnode.text.words import counted

READ_ONLY = (0x0601_0000, 0x0601_0002)
WRITE_ONLY = (0x0601_0000, 0x0601_0001)
NO_OBJECT = (0x0602_0000,)
NO_SUBINDEX = (0x0609_0011,)
UNKNOWN_COMMAND = (0x0504_0001,)
TOO_LONG = (0x0607_0010, 0x0607_0012)
TOO_SHORT = (0x0607_0010, 0x0607_0013)
TOO_HIGH = (0x0609_0030, 0x0609_0031)
TOO_LOW = (0x0609_0030, 0x0609_0032)

_DEVICE_TYPE = 0x1000
_HARMLESS = (HEARTBEAT, 0x1015, 0x1006, 0x1007, GUARD_TIME)
"""CiA 301 objects to which any value can be written without an immediate effect."""
_SPECIAL = (0x1003, 0x1010, 0x1011, 0x1020, 0x1F50, 0x1F51)
"""Objects that accept only commands or certain values."""
_STRINGS = (0x1008, 0x1009, 0x100A)


def first(entries: Iterable[EdsEntry], fits: Callable[[EdsEntry], bool], lack: str) -> EdsEntry:
    """Return the first entry for which ``fits`` is true, excluding the objects in ``_SPECIAL``.

    Raises NotApplicable if there is none; in the message, ``lack`` describes the missing object.
    """
    for entry in entries:
        if fits(entry) and entry.index not in _SPECIAL:
            return entry
    raise NotApplicable(f"the EDS has no {lack}")


def long_object(dut: Dut) -> tuple[EdsEntry, bytes]:
    """Return a readable object longer than four bytes, preferably a device name or version, and its value."""
    texts = [dut.eds.find(index) for index in _STRINGS]
    others = (entry for entry in dut.eds.entries.values() if entry.size not in (1, 2, 3, 4))
    for entry in (*texts, *others):
        if entry is not None and entry.readable:
            value = dut.sdo.read(entry.index, entry.subindex)
            if len(value) > 4:
                return entry, value
    raise NotApplicable("no readable object in the EDS is longer than four bytes")


def check(dut: Dut, index: int, value: int, size: int) -> None:
    """Raise Failed unless a read of ``index`` returns ``value``."""
    got = dut.sdo.integer(index)
    if got != value:
        raise Failed(f"0x{value:0{2 * size}X} read back from 0x{index:04X}:00", f"0x{got:0{2 * size}X}")


@case("SDO-01", "0x1000 is read by an expedited transfer of four bytes", "7.2.4.3.6")
def read_expedited(dut: Dut) -> None:
    answer = dut.sdo.served(b"\x40" + mux(_DEVICE_TYPE, 0), "read of 0x1000:00")
    if answer[:4] != b"\x43" + mux(_DEVICE_TYPE, 0):
        raise Failed("43 00 10 00 …", answer.hex(" ").upper())
    entry = dut.need(_DEVICE_TYPE)
    default = entry.default_bytes(dut.node_id)
    if default is not None and answer[4:] != default:
        raise Failed(f"{default.hex(' ').upper()}, the default in the EDS", answer[4:].hex(" ").upper())


@case(
    "SDO-02",
    "An object from 0x1000 to 0x1FFF can be written by expedited transfer and read back",
    "7.2.4.3.3, 7.2.4.3.6",
)
def write_expedited(dut: Dut) -> None:
    entries = [found for index in _HARMLESS if (found := dut.eds.find(index)) is not None]
    entry = first(
        entries, lambda e: e.readable and e.writable, "rw object from 0x1000 to 0x1FFF without side effects"
    )
    before = dut.sdo.read(entry.index)
    value = (int.from_bytes(before, "little") ^ 0x2000).to_bytes(entry.size, "little")
    dut.sdo.write(entry.index, 0, value)
    check(dut, entry.index, int.from_bytes(value, "little"), entry.size)
    dut.sdo.write(entry.index, 0, before)
    check(dut, entry.index, int.from_bytes(before, "little"), entry.size)


@case("SDO-03", "A write to 0x1000, which is read-only, is refused", "7.2.4.3.17; 7.5.2.1")
def write_read_only(dut: Dut) -> None:
    value = dut.sdo.read(_DEVICE_TYPE)
    dut.sdo.aborts(expedited(_DEVICE_TYPE, 0, value), _DEVICE_TYPE, 0, READ_ONLY, "write to 0x1000:00")


@case("SDO-04", "A read of a write-only object is refused", "7.2.4.3.17")
def read_write_only(dut: Dut) -> None:
    entry = first(dut.eds.entries.values(), lambda e: e.access == "wo", "object with access wo")
    request = b"\x40" + mux(entry.index, entry.subindex)
    dut.sdo.aborts(request, entry.index, entry.subindex, WRITE_ONLY, f"read of {entry}")


@case("SDO-05", "A read of 0x1000:01, a sub-index that does not exist, is refused", "7.2.4.3.17")
def no_subindex(dut: Dut) -> None:
    dut.sdo.aborts(b"\x40" + mux(_DEVICE_TYPE, 1), _DEVICE_TYPE, 1, NO_SUBINDEX, "read of 0x1000:01")


@case("SDO-06", "Reads and writes of an object that does not exist are refused", "7.2.4.3.17")
def no_object(dut: Dut) -> None:
    index = next(i for i in (0x1004, 0x1013, 0x1FFF) if not dut.eds.has(i))
    dut.sdo.aborts(b"\x40" + mux(index, 0), index, 0, NO_OBJECT, f"read of 0x{index:04X}:00")
    dut.sdo.aborts(expedited(index, 0, bytes(4)), index, 0, NO_OBJECT, f"write to 0x{index:04X}:00")


@case("SDO-07", "An unknown command specifier is refused, and the server keeps working", "7.2.4.3.17")
def unknown_command(dut: Dut) -> None:
    what = "command specifier 7"
    answer = dut.sdo.ask(b"\xe0" + mux(_DEVICE_TYPE, 0), what)
    # The standard does not specify the multiplexer for this abort.
    index, subindex = struct.unpack("<HB", answer[1:4])
    dut.sdo.check_abort(answer, index, subindex, UNKNOWN_COMMAND, what)
    dut.sdo.read(_DEVICE_TYPE)


def _writable_of(dut: Dut, *sizes: int) -> EdsEntry:
    wanted = " or ".join(str(size) for size in sizes)
    entries = [found for index in _HARMLESS if (found := dut.eds.find(index)) is not None]
    entries += dut.eds.between(0x1000, 0x9FFF)
    return first(
        entries,
        lambda e: e.writable and e.readable and e.size in sizes and e.data_type in UNSIGNED,
        f"writable object of {wanted} bytes",
    )


@case(
    "SDO-08",
    "Writing four bytes to an object of one or two bytes is refused; its value is unchanged",
    "7.2.4.3.17",
)
def too_long(dut: Dut) -> None:
    entry = _writable_of(dut, 1, 2)
    before = dut.sdo.read(entry.index, entry.subindex)
    request = expedited(entry.index, entry.subindex, before.ljust(4, b"\0"))
    dut.sdo.aborts(request, entry.index, entry.subindex, TOO_LONG, f"write of 4 bytes to {entry}")
    _unchanged(dut, entry, before)


@case(
    "SDO-09",
    "Writing one byte to an object of two or four bytes is refused; its value is unchanged",
    "7.2.4.3.17",
)
def too_short(dut: Dut) -> None:
    entry = _writable_of(dut, 2, 4)
    before = dut.sdo.read(entry.index, entry.subindex)
    request = expedited(entry.index, entry.subindex, before[:1])
    dut.sdo.aborts(request, entry.index, entry.subindex, TOO_SHORT, f"write of 1 byte to {entry}")
    _unchanged(dut, entry, before)


def _unchanged(dut: Dut, entry: EdsEntry, before: bytes) -> None:
    now = dut.sdo.read(entry.index, entry.subindex)
    if now != before:
        raise Failed(f"{entry} still {before.hex(' ').upper()}", now.hex(" ").upper())


def limited(entry: EdsEntry, limit: int | None, beyond: int) -> bytes | None:
    """Return ``limit + beyond`` as bytes; None if there is no limit or the value does not fit the type."""
    if limit is None or not entry.writable or entry.data_type not in (*SIGNED, *UNSIGNED):
        return None
    try:
        return (limit + beyond).to_bytes(entry.size, "little", signed=entry.data_type in SIGNED)
    except OverflowError:
        return None


@case("SDO-10", "A value above the high limit in the EDS is refused; the old value is kept", "7.2.4.3.17")
def too_high(dut: Dut) -> None:
    entry = first(
        dut.eds.entries.values(),
        lambda e: e.index not in range(0x1600, 0x1C00) and limited(e, e.high, 1) is not None,
        "writable object whose high limit is below the maximum of its data type",
    )
    before = dut.sdo.read(entry.index, entry.subindex)
    value = limited(entry, entry.high, 1) or b""
    request = expedited(entry.index, entry.subindex, value)
    dut.sdo.aborts(request, entry.index, entry.subindex, TOO_HIGH, f"{entry} above {entry.high}")
    _unchanged(dut, entry, before)


@case("SDO-11", "A value below the low limit in the EDS is refused; the old value is kept", "7.2.4.3.17")
def too_low(dut: Dut) -> None:
    entry = first(
        dut.eds.entries.values(),
        lambda e: limited(e, e.low, -1) is not None,
        "writable object whose low limit is above the minimum of its data type",
    )
    before = dut.sdo.read(entry.index, entry.subindex)
    value = limited(entry, entry.low, -1) or b""
    request = expedited(entry.index, entry.subindex, value)
    dut.sdo.aborts(request, entry.index, entry.subindex, TOO_LOW, f"{entry} below {entry.low}")
    _unchanged(dut, entry, before)


@case(
    "SDO-12",
    "0x1200 contains the COB-IDs of the default SDO: node-ID + 0x600 and node-ID + 0x580",
    "7.5.2.33; 7.3.3",
)
def default_sdo(dut: Dut) -> None:
    for subindex, base in ((1, 0x600), (2, 0x580)):
        dut.need(0x1200, subindex)
        cob_id = dut.sdo.integer(0x1200, subindex)
        if cob_id != base + dut.node_id:
            raise Failed(f"0x1200:{subindex:02X} = 0x{base + dut.node_id:08X}", f"0x{cob_id:08X}")


@case(
    "SDO-13",
    "0x1000 can be read with the transfer type that the server selects, and has the announced length",
    "7.2.4.3.5",
)
def read_short(dut: Dut) -> None:
    value = dut.sdo.read(_DEVICE_TYPE)
    if len(value) != 4:
        raise Failed("four bytes of 0x1000:00", value.hex(" ").upper())


def _write_segmented(dut: Dut, index: int) -> None:
    dut.need(index)
    dut.sdo.write_segments(index, 0, b"\x34\x12")
    check(dut, index, 0x1234, 2)
    dut.sdo.write_segments(index, 0, b"\0\0")
    check(dut, index, 0, 2)


@case("SDO-14", "0x100C can be written in segments and read back", "7.2.4.3.3, 7.2.4.3.4")
def write_guard_time(dut: Dut) -> None:
    _write_segmented(dut, GUARD_TIME)


@case("SDO-15", "0x1017 can be written in segments and read back", "7.2.4.3.3, 7.2.4.3.4")
def write_heartbeat(dut: Dut) -> None:
    _write_segmented(dut, HEARTBEAT)


@case(
    "SDO-16",
    "An object of more than four bytes is read in segments, after its length is announced",
    "7.2.4.3.6",
)
def read_announced(dut: Dut) -> None:
    entry, value = long_object(dut)
    what = f"read of {entry}"
    answer = dut.sdo.served(b"\x40" + mux(entry.index, entry.subindex), what)
    if answer[0] != 0x41:
        raise Failed(f"41 … to {what}", answer.hex(" ").upper())
    if int.from_bytes(answer[4:], "little") != len(value):
        raise Failed(f"{counted(len(value), 'byte')} announced, {what}", answer.hex(" ").upper())
    dut.sdo.abort(entry.index, entry.subindex)


@case("SDO-17", "A segment requested with the wrong toggle bit is refused", "7.2.4.3.7, 7.2.4.3.17")
def wrong_toggle(dut: Dut) -> None:
    entry, _ = long_object(dut)
    what = f"read of {entry}"
    dut.sdo.served(b"\x40" + mux(entry.index, entry.subindex), what)
    toggled = "a first segment requested with toggle bit 1"
    dut.sdo.aborts(b"\x70", entry.index, entry.subindex, (0x0503_0000,), toggled)
    answer = dut.sdo.ask(b"\x60", "a segment of an aborted transfer")
    if answer[0] != 0x80:
        raise Failed("the transfer to have ended", answer.hex(" ").upper())


@case(
    "SDO-18",
    "Objects of more than four bytes are read in segments with correct toggle and last-segment bits",
    "7.2.4.3.7",
)
def read_segments(dut: Dut) -> None:
    entry, value = long_object(dut)
    again = dut.sdo.read(entry.index, entry.subindex)
    if again != value:
        raise Failed(f"the same value in two reads of {entry}", f"{value!r} and {again!r}")
    for other in dut.eds.entries.values():
        if other.readable and other.size not in (1, 2, 3, 4):
            dut.sdo.read(other.index, other.subindex)
