"""What the cases store and restore is put back: the configuration that a node was found with."""

from __future__ import annotations

import struct

import pytest

from skinnode.conformance import Case, Dut, Result, Verdict, run_cases, select

FOUND = {
    (0x1005, 0): struct.pack("<I", 0x90),
    (0x1006, 0): struct.pack("<I", 5_000_000),
    (0x1014, 0): struct.pack("<I", 0x85),
    (0x1015, 0): struct.pack("<H", 7),
    (0x1016, 2): struct.pack("<I", 0x33 << 16 | 500),
    (0x1019, 0): b"\x0a",
    (0x1800, 1): struct.pack("<I", 0x1A4),
    (0x1800, 3): struct.pack("<H", 20),
    (0x1A01, 0): b"\x02",
    (0x1A01, 1): struct.pack("<I", 0x20110408 + 0x18),
    (0x1A01, 2): struct.pack("<I", 0x20110108),
    (0x2020, 2): struct.pack("<H", 9),
}
"""A configuration that is not the default one."""


def configure(dut: Dut) -> None:
    write, off = dut.sdo.write, (1 << 31).to_bytes(4, "little")
    write(0x1019, 0, FOUND[0x1019, 0])
    write(0x1014, 0, off)
    write(0x1801, 1, struct.pack("<I", 1 << 31 | 0x284))
    write(0x1A01, 0, b"\0")
    for key in ((0x1A01, 1), (0x1A01, 2), (0x1A01, 0)):
        write(*key, FOUND[key])
    write(0x1801, 1, struct.pack("<I", 0x284))
    write(0x1800, 1, struct.pack("<I", 1 << 31 | 0x1A4))
    for key in FOUND.keys() - {(0x1019, 0)}:
        if key[0] != 0x1A01 and key != (0x1800, 1):
            write(*key, FOUND[key])
    write(0x1800, 1, FOUND[0x1800, 1])
    write(0x1010, 1, b"save")
    dut.prepare()


@pytest.mark.long
def test_a_stored_configuration_is_found_again(dut: Dut) -> None:
    configure(dut)
    before = {key: dut.sdo.read(*key) for key in FOUND}
    assert before == FOUND
    report = run_cases(dut, select(("OTHER-02", "OTHER-04", "OTHER-08", "SYNC-10")))
    assert [result.verdict for result in report.results] == [Verdict.PASSED] * 4
    assert report.problems == ()
    dut.prepare()
    assert {key: dut.sdo.read(*key) for key in FOUND} == FOUND


def test_an_interrupted_run_resets_the_node(dut: Dut) -> None:
    def interrupt(result: Result) -> None:
        raise KeyboardInterrupt

    case = Case("HB-00", "leaves a heartbeat", "none", lambda dut: dut.start_heartbeat())
    with pytest.raises(KeyboardInterrupt):
        run_cases(dut, [case], interrupt)
    assert dut.sdo.integer(0x1017) == 0


def test_a_restoration_that_is_interrupted_is_done_again(dut: Dut, monkeypatch: pytest.MonkeyPatch) -> None:
    configure(dut)
    interrupted: list[bool] = []
    write = dut.sdo.write

    def write_until_interrupted(index: int, subindex: int, data: bytes) -> None:
        if index == 0x1015 and not interrupted:
            interrupted.append(True)
            raise KeyboardInterrupt
        write(index, subindex, data)

    monkeypatch.setattr(dut.sdo, "write", write_until_interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_cases(dut, [Case("OD-00", "restores the defaults", "none", lambda dut: dut.to_defaults())])
    dut.prepare()
    assert {key: dut.sdo.read(*key) for key in FOUND} == FOUND


def test_a_pdo_without_a_can_id_is_not_enabled(dut: Dut) -> None:
    """With the CAN-ID 0, it would be an NMT command to other nodes."""
    for parameter in (0x1800, 0x1801):
        dut.sdo.write(parameter, 1, struct.pack("<I", 1 << 31))
    dut.sdo.write(0x1010, 1, b"save")
    results = run_cases(dut, select(("PDO-06", "SYNC-03"))).results
    assert [result.verdict for result in results] == [Verdict.NOT_APPLICABLE] * 2
    assert "TPDO1 has no CAN-ID" in results[0].why
    written = [
        int.from_bytes(line.data[4:], "little")
        for result in results
        for line in result.trace
        if line.sent and line.data[:4] in (b"\x23\x00\x18\x01", b"\x23\x01\x18\x01")
    ]
    assert written
    assert all(cob_id >> 31 for cob_id in written)
