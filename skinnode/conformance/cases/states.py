"""Conformance cases STATE-01 to STATE-04: boot-up message, and services available in each NMT state."""

from __future__ import annotations

import contextlib

from skinnode.conformance.case import NotApplicable, case
from skinnode.conformance.cases.guarding import guarded
from skinnode.conformance.cases.sync import consume_only, produce
from skinnode.conformance.configuration import read_configuration
from skinnode.conformance.dut import GUARD_TIME, HEARTBEAT, PRE_OPERATIONAL, STOP, Dut
from skinnode.conformance.pdo import (
    SYNC_ID,
    PdoSetup,
    Unsupported,
    disable,
    drain,
    mapped,
    payload_bytes,
    set_up,
    sync,
    tpdos,
)
from skinnode.conformance.provoked_errors import COMMUNICATION_LOST, expect_emcy, lose_partner
from skinnode.conformance.sdo import mux
from skinnode.conformance.tester import QUIET_S, Failed, describe
from skinnode.text.words import counted

_BEHAVIOUR = 0x1029
_EVENT_MS = 20


@case(
    "STATE-01",
    "The reset node command causes one boot-up message and restores every parameter",
    "7.3.2.2.1, 7.2.8.3.3",
)
def boot_up(dut: Dut) -> None:
    dut.reset()
    dut.bus.expect_silence(dut.error_control_id, "second boot-up message")
    before = read_configuration(dut)
    changed = 0
    for (index, subindex), value in before.items():
        if index >= 0x2000:
            continue
        other = bytes(byte ^ 0x5A for byte in value)
        request = bytes((0x23 | (4 - len(other)) << 2,)) + mux(index, subindex) + other
        if len(other) <= 4:
            # The device may refuse a value; if it accepts one, the reset must discard it.
            changed += dut.sdo.ask(request, f"write to 0x{index:04X}:{subindex:02X}")[0] == 0x60
    if not changed:
        raise Failed("at least one parameter from 0x1000 to 0x1FFF that can be changed", "none")
    dut.reset()
    _check_state(dut, 127, "after a node reset")
    for (index, subindex), value in before.items():
        if index < 0x2000:
            now = dut.sdo.read(index, subindex)
            if now != value:
                raise Failed(
                    f"0x{index:04X}:{subindex:02X} = {value.hex(' ')} after a node reset", now.hex(" ")
                )


def _check_state(dut: Dut, state: int, what: str) -> None:
    """Check the NMT state in heartbeats and guarding responses, if the device supports them."""
    dut.start_heartbeat()
    dut.expect_state(state, what)
    if dut.eds.find(HEARTBEAT) is not None:
        dut.sdo.write_integer(HEARTBEAT, 0, 0, 2)
        dut.bus.pending(dut.error_control_id)
    if dut.eds.find(GUARD_TIME) is not None:
        guarded(dut, state, None, what)


@case("STATE-02", "PRE-OPERATIONAL: SDO, EMCY, SYNC and error control work, but PDOs do not", "7.3.2.2.2")
def pre_operational(dut: Dut) -> None:
    _check_state(dut, 127, "after a reset")
    dut.sdo.read(0x1000)
    with contextlib.suppress(NotApplicable):  # a producer is optional
        produce(dut)
        dut.bus.expect(SYNC_ID, "SYNC from the producer in PRE-OPERATIONAL")
        consume_only(dut)
    _no_pdos(dut, "PRE-OPERATIONAL")
    _emcy(dut, "in PRE-OPERATIONAL")


def _timed(dut: Dut) -> dict[int, int]:
    """Set the event timer of all TPDOs to 20 ms; return the length of each TPDO in bytes, keyed by CAN-ID."""
    found = {}
    for pdo in tpdos(dut):
        if not mapped(dut, pdo):
            continue
        try:
            found[set_up(dut, pdo, PdoSetup(254, event_ms=_EVENT_MS))] = payload_bytes(mapped(dut, pdo))
        except Unsupported:
            disable(dut, pdo)
    return found


def _no_pdos(dut: Dut, state: str) -> None:
    """Check that neither the event timer nor a SYNC triggers a TPDO."""
    can_ids = _timed(dut) if state == "PRE-OPERATIONAL" else {}
    sync(dut)
    for can_id in can_ids:
        dut.bus.expect_silence(can_id, f"TPDO in {state}", 3 * _EVENT_MS * 1e-3)


def _emcy(dut: Dut, what: str) -> None:
    try:
        lose_partner(dut)
    except NotApplicable:
        return
    expect_emcy(dut, COMMUNICATION_LOST, f"when a heartbeat is missing {what}")


@case(
    "STATE-03",
    "OPERATIONAL: SDO, PDO and EMCY work; 0x1029 sets the reaction to a communication error",
    "7.3.2.2.3, 7.5.2.32",
)
def operational(dut: Dut) -> None:
    can_ids = _timed(dut)
    dut.operational()
    _check_state(dut, 5, "after start")
    dut.sdo.read(0x1000)
    for can_id, length in can_ids.items():
        frame = dut.bus.expect(can_id, f"a TPDO every {_EVENT_MS} ms in OPERATIONAL")
        if len(frame.data) != length:
            raise Failed(f"a TPDO of {counted(length, 'byte')}", describe(frame))
    entry = dut.eds.find(_BEHAVIOUR, 1)
    behaviours = (0, 1, 2) if entry is not None and entry.writable else (0,)
    for behaviour in behaviours:
        dut.prepare()
        if entry is not None and entry.writable:
            dut.sdo.write_integer(_BEHAVIOUR, 1, behaviour, 1)
        dut.start_heartbeat()
        dut.operational()
        dut.expect_state(5, "after start")
        _emcy(dut, "in OPERATIONAL")
        wanted = {0: 127, 1: 5, 2: 4}[behaviour]
        dut.expect_state(wanted, f"with 0x1029:01 = {behaviour}")


@case("STATE-04", "STOPPED: error control works; SDO, PDO, SYNC and EMCY do not", "7.3.2.2.4")
def stopped(dut: Dut) -> None:
    can_ids = _timed(dut)
    dut.start_heartbeat()
    with contextlib.suppress(NotApplicable):  # a producer is optional
        produce(dut)
    dut.operational()
    dut.nmt(STOP)
    dut.expect_state(4, "after stop")
    dut.bus.pending(SYNC_ID)
    for can_id in can_ids:
        drain(dut, can_id)
    dut.sdo.send(b"\x40\x00\x10\x00")
    dut.bus.expect_silence(dut.sdo.answer_id, "SDO response in STOPPED")
    dut.bus.expect_silence(SYNC_ID, "SYNC from the producer in STOPPED")
    sync(dut)
    for can_id in can_ids:
        dut.bus.expect_silence(can_id, "TPDO in STOPPED")
    _no_emcy(dut)
    dut.expect_state(4, "in STOPPED")
    dut.nmt(PRE_OPERATIONAL)
    dut.expect_state(127, "after enter pre-operational")
    if dut.bus.take(dut.sdo.answer_id, QUIET_S) is not None:
        raise Failed("no late response to an SDO request sent in STOPPED", "a response")
    dut.sdo.read(0x1000)


def _no_emcy(dut: Dut) -> None:
    """Check that an RPDO without data (an error only in OPERATIONAL) triggers no emergency message."""
    dut.bus.pending(dut.emcy_id)
    dut.bus.send(0x200 + dut.node_id)
    dut.bus.expect_silence(dut.emcy_id, "emergency message in STOPPED")
