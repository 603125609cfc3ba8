"""Helpers for PDO cases: list, configure, trigger and receive the PDOs of the device under test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.conformance.case import NotApplicable
from skinnode.conformance.dut import Dut
from skinnode.conformance.sdo import Aborted
from skinnode.conformance.tester import Failed, describe
from skinnode.process import clock
from skinnode.text.words import counted
from skinnode.transport import Frame

INVALID: Final = 1 << 31
NO_REMOTE: Final = 1 << 30
CAN_ID: Final = 0x7FF
COB_ID, KIND, INHIBIT, EVENT_TIMER, SYNC_START = 1, 2, 3, 5, 6
"""Sub-indices of the PDO communication parameter."""

SYNC_ID: Final = 0x80

_UNSUPPORTED: Final = (0x0609_0030, 0x0609_0031, 0x0604_0043, 0x0601_0002, 0x0800_0000)
_PAUSE_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Pdo:
    """PDO, identified by the index of its communication parameter (0x1400, 0x1800 or above)."""

    parameter: int

    @property
    def mapping(self) -> int:
        """Index of the PDO's mapping parameter."""
        return self.parameter + 0x200

    @property
    def transmits(self) -> bool:
        """Whether the PDO is a TPDO."""
        return self.parameter >= 0x1800

    def __str__(self) -> str:
        return f"{'TPDO' if self.transmits else 'RPDO'}{self.parameter % 0x200 + 1}"


class Unsupported(NotApplicable):
    """Raised if a PDO does not support an optional sub-index, a transmission type or remote frames."""


def rpdos(dut: Dut) -> list[Pdo]:
    """Return the RPDOs in the EDS."""
    return [Pdo(index) for index in dut.eds.indices(0x1400, 0x15FF)]


def tpdos(dut: Dut) -> list[Pdo]:
    """Return the TPDOs in the EDS."""
    return [Pdo(index) for index in dut.eds.indices(0x1800, 0x19FF)]


def sync(dut: Dut, counter: int | None = None) -> int:
    """Send a SYNC; return the time of transmission (monotonic clock, ns)."""
    return dut.bus.send(SYNC_ID, b"" if counter is None else bytes((counter,)))


def disable(dut: Dut, pdo: Pdo) -> int:
    """Disable a PDO by setting bit 31 of its COB-ID; return the previous COB-ID."""
    cob_id = dut.sdo.integer(pdo.parameter, COB_ID)
    dut.sdo.write_integer(pdo.parameter, COB_ID, cob_id | INVALID, 4)
    return cob_id


def mapped(dut: Dut, pdo: Pdo) -> list[int]:
    """Read the mapping entries of a PDO."""
    count = dut.sdo.integer(pdo.mapping, 0)
    return [dut.sdo.integer(pdo.mapping, subindex) for subindex in range(1, count + 1)]


def payload_bytes(entries: list[int]) -> int:
    """Return the length of a PDO with these mapping entries, in bytes."""
    return sum(entry & 0xFF for entry in entries) // 8


@dataclass(frozen=True, slots=True)
class PdoSetup:
    """Communication parameters of a PDO."""

    kind: int
    """Transmission type."""
    event_ms: int = 0
    inhibit_100us: int = 0
    start: int = 0
    """SYNC start value."""
    remote: bool = False
    """Whether to allow remote frames by clearing bit 30 of the COB-ID."""


def set_up(dut: Dut, pdo: Pdo, parameters: PdoSetup) -> int:
    """Disable a PDO, write its communication parameters and enable it again.

    Frames of the PDO that arrived earlier, for example from a self-starting node, are discarded.

    Args:
        dut: The device.
        pdo: The PDO.
        parameters: Its new communication parameters.

    Returns:
        The CAN-ID of the PDO.

    Raises:
        Unsupported: The device refuses a parameter, or the PDO has no CAN-ID.
    """
    cob_id = disable(dut, pdo)
    if not cob_id & CAN_ID:  # the PDO would be sent with the CAN-ID of NMT commands
        raise Unsupported(f"{pdo} has no CAN-ID")
    _set(dut, pdo, KIND, parameters.kind, 1)
    for subindex, value, size in (
        (INHIBIT, parameters.inhibit_100us, 2),
        (EVENT_TIMER, parameters.event_ms, 2),
        (SYNC_START, parameters.start, 1),
    ):
        if dut.eds.find(pdo.parameter, subindex) is not None:
            _set(dut, pdo, subindex, value, size)
        elif value:
            raise Unsupported(f"{pdo} has no sub-index {subindex}")
    valid = cob_id & ~INVALID
    _set(dut, pdo, COB_ID, valid & ~NO_REMOTE if parameters.remote else valid, 4)
    dut.bus.pending(cob_id & CAN_ID)
    return cob_id & CAN_ID


def _set(dut: Dut, pdo: Pdo, subindex: int, value: int, size: int) -> None:
    if dut.sdo.integer(pdo.parameter, subindex) == value:
        return
    try:
        dut.sdo.write_integer(pdo.parameter, subindex, value, size)
    except Aborted as abort:
        if abort.code in _UNSUPPORTED:
            raise Unsupported(f"{pdo}: {abort}") from abort
        raise


Trial = Callable[[Dut, Pdo], None]


def each_tpdo(dut: Dut, trial: Trial) -> None:
    """Run a trial on each TPDO that maps an object, with all other TPDOs disabled.

    The node is reset after each trial.

    Raises:
        NotApplicable: There is no TPDO on which the trial can be run.
    """
    found = tpdos(dut)
    if not found:
        raise NotApplicable("the EDS has no TPDO (0x1800 to 0x19FF)")
    reasons: list[str] = []
    tried = False
    for pdo in found:
        if not mapped(dut, pdo):
            reasons.append(f"{pdo} maps nothing")
            continue
        for other in found:
            if other != pdo:
                disable(dut, other)
        try:
            trial(dut, pdo)
            tried = True
        except Unsupported as reason:
            reasons.append(str(reason))
        dut.prepare()
    if not tried:
        raise NotApplicable("; ".join(reasons))


def expect_pdo(dut: Dut, can_id: int, length: int, what: str) -> Frame:
    """Wait for the next frame of a PDO. Raises Failed if no frame arrives, or if its length is wrong."""
    frame = dut.bus.expect(can_id, what)
    if len(frame.data) != length:
        raise Failed(f"{counted(length, 'byte')} as mapped, {what}", describe(frame))
    return frame


def drain(dut: Dut, can_id: int) -> None:
    """Discard frames with ``can_id`` until none has arrived for 20 ms or half a second has passed."""
    end_s = clock.monotonic() + 0.5
    while clock.monotonic() < end_s and dut.bus.take(can_id, _PAUSE_S) is not None:
        pass
