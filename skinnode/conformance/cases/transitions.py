"""Conformance cases TRANS-01 to TRANS-04: NMT state transitions on reset, pre-operational, start and stop."""

from __future__ import annotations

from skinnode.conformance.case import case
from skinnode.conformance.cases.sdo import limited
from skinnode.conformance.dut import (
    HEARTBEAT,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Dut,
)
from skinnode.conformance.eds_reader import UNSIGNED, EdsEntry
from skinnode.conformance.sdo import Aborted
from skinnode.conformance.tester import Failed

_COMMANDS = {PRE_OPERATIONAL: 127, START: 5, STOP: 4}
_NAMES = {PRE_OPERATIONAL: "enter pre-operational", START: "start", STOP: "stop"}


def _application_object(dut: Dut) -> tuple[EdsEntry, bytes] | None:
    """Change one object from 0x2000 to 0x9FFF; return its entry and old value, or None if impossible."""
    for entry in dut.eds.between(0x2000, 0x9FFF):
        if not (entry.readable and entry.writable and entry.data_type in UNSIGNED and entry.size <= 4):
            continue
        before = dut.sdo.read(entry.index, entry.subindex)
        value = int.from_bytes(before, "little") ^ 1
        if limited(entry, value, 0) is None or (entry.low is not None and value < entry.low):
            continue
        try:
            dut.sdo.write_integer(entry.index, entry.subindex, value, entry.size)
        except Aborted:
            continue
        if dut.sdo.integer(entry.index, entry.subindex) == value:
            return entry, before
        dut.sdo.write(entry.index, entry.subindex, before)
    return None


@case(
    "TRANS-01",
    "NMT resets work in every state; a communication reset keeps application parameters",
    "7.3.2.2.1",
)
def resets(dut: Dut) -> None:
    for reset in (RESET_NODE, RESET_COMMUNICATION):
        for command in _COMMANDS:
            dut.nmt(command)
            dut.reset(reset)
            period_ms = dut.sdo.integer(HEARTBEAT) if dut.eds.find(HEARTBEAT) is not None else 0
            if period_ms == 20:
                raise Failed("0x1017 to be restored by the reset", "20")
            dut.start_heartbeat()
            dut.expect_state(127, f"reset after {_NAMES[command]}")
    changed = _application_object(dut)
    if changed is None:
        return
    entry, before = changed
    written = dut.sdo.read(entry.index, entry.subindex)
    for reset, wanted, what in (
        (RESET_COMMUNICATION, written, "after a communication reset"),
        (RESET_NODE, before, "after reset node"),
    ):
        dut.reset(reset)
        now = dut.sdo.read(entry.index, entry.subindex)
        if now != wanted:
            raise Failed(f"{entry} = {wanted.hex(' ').upper()} {what}", now.hex(" ").upper())


def _transition(dut: Dut, command: int, *others: int) -> None:
    """Check that ``command``, sent to this node or to all nodes, works in the states set by ``others``."""
    state, name = _COMMANDS[command], _NAMES[command]
    dut.start_heartbeat()
    for other in others:
        for node_id in (dut.node_id, 0):
            dut.nmt(other)
            dut.expect_state(_COMMANDS[other], f"after {_NAMES[other]}")
            dut.bus.send(0x000, bytes((command, dut.node_id % 127 + 1)))
            dut.bus.send(0x000, bytes((command,)))
            dut.bus.send(0x000, bytes((0x7F, dut.node_id)))
            dut.expect_state(
                _COMMANDS[other], "after NMT commands that are invalid or addressed to another node"
            )
            dut.bus.send(0x000, bytes((command, node_id)))
            dut.expect_state(state, f"{name} (node-ID {node_id}) after {_NAMES[other]}")
    dut.nmt(command)
    dut.expect_state(state, f"{name} twice")


@case(
    "TRANS-02",
    "NMT enter pre-operational, to the node or to all nodes, works in OPERATIONAL and STOPPED",
    "7.2.8.2.1, 7.3.2.2",
)
def enter_pre_operational(dut: Dut) -> None:
    _transition(dut, PRE_OPERATIONAL, START, STOP)


@case(
    "TRANS-03",
    "NMT start, to the node or to all nodes, works in PRE-OPERATIONAL and STOPPED",
    "7.2.8.2.1, 7.3.2.2",
)
def start(dut: Dut) -> None:
    _transition(dut, START, PRE_OPERATIONAL, STOP)


@case(
    "TRANS-04",
    "NMT stop, to the node or to all nodes, works in PRE-OPERATIONAL and OPERATIONAL",
    "7.2.8.2.1, 7.3.2.2",
)
def stop(dut: Dut) -> None:
    _transition(dut, STOP, PRE_OPERATIONAL, START)
