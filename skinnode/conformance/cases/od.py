"""Conformance cases OD-01 to OD-09: access to the objects described in the EDS.

OD-01, OD-02 and OD-05 cover 0x1000 to 0x1FFF, OD-07 to OD-09 cover 0x2000 to 0x9FFF, and the other cases
cover all objects.
"""

from __future__ import annotations

from collections.abc import Iterable

from skinnode.conformance.case import NotApplicable, Warned, case
from skinnode.conformance.cases.sdo import NO_SUBINDEX, READ_ONLY, TOO_HIGH, TOO_LOW, WRITE_ONLY, limited
from skinnode.conformance.dut import RESTORE, STORE, Dut
from skinnode.conformance.eds_reader import EdsEntry
from skinnode.conformance.sdo import Aborted, expedited, mux
from skinnode.conformance.tester import Failed
from skinnode.text.words import counted

_COMMUNICATION = 0x1000, 0x1FFF
_REST = 0x2000, 0x9FFF
_COMMANDS = (0x1010, 0x1011, 0x1020)
_PDOS = range(0x1400, 0x1C00)
_NO_DATA = 0x0800_0024
_ERROR_FIELD = 0x1003
_REFUSE_WRITE, _REFUSE_READ = 1, 2


def _read_all(dut: Dut, entries: Iterable[EdsEntry]) -> None:
    faults = []
    for entry in entries:
        if not entry.readable:
            continue
        try:
            value = dut.sdo.read(entry.index, entry.subindex)
        except Aborted as abort:
            empty = abort.code == _NO_DATA and entry.index == _ERROR_FIELD and entry.subindex
            if not empty:
                faults.append(f"{entry}: {abort}")
            continue
        if entry.size and len(value) != entry.size:
            faults.append(f"{entry}: {counted(len(value), 'byte')} read, but its data type has {entry.size}")
    _none("every object to be readable and to have the length of its data type", faults)


def _none(expected: str, faults: list[str]) -> None:
    if faults:
        more = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise Failed(expected, "; ".join(faults[:3]) + more)


def _compare_defaults(dut: Dut, entries: Iterable[EdsEntry]) -> None:
    """Compare the default values on the device with those in the EDS.

    For 0x1010 and 0x1011, a difference is only a warning, because these objects return storage capabilities.
    """
    faults: list[str] = []
    doubts: list[str] = []
    for entry in entries:
        default = entry.default_bytes(dut.node_id) if entry.readable else None
        if default is None or (entry.index == _ERROR_FIELD and entry.subindex):
            continue
        value = dut.sdo.read(entry.index, entry.subindex)
        if value != default:
            text = f"{entry}: {value.hex(' ').upper()}, EDS {default.hex(' ').upper()}"
            (doubts if entry.index in (STORE, RESTORE) and entry.subindex else faults).append(text)
    _none("the default values given in the EDS", faults)
    if doubts:
        raise Warned(
            f"the device's store or restore capabilities differ from those in the EDS: {'; '.join(doubts)}"
        )


@case(
    "OD-01",
    "Every readable object from 0x1000 to 0x1FFF can be read, and has the length of its data type",
    "7.4, 7.5.2",
)
def read_communication(dut: Dut) -> None:
    _read_all(dut, dut.eds.between(*_COMMUNICATION))


@case("OD-02", "Objects from 0x1000 to 0x1FFF have the default values given in the EDS", "7.5.1; CiA 306-1")
def communication_defaults(dut: Dut) -> None:
    dut.to_defaults()
    _compare_defaults(dut, dut.eds.between(*_COMMUNICATION))


@case("OD-03", "Writes to ro and const objects are refused", "7.4.5, 7.2.4.3.17")
def read_only(dut: Dut) -> None:
    for entry in dut.eds.entries.values():
        if entry.access in ("ro", "const"):
            request = expedited(entry.index, entry.subindex, bytes(entry.size if 0 < entry.size <= 4 else 4))
            if entry.size > 4:  # too long for an expedited transfer
                request = b"\x21" + mux(entry.index, entry.subindex) + bytes((entry.size, 0, 0, 0))
            dut.sdo.aborts(request, entry.index, entry.subindex, READ_ONLY, f"write to {entry}")


@case("OD-04", "Reads of wo objects are refused", "7.4.5, 7.2.4.3.17")
def write_only(dut: Dut) -> None:
    entries = [entry for entry in dut.eds.entries.values() if entry.access == "wo"]
    if not entries:
        raise NotApplicable("the EDS has no object with access wo")
    for entry in entries:
        request = b"\x40" + mux(entry.index, entry.subindex)
        dut.sdo.aborts(request, entry.index, entry.subindex, WRITE_ONLY, f"read of {entry}")


@case(
    "OD-05", "Sub-index 0xFF, if it exists, contains the object code and data type given in the EDS", "7.4.3"
)
def structure(dut: Dut) -> None:
    known = {0x5: 0x05, 0x6: 0x06, 0x7: 0x07}
    found = False
    for index in dut.eds.indices(*_COMMUNICATION):
        answer = dut.sdo.ask(b"\x40" + mux(index, 0xFF), f"read of 0x{index:04X}:FF")
        if answer[0] == 0x80:
            dut.sdo.check_abort(answer, index, 0xFF, NO_SUBINDEX, f"read of 0x{index:04X}:FF")
            continue
        found = True
        entry = dut.eds.find(index, 1) or dut.need(index)
        word = int.from_bytes(answer[4:8], "little")
        data_type, object_code = word >> 8, word & 0xFF
        if object_code not in (0x2, 0x7, 0x8, 0x9):
            raise Failed(f"a valid object code in 0x{index:04X}:FF", f"0x{word:08X}")
        if object_code == 0x8 and known.get(entry.data_type, data_type) != data_type:
            raise Failed(f"data type 0x{entry.data_type:04X} in 0x{index:04X}:FF", f"0x{word:08X}")
    if not found:
        raise NotApplicable("no object has the optional sub-index 0xFF")


@case("OD-06", "Values beyond the limits in the EDS are refused", "7.2.4.3.17")
def limits(dut: Dut) -> None:
    found = False
    for entry in dut.eds.entries.values():
        # Mapping counts (PDO-25), signatures and the error field have their own rules.
        if (entry.index in _PDOS and entry.subindex == 0) or entry.index in (*_COMMANDS, _ERROR_FIELD):
            continue
        for limit, beyond, codes in ((entry.high, 1, TOO_HIGH), (entry.low, -1, TOO_LOW)):
            value = limited(entry, limit, beyond)
            if value is not None and len(value) <= 4:
                found = True
                request = expedited(entry.index, entry.subindex, value)
                dut.sdo.aborts(request, entry.index, entry.subindex, codes, f"{entry} beyond {limit}")
    if not found:
        raise NotApplicable("no writable object in the EDS has a limit within the range of its data type")


@case(
    "OD-07",
    "Every readable object from 0x2000 to 0x9FFF can be read, and has the length of its data type",
    "7.4",
)
def read_rest(dut: Dut) -> None:
    entries = [entry for entry in dut.eds.between(*_REST) if not entry.flags & _REFUSE_READ]
    if not entries:
        raise NotApplicable("the EDS has no object from 0x2000 to 0x9FFF with ObjFlags bit 1 clear")
    _read_all(dut, entries)


@case(
    "OD-08",
    "Objects from 0x2000 to 0x9FFF have the default values given in the EDS, unless ObjFlags bit 1 is set",
    "CiA 306-1",
)
def rest_defaults(dut: Dut) -> None:
    entries = [e for e in dut.eds.between(*_REST) if e.default and not e.flags & _REFUSE_READ]
    if not entries:
        raise NotApplicable("no object from 0x2000 to 0x9FFF has a default in the EDS")
    dut.to_defaults()
    _compare_defaults(dut, entries)


@case(
    "OD-09",
    "rw objects from 0x2000 to 0x9FFF accept a write of the value read, unless ObjFlags bit 0 is set",
    "CiA 306-1",
)
def write_back(dut: Dut) -> None:
    found = False
    for entry in dut.eds.between(*_REST):
        if not (entry.readable and entry.writable) or entry.flags & (_REFUSE_READ | _REFUSE_WRITE):
            continue
        found = True
        value = dut.sdo.read(entry.index, entry.subindex)
        dut.sdo.write(entry.index, entry.subindex, value)
        again = dut.sdo.read(entry.index, entry.subindex)
        if again != value:
            raise Failed(
                f"{entry} = {value.hex(' ').upper()} after that value was written", again.hex(" ").upper()
            )
    if not found:
        raise NotApplicable("the EDS has no rw object from 0x2000 to 0x9FFF with ObjFlags bits 0 and 1 clear")
