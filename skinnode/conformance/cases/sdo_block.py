"""Conformance cases SDO-19 to SDO-30: block transfer and additional SDOs."""

from __future__ import annotations

import struct
from collections.abc import Callable

from skinnode.conformance.case import NotApplicable, case
from skinnode.conformance.cases.sdo import NO_OBJECT, UNKNOWN_COMMAND, check, long_object
from skinnode.conformance.dut import GUARD_TIME, HEARTBEAT, RESET_COMMUNICATION, STORE, Dut
from skinnode.conformance.sdo import Aborted, mux
from skinnode.conformance.tester import Failed

_BLOCK_SIZE, _SEQUENCE, _CRC = 0x0504_0002, 0x0504_0003, 0x0504_0004


def _block(transfer: Callable[[], bytes | None]) -> bytes | None:
    """Run a block transfer. Raises NotApplicable if the device does not support block transfer."""
    try:
        return transfer()
    except Aborted as abort:
        if abort.code in UNKNOWN_COMMAND:
            raise NotApplicable(
                f"block transfer is optional, and the device does not support it: {abort}"
            ) from abort
        raise


def _read(  # noqa: PLR0913 - an object, its value, and how it is read
    dut: Dut, index: int, subindex: int, wanted: bytes, *, crc: bool, size: int = 20
) -> None:
    got = _block(lambda: dut.sdo.read_block(index, subindex, crc=crc, size=size))
    if got != wanted:
        raise Failed(f"{wanted.hex(' ').upper()} of 0x{index:04X}:{subindex:02X}", repr(got))


def _write(dut: Dut, index: int, *, crc: bool) -> None:
    dut.need(index)
    _block(lambda: dut.sdo.write_block(index, 0, b"\x34\x12", crc=crc))
    check(dut, index, 0x1234, 2)
    dut.sdo.write_block(index, 0, b"\0\0", crc=crc)
    check(dut, index, 0, 2)


@case("SDO-19", "0x1000 can be read by block transfer without CRC", "7.2.4.3.12 to 15")
def block_read_short(dut: Dut) -> None:
    _read(dut, 0x1000, 0, dut.sdo.read(0x1000), crc=False)


@case("SDO-20", "0x100C can be written by block transfer without CRC and read back", "7.2.4.3.8 to 11")
def block_write_guard_time(dut: Dut) -> None:
    _write(dut, GUARD_TIME, crc=False)


@case("SDO-21", "0x1017 can be written by block transfer without CRC and read back", "7.2.4.3.8 to 11")
def block_write_heartbeat(dut: Dut) -> None:
    _write(dut, HEARTBEAT, crc=False)


@case(
    "SDO-22",
    "A long object can be read by block transfer in sub-blocks of 127, 1 or 2 segments",
    "7.2.4.3.14",
)
def block_read_long(dut: Dut) -> None:
    entry, value = long_object(dut)
    for size in (127, 1, 2):
        _read(dut, entry.index, entry.subindex, value, crc=False, size=size)


@case("SDO-23", "A long object can be read by block transfer with CRC", "7.2.4.3.12 to 16")
def block_read_crc(dut: Dut) -> None:
    entry, value = long_object(dut)
    _read(dut, entry.index, entry.subindex, value, crc=True)


@case("SDO-24", "0x100C can be written by block transfer with CRC and read back", "7.2.4.3.8 to 11, 16")
def block_write_guard_time_crc(dut: Dut) -> None:
    _write(dut, GUARD_TIME, crc=True)


@case(
    "SDO-25",
    "0x1017 can be written by block transfer with CRC; a write with a wrong CRC is refused",
    "7.2.4.3.8 to 11, 16",
)
def block_write_heartbeat_crc(dut: Dut) -> None:
    _write(dut, HEARTBEAT, crc=True)
    start = dut.sdo.served(b"\xc6" + mux(HEARTBEAT, 0) + struct.pack("<I", 2), "a block write to 0x1017:00")
    dut.sdo.abort(HEARTBEAT, 0)
    if not start[0] & 4:
        return  # the device does not support the CRC
    try:
        dut.sdo.write_block(HEARTBEAT, 0, b"\x34\x12", crc=True, wrong_crc=True)
    except Aborted as abort:
        if abort.code not in (_CRC, 0x0800_0000):
            raise Failed("abort 0x05040004 after a wrong CRC", str(abort)) from abort
    else:
        raise Failed("abort 0x05040004 after a wrong CRC", "the write was confirmed")
    check(dut, HEARTBEAT, 0, 2)


@case("SDO-26", "Block sizes of 128 and 0 are refused", "7.2.4.3.13, 7.2.4.3.17")
def wrong_block_size(dut: Dut) -> None:
    for size in (128, 0):
        request = b"\xa0" + mux(0x1000, 0) + bytes((size, 0))
        what = f"a block read with a block size of {size}"
        code = dut.sdo.aborts(request, 0x1000, 0, (_BLOCK_SIZE, *UNKNOWN_COMMAND), what)
        if code in UNKNOWN_COMMAND:
            _block(lambda: dut.sdo.read_block(0x1000))


@case(
    "SDO-27", "An acknowledgement of segment 128, which was never sent, is refused", "7.2.4.3.14, 7.2.4.3.17"
)
def wrong_sequence(dut: Dut) -> None:
    _block(lambda: dut.sdo.read_block(0x1000))
    dut.sdo.served(b"\xa0" + mux(0x1000, 0) + b"\x14", "a block read of 0x1000:00")
    dut.sdo.served(b"\xa3", "the start of a block read")
    codes = (_SEQUENCE, *UNKNOWN_COMMAND)
    dut.sdo.aborts(b"\xa2\x80\x14", 0x1000, 0, codes, "an acknowledgement of segment 128")


@case(
    "SDO-28", "SDO server objects in the EDS (0x1201 to 0x127F) can be read, and no others exist", "7.5.2.33"
)
def further_servers(dut: Dut) -> None:
    for index in range(0x1201, 0x1280):
        if dut.eds.has(index):
            dut.sdo.read(index, 1)
            dut.sdo.read(index, 2)
        else:
            dut.sdo.aborts(b"\x40" + mux(index, 1), index, 1, NO_OBJECT, f"read of 0x{index:04X}:01")


@case("SDO-29", "A communication reset restores the COB-IDs of additional SDO servers", "7.5.2.33; 7.3.2.2")
def servers_after_reset(dut: Dut) -> None:
    servers = dut.eds.indices(0x1201, 0x127F)
    if not servers:
        raise NotApplicable("the EDS has no additional SDO server (0x1201 to 0x127F)")
    before = {(index, sub): dut.sdo.read(index, sub) for index in servers for sub in (1, 2)}
    for index in servers:
        for subindex in (1, 2):
            entry = dut.need(index, subindex)
            if entry.writable:
                dut.sdo.write_integer(index, subindex, 0x8000_0000, 4)
    dut.reset(RESET_COMMUNICATION)
    for (index, subindex), value in before.items():
        now = dut.sdo.read(index, subindex)
        if now != value:
            raise Failed(f"0x{index:04X}:{subindex:02X} = {value.hex(' ')} after the reset", now.hex(" "))


@case(
    "SDO-30",
    "SDO client parameters (0x1280 to 0x12FF) stored through 0x1010:01 survive a communication reset",
    "7.5.2.34, 7.5.2.13",
)
def clients_stored(dut: Dut) -> None:
    clients = dut.eds.indices(0x1280, 0x12FF)
    if not clients:
        raise NotApplicable("the EDS has no SDO client (0x1280 to 0x12FF)")
    dut.need_storage(STORE, 1)
    index = clients[0]
    for subindex in (1, 2):
        dut.sdo.write_integer(index, subindex, 0x8000_0000, 4)
    dut.store(1)
    dut.reset(RESET_COMMUNICATION)
    for subindex in (1, 2):
        got = dut.sdo.integer(index, subindex)
        if got != 0x8000_0000:
            raise Failed(f"0x{index:04X}:{subindex:02X} = 0x80000000 after the reset", f"0x{got:08X}")
