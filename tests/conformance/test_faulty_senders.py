"""The suite can fail: nodes with a fault in what they send. The case for it fails, the others run."""

from __future__ import annotations

import pytest

from skinnode.conformance import Verdict

from .faulty import ANSWER, CHUNK, EMCY, ERROR_CONTROL, SUMMARY, SYNC, Alter, expected, faulty, found

pytestmark = pytest.mark.usefixtures("impatient")


def flip_toggle(can_id: int, data: bytes) -> bytes:
    """Upload segments with the toggle bit the wrong way round."""
    segment = can_id == ANSWER and data[0] & 0xE0 == 0
    return bytes((data[0] ^ 0x10,)) + data[1:] if segment else data


def abort_with(code: int) -> Alter:
    """Every abort carries ``code``."""

    def alter(can_id: int, data: bytes) -> bytes:
        return data[:4] + code.to_bytes(4, "little") if can_id == ANSWER and data[0] == 0x80 else data

    return alter


def abort_names_another_object(can_id: int, data: bytes) -> bytes:
    return data[:1] + b"\xff\xff" + data[3:] if can_id == ANSWER and data[0] == 0x80 else data


def other_device_type(can_id: int, data: bytes) -> bytes:
    """0x1000 reads 0x191, the EDS says 0."""
    return data[:4] + b"\x91\x01\0\0" if can_id == ANSWER and data[:4] == b"\x43\0\x10\0" else data


def confirm_read_only(can_id: int, data: bytes) -> bytes:
    """Writes to what is read-only are confirmed."""
    refused = can_id == ANSWER and data[0] == 0x80 and data[4:] == b"\x02\0\x01\x06"
    return b"\x60" + data[1:4] + bytes(4) if refused else data


def wrong_crc(can_id: int, data: bytes) -> bytes:
    """The end of a block upload carries another CRC."""
    end = can_id == ANSWER and data[0] & 0xE3 == 0xC1 and data[3:] == bytes(5)
    return data[:1] + bytes((data[1] ^ 1,)) + data[2:] if end else data


def no_boot_up(can_id: int, data: bytes) -> bytes | None:
    return None if can_id == ERROR_CONTROL and data == b"\0" else data


def heartbeat_says_operational(can_id: int, data: bytes) -> bytes:
    return b"\x05" if can_id == ERROR_CONTROL and data != b"\0" else data


def stuck_guard_toggle(can_id: int, data: bytes) -> bytes:
    return bytes((data[0] & 0x7F,)) if can_id == ERROR_CONTROL else data


def no_emcy(can_id: int, data: bytes) -> bytes | None:
    return None if can_id == EMCY else data


def other_emcy_register(can_id: int, data: bytes) -> bytes:
    return data[:2] + b"\x81" + data[3:] if can_id == EMCY else data


def counter_from_0(can_id: int, data: bytes) -> bytes:
    return bytes((data[0] - 1,)) if can_id == SYNC and data else data


def every_pdo_twice(can_id: int, data: bytes) -> list[bytes]:
    return [data, data] if can_id in (CHUNK, SUMMARY) else [data]


def pdos_a_byte_short(can_id: int, data: bytes) -> bytes:
    return data[:-1] if can_id in (CHUNK, SUMMARY) else data


@pytest.mark.parametrize(
    ("alter", "fail", "pass_"),
    [
        (flip_toggle, "SDO-18 OD-01", "SDO-01 SDO-05 SDO-15"),
        (abort_with(0x0504_0005), "SDO-03 SDO-05 SDO-06 SDO-07 SDO-17 OD-03 SYNC-05", "SDO-18"),
        (abort_with(0x0800_0000), "", "SDO-03 SDO-05 SDO-06 SDO-07 OD-03"),
        (abort_names_another_object, "SDO-03 SDO-05 SDO-06", "SDO-01 SDO-02"),
        (other_device_type, "SDO-01", "SDO-02 OD-01"),
        (confirm_read_only, "SDO-03 OD-03", "SDO-05 OD-06"),
        (wrong_crc, "SDO-23", "SDO-19 SDO-22"),
        (no_boot_up, "STATE-01 TRANS-01", "SDO-01 HB-01 TRANS-02"),
        (heartbeat_says_operational, "HB-02 HBVG-04 TRANS-02 TRANS-04", "HB-01 HB-03"),
        (stuck_guard_toggle, "GUARD-03 HBVG-03", "GUARD-02 HB-02"),
        (no_emcy, "EMCY-04 EMCY-06 HB-06", "EMCY-01 EMCY-02 HB-05"),
        (other_emcy_register, "EMCY-05", "EMCY-04 EMCY-06"),
        (counter_from_0, "SYNC-07", "SYNC-02 SYNC-06"),
        (every_pdo_twice, "PDO-03 PDO-04 SYNC-03", "PDO-06 PDO-12"),
        (pdos_a_byte_short, "PDO-03 PDO-05 PDO-06 SYNC-03", "PDO-12 PDO-21"),
    ],
)
def test_what_is_sent(alter: Alter, fail: str, pass_: str) -> None:
    with faulty(alter) as dut:
        assert found(dut, *fail.split(), *pass_.split()) == expected(fail, pass_)


def test_the_phase_of_a_cyclic_tpdo_is_the_devices_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Type 3 is every third SYNC, from whichever on: a device may send at the first, or count from an earlier
    one. What it may not do is to change its step."""
    from skinnode.node.pdo.tpdo import Tpdo

    counted = Tpdo.turn
    monkeypatch.setattr(Tpdo, "phase", 2, raising=False)
    monkeypatch.setattr(Tpdo, "first", True, raising=False)

    def turn(tpdo: Tpdo, counter: int | None) -> bool:
        if tpdo.first:
            tpdo.first = False
            tpdo._syncs = min(Tpdo.phase, tpdo.parameters.kind - 1)
        return counted(tpdo, counter)

    def start(tpdo: Tpdo, t_ns: int) -> None:
        started(tpdo, t_ns)
        tpdo.first = True

    started = Tpdo.start
    monkeypatch.setattr(Tpdo, "turn", turn)
    monkeypatch.setattr(Tpdo, "start", start)
    for phase in (1, 2):
        monkeypatch.setattr(Tpdo, "phase", phase)
        with faulty() as dut:
            assert found(dut, "PDO-06") == expected("", "PDO-06")
    monkeypatch.setattr(Tpdo, "turn", lambda tpdo, counter: counted(tpdo, None) or tpdo.parameters.kind == 3)
    with faulty() as dut:
        assert found(dut, "PDO-06") == expected("PDO-06", "")


def test_a_node_that_starts_by_itself_fails_where_that_is_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """And nowhere else: the other cases put it into PRE-OPERATIONAL first."""
    from skinnode.canopen.nmt import NmtState
    from skinnode.node.device import CanopenDevice

    reset = CanopenDevice._reset

    def reset_and_start(device: CanopenDevice, objects: tuple[int, int], t_ns: int) -> None:
        reset(device, objects, t_ns)
        device._enter(NmtState.OPERATIONAL, t_ns)
        for can_id in (CHUNK, SUMMARY):  # as an event-driven TPDO that tells of the start
            device._send(can_id, bytes(8))

    monkeypatch.setattr(CanopenDevice, "_reset", reset_and_start)
    with faulty() as dut:
        verdicts = found(dut, "HB-02", "STATE-01", "STATE-02", "TRANS-01", "PDO-06", "PDO-07", "PDO-15")
    assert verdicts["PDO-15"] is not Verdict.FAILED
    del verdicts["PDO-15"]
    assert verdicts == expected("STATE-01 TRANS-01", "HB-02 STATE-02 PDO-06 PDO-07")
