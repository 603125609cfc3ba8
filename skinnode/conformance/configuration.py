"""Reads the configuration of the device before a run, and restores it afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from skinnode.conformance.dut import RESTORE, STORE, Dut
from skinnode.conformance.tester import Failed

Values = Mapping[tuple[int, int], bytes]

_SYNC, _PERIOD, _SYNC_COUNTER, _EMCY, _VERIFY = 0x1005, 0x1006, 0x1019, 0x1014, 0x1020
_COMMANDS: Final = (0x1003, STORE, RESTORE)
_PDO_PARAMETERS: Final = (*range(0x1400, 0x1600), *range(0x1800, 0x1A00))
_MAPPINGS: Final = (*range(0x1600, 0x1800), *range(0x1A00, 0x1C00))
_INVALID: Final = 1 << 31
_LAST: Final = {_SYNC_COUNTER: 1, _PERIOD: 2, _SYNC: 3, _VERIFY: 4}
"""Objects to write after all others, in this order. The SYNC counter overflow value can be written only while
the SYNC period (0x1006) is 0. Writing 0x1005 may start the SYNC producer. 0x1020 comes last, because writing
any other object clears it."""


def read_configuration(dut: Dut) -> dict[tuple[int, int], bytes]:
    """Read all fixed-length rw objects, except 0x1003, 0x1010 and 0x1011."""
    values: dict[tuple[int, int], bytes] = {}
    for entry in dut.eds.between(0x1000, 0x9FFF):
        if entry.index in _COMMANDS or not entry.size or not (entry.readable and entry.writable):
            continue
        try:
            values[entry.index, entry.subindex] = dut.sdo.read(entry.index, entry.subindex)
        except Failed:
            continue  # reported by the OD cases
    return values


def write_back(dut: Dut, before: Values) -> list[str]:
    """Restore the original configuration after a case that stored or restored parameters.

    The function restores the defaults, writes all original values that differ from them, and stores the
    parameters. The caller must reset the node first.

    Args:
        dut: The device.
        before: Original values, keyed by index and sub-index.

    Returns:
        One line for each value that could not be written.
    """
    problems: list[str] = []
    if dut.eds.find(RESTORE, 1) is not None:
        _try(problems, dut, RESTORE, 1, b"load")
        dut.prepare()
    now = read_configuration(dut)
    changed = {key: value for key, value in before.items() if now.get(key) != value}
    if not changed:
        return problems
    pdos = {_parameter_of(index) for index, _ in changed} - {0}
    for parameter in sorted(pdos):
        _write_pdo(problems, dut, parameter, before)
    if _SYNC_COUNTER in {index for index, _ in changed}:
        _try(problems, dut, _SYNC, 0, (0x80).to_bytes(4, "little"))
        _try(problems, dut, _PERIOD, 0, bytes(4))
        changed |= {(i, 0): before[i, 0] for i in (_SYNC, _PERIOD) if (i, 0) in before}
    rest = [key for key in changed if not _parameter_of(key[0])]
    for index, subindex in sorted(rest, key=lambda key: (_LAST.get(key[0], 0), key)):
        if index == _EMCY:
            _try(problems, dut, index, subindex, _disabled(before[index, subindex]))
        _try(problems, dut, index, subindex, before[index, subindex])
    if dut.eds.find(STORE, 1) is not None:
        _try(problems, dut, STORE, 1, b"save")
    return problems


def _parameter_of(index: int) -> int:
    """Return the communication parameter of the PDO to which ``index`` belongs; 0 if it belongs to no PDO."""
    if index in _MAPPINGS:
        return index - 0x200
    return index if index in _PDO_PARAMETERS else 0


def _write_pdo(problems: list[str], dut: Dut, parameter: int, before: Values) -> None:
    mapping = parameter + 0x200
    cob_id, count = before.get((parameter, 1)), before.get((mapping, 0))
    if cob_id is None:
        return
    _try(problems, dut, parameter, 1, _disabled(cob_id))
    if count is not None:
        _try(problems, dut, mapping, 0, b"\0")
        for (index, subindex), value in before.items():
            if index == mapping and 0 < subindex <= count[0]:
                _try(problems, dut, mapping, subindex, value)
        _try(problems, dut, mapping, 0, count)
    for (index, subindex), value in before.items():
        if index == parameter and subindex > 1:
            _try(problems, dut, parameter, subindex, value)
    _try(problems, dut, parameter, 1, cob_id)


def _disabled(cob_id: bytes) -> bytes:
    return (int.from_bytes(cob_id, "little") | _INVALID).to_bytes(4, "little")


def _try(problems: list[str], dut: Dut, index: int, subindex: int, value: bytes) -> None:
    try:
        dut.sdo.write(index, subindex, value)
    except Failed as failure:
        problems.append(f"0x{index:04X}:{subindex:02X} could not be restored: {failure}")
