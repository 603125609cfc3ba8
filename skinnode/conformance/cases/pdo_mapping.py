"""Conformance cases PDO-21 to PDO-33: default PDO mappings, remapping and invalid mappings."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from skinnode.conformance.case import NotApplicable, case
from skinnode.conformance.dut import Dut
from skinnode.conformance.eds_reader import EdsEntry
from skinnode.conformance.pdo import (
    CAN_ID,
    INVALID,
    Pdo,
    PdoSetup,
    disable,
    expect_pdo,
    mapped,
    payload_bytes,
    rpdos,
    set_up,
    sync,
    tpdos,
)
from skinnode.conformance.sdo import Aborted, expedited
from skinnode.conformance.tester import Failed
from skinnode.text.words import counted

NOT_MAPPABLE = (0x0602_0000, 0x0604_0041)
TOO_MUCH = (0x0602_0000, 0x0604_0041, 0x0604_0042)
OUT_OF_ORDER = (0x0601_0000, 0x0604_0041)

Fits = Callable[[EdsEntry], bool]


def _changeable(dut: Dut, pdos: list[Pdo]) -> list[Pdo]:
    """Return the PDOs that can be remapped. Raises NotApplicable if there are none."""
    found = []
    for pdo in pdos:
        count, cob_id = dut.eds.find(pdo.mapping, 0), dut.eds.find(pdo.parameter, 1)
        if count is not None and count.writable and cob_id is not None and cob_id.writable:
            found.append(pdo)
    if not found:
        raise NotApplicable("no PDO in the EDS has a mapping that can be written (0x1600, 0x1A00)")
    return found


def _candidate(dut: Dut, fits: Fits, lack: str) -> EdsEntry:
    for entry in dut.eds.entries.values():
        if 0 < entry.size <= 8 and fits(entry):
            return entry
    raise NotApplicable(f"the EDS has no {lack}")


def _any_for(dut: Dut, pdo: Pdo) -> EdsEntry:
    def fits(entry: EdsEntry) -> bool:
        return entry.into_tpdo if pdo.transmits else entry.into_rpdo

    return _candidate(dut, fits, f"object that may be mapped into {pdo}")


def _clear(dut: Dut, pdo: Pdo) -> int:
    """Begin remapping: disable the PDO, then its mapping. Return the previous COB-ID."""
    cob_id = disable(dut, pdo)
    dut.sdo.write_integer(pdo.mapping, 0, 0, 1)
    return cob_id


def _most_bytes(dut: Dut) -> int:
    """Return the maximum number of data bytes in a frame: 8, or 64 with CAN FD."""
    return 64 if dut.bus.fd else 8


def _slots(dut: Dut, pdo: Pdo) -> int:
    """Return the maximum number of mapping entries: the highest sub-index of the mapping in the EDS."""
    return max(entry.subindex for entry in dut.eds.between(pdo.mapping, pdo.mapping))


@case("PDO-21", "Default mappings contain mappable objects with the lengths in the EDS, and fit into a frame",
      "7.5.2.36, 7.5.2.38")  # fmt: skip
def default_mapping(dut: Dut) -> None:
    pdos = [*rpdos(dut), *tpdos(dut)]
    if not pdos:
        raise NotApplicable("the EDS has no PDO")
    for pdo in pdos:
        words = mapped(dut, pdo)
        if payload_bytes(words) > _most_bytes(dut):
            raise Failed(
                f"{pdo} with at most {counted(_most_bytes(dut), 'byte')}",
                counted(payload_bytes(words), "byte"),
            )
        for subindex, word in enumerate(words, 1):
            _check_mapped(dut, pdo, subindex, word)


def _check_mapped(dut: Dut, pdo: Pdo, subindex: int, word: int) -> None:
    where = f"0x{pdo.mapping:04X}:{subindex:02X}"
    if word < 0x0020_0000:  # a dummy entry: its index is a data type
        if pdo.transmits or word >> 16 not in dut.eds.dummies:
            raise Failed(f"{where} to contain an object or an allowed dummy", f"0x{word:08X}")
        return
    entry = dut.eds.find(word >> 16, word >> 8 & 0xFF)
    # The length of a mapped string is not checked.
    if entry is None or (entry.size and word & 0xFF != 8 * entry.size):
        raise Failed(f"{where} to contain an object of the EDS with its length", f"0x{word:08X}")
    if not (entry.into_tpdo if pdo.transmits else entry.into_rpdo):
        raise Failed(f"{where} to contain an object that may be mapped into {pdo}", str(entry))


@case("PDO-22", "After remapping by the standard procedure, a PDO has the new mapping and the new length",
      "7.5.2.36, 7.5.2.38")  # fmt: skip
def remap(dut: Dut) -> None:
    for pdo in _changeable(dut, [*rpdos(dut), *tpdos(dut)]):
        entry = _any_for(dut, pdo)
        cob_id = _clear(dut, pdo)
        dut.sdo.write_integer(pdo.mapping, 1, entry.mapping, 4)
        dut.sdo.write_integer(pdo.mapping, 0, 1, 1)
        if mapped(dut, pdo) != [entry.mapping]:
            raise Failed(f"{pdo} to map 0x{entry.mapping:08X}", str([f"0x{w:08X}" for w in mapped(dut, pdo)]))
        if cob_id & CAN_ID:
            dut.sdo.write_integer(pdo.parameter, 1, cob_id & ~INVALID, 4)
        if pdo.transmits and cob_id & CAN_ID:
            can_id = set_up(dut, pdo, PdoSetup(1))
            dut.operational()
            sync(dut)
            expect_pdo(dut, can_id, entry.size, f"{pdo}, remapped to {entry}, after SYNC")
        dut.prepare()


@case(
    "PDO-23", "A mapping entry cannot be written while the number of entries is not 0", "7.5.2.36, 7.5.2.38"
)
def entry_without_procedure(dut: Dut) -> None:
    tried = False
    for pdo in _changeable(dut, [*rpdos(dut), *tpdos(dut)]):
        words = mapped(dut, pdo)
        if not words:
            continue
        tried = True
        disable(dut, pdo)
        request = expedited(pdo.mapping, 1, words[0].to_bytes(4, "little"))
        what = f"{pdo}: write of mapping entry 1 while {len(words)} are in use"
        dut.sdo.aborts(request, pdo.mapping, 1, OUT_OF_ORDER, what)
        _still(dut, pdo, words)
    if not tried:
        raise NotApplicable("no PDO maps an object by default")


@case("PDO-24", "The mapping of a valid PDO cannot be written", "7.5.2.36, 7.5.2.38")
def mapping_of_valid(dut: Dut) -> None:
    tried = False
    for pdo in _changeable(dut, [*rpdos(dut), *tpdos(dut)]):
        if dut.sdo.integer(pdo.parameter, 1) & INVALID:
            continue
        tried = True
        words = mapped(dut, pdo)
        request = expedited(pdo.mapping, 0, b"\0")
        dut.sdo.aborts(
            request,
            pdo.mapping,
            0,
            OUT_OF_ORDER,
            f"{pdo}: write of the number of entries while the PDO is valid",
        )
        _still(dut, pdo, words)
    if not tried:
        raise NotApplicable("no PDO is valid by default")


def _still(dut: Dut, pdo: Pdo, words: list[int]) -> None:
    if mapped(dut, pdo) != words:
        raise Failed(f"{pdo} with its mapping unchanged", str([f"0x{word:08X}" for word in mapped(dut, pdo)]))


@case("PDO-25", "A mapping with more objects than the PDO has entries is refused", "7.5.2.36, 7.5.2.38")
def too_many(dut: Dut) -> None:
    for pdo in _changeable(dut, [*rpdos(dut), *tpdos(dut)]):
        entry = _any_for(dut, pdo)
        slots = _slots(dut, pdo)
        _clear(dut, pdo)
        for subindex in range(1, slots + 1):
            dut.sdo.write_integer(pdo.mapping, subindex, entry.mapping, 4)
        request = expedited(pdo.mapping, 0, bytes((slots + 1,)))
        dut.sdo.aborts(
            request, pdo.mapping, 0, TOO_MUCH, f"{pdo}: {slots + 1} mapping entries (maximum {slots})"
        )
        if dut.sdo.integer(pdo.mapping, 0):
            raise Failed(f"{pdo} still without entries", str(dut.sdo.integer(pdo.mapping, 0)))


@case("PDO-26", "A mapping with more bits than fit into a frame is refused", "7.5.2.36, 7.5.2.38")
def too_long(dut: Dut) -> None:
    tried = False
    for pdo in _changeable(dut, [*rpdos(dut), *tpdos(dut)]):
        sizes = [e for e in dut.eds.entries.values() if 0 < e.size <= 8 and _fits(e, pdo)]
        entry = max(sizes, key=lambda e: e.size, default=None)
        count = _most_bytes(dut) // entry.size + 1 if entry is not None else 0
        if entry is None or count > _slots(dut, pdo):
            continue
        tried = True
        _clear(dut, pdo)
        try:
            for subindex in range(1, count + 1):
                dut.sdo.write_integer(pdo.mapping, subindex, entry.mapping, 4)
        except Aborted as abort:
            if abort.code in TOO_MUCH:
                continue  # a device may refuse the entry that no longer fits
            raise
        request = expedited(pdo.mapping, 0, bytes((count,)))
        what = f"{pdo}: mapping of {count} × {8 * entry.size} bits"
        dut.sdo.aborts(request, pdo.mapping, 0, TOO_MUCH, what)
    if not tried:
        raise NotApplicable("no PDO can map more objects than fit into a frame")


def _fits(entry: EdsEntry, pdo: Pdo) -> bool:
    return entry.into_tpdo if pdo.transmits else entry.into_rpdo


def _accepts(dut: Dut, pdos: list[Pdo], fits: Fits, lack: str) -> None:
    for pdo, word in _each(dut, pdos, fits, lack):
        dut.sdo.write_integer(pdo.mapping, 1, word, 4)
        dut.sdo.write_integer(pdo.mapping, 0, 1, 1)
        if mapped(dut, pdo) != [word]:
            raise Failed(f"{pdo} to map 0x{word:08X}", "another mapping")


def _refuses(dut: Dut, pdos: list[Pdo], fits: Fits, lack: str) -> None:
    """Check that the device refuses an invalid mapping.

    The device may abort either the write of the entry or the subsequent write of the number of entries.
    """
    for pdo, word in _each(dut, pdos, fits, lack):
        what = f"{pdo}: mapping of 0x{word:08X}"
        request = expedited(pdo.mapping, 1, word.to_bytes(4, "little"))
        answer = dut.sdo.ask(request, what)
        if answer[0] == 0x80:
            dut.sdo.check_abort(answer, pdo.mapping, 1, NOT_MAPPABLE, what)
        else:
            dut.sdo.aborts(expedited(pdo.mapping, 0, b"\x01"), pdo.mapping, 0, NOT_MAPPABLE, what)


def _each(dut: Dut, pdos: list[Pdo], fits: Fits, lack: str) -> Iterator[tuple[Pdo, int]]:
    found = _changeable(dut, pdos)
    entry = _candidate(dut, fits, lack)
    for pdo in found:
        _clear(dut, pdo)
        yield pdo, entry.mapping


def _output(entry: EdsEntry) -> bool:
    return entry.mappable and entry.access in ("wo", "rww")


def _input(entry: EdsEntry) -> bool:
    return entry.mappable and entry.access in ("ro", "rwr")


def _unmappable(entry: EdsEntry) -> bool:
    return not entry.mappable and entry.index >= 0x1000


@case("PDO-27", "Process output (rww, wo) can be mapped into an RPDO", "7.5.2.36; CiA 306-1")
def output_received(dut: Dut) -> None:
    _accepts(dut, rpdos(dut), _output, "mappable object with access rww or wo")


@case("PDO-28", "Process input (rwr, ro) cannot be mapped into an RPDO", "7.5.2.36; CiA 306-1")
def input_received(dut: Dut) -> None:
    _refuses(dut, rpdos(dut), _input, "mappable object with access rwr or ro")


@case("PDO-29", "An object that is not mappable cannot be mapped into an RPDO", "7.5.2.36; CiA 306-1")
def unmappable_received(dut: Dut) -> None:
    _refuses(
        dut, rpdos(dut), lambda e: _unmappable(e) and e.writable, "writable object that cannot be mapped"
    )


@case("PDO-30", "Process input (rwr, ro) can be mapped into a TPDO", "7.5.2.38; CiA 306-1")
def input_transmitted(dut: Dut) -> None:
    _accepts(dut, tpdos(dut), _input, "mappable object with access rwr or ro")


@case("PDO-31", "Process output (rww, wo) cannot be mapped into a TPDO", "7.5.2.38; CiA 306-1")
def output_transmitted(dut: Dut) -> None:
    _refuses(dut, tpdos(dut), _output, "mappable object with access rww or wo")


@case("PDO-32", "An object that is not mappable cannot be mapped into a TPDO", "7.5.2.38; CiA 306-1")
def unmappable_transmitted(dut: Dut) -> None:
    _refuses(dut, tpdos(dut), _unmappable, "object that cannot be mapped")


@case("PDO-33", "A dummy entry allowed by the EDS can be mapped into an RPDO", "7.5.2.36; CiA 306-1")
def dummy(dut: Dut) -> None:
    if not dut.eds.dummies:
        raise NotApplicable("the EDS does not allow dummy entries (section DummyUsage)")
    bits = {0x1: 1, 0x2: 8, 0x3: 16, 0x4: 32, 0x5: 8, 0x6: 16, 0x7: 32}
    for pdo in _changeable(dut, rpdos(dut)):
        for kind in sorted(dut.eds.dummies & bits.keys()):
            _clear(dut, pdo)
            dut.sdo.write_integer(pdo.mapping, 1, kind << 16 | bits[kind], 4)
            dut.sdo.write_integer(pdo.mapping, 0, 1, 1)
