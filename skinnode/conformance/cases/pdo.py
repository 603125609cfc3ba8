"""Conformance cases PDO-01 to PDO-20: communication parameters and TPDO transmission."""

from __future__ import annotations

import statistics

from skinnode.conformance.case import NotApplicable, case
from skinnode.conformance.dut import PRE_OPERATIONAL, START, STOP, Dut
from skinnode.conformance.frame_period import check_period, gaps_ms
from skinnode.conformance.pdo import (
    CAN_ID,
    EVENT_TIMER,
    INVALID,
    NO_REMOTE,
    Pdo,
    PdoSetup,
    Trial,
    Unsupported,
    drain,
    each_tpdo,
    expect_pdo,
    mapped,
    payload_bytes,
    rpdos,
    set_up,
    sync,
    tpdos,
)
from skinnode.conformance.tester import ANSWER_S, QUIET_S, Failed

_EVENT_MS = 50
_FIRST_S = 0.4
"""Time to wait after each SYNC for the first TPDO of a cycle before sending the next SYNC, in s."""
_SYNC_COUNTER = 0x1019
_RESERVED_KINDS = range(241, 252)


def _scan(dut: Dut, pdos: list[Pdo], base: int) -> None:
    """Check the COB-IDs and transmission types of all RPDOs or all TPDOs.

    COB-IDs must equal the defaults in the EDS, and valid PDOs must have different CAN-IDs. If the first four
    PDOs are valid, they must have the CAN-IDs of the pre-defined connection set. Transmission types must not
    be reserved.
    """
    valid: dict[int, Pdo] = {}
    for pdo in pdos:
        cob_id = dut.sdo.integer(pdo.parameter, 1)
        default = dut.need(pdo.parameter, 1).default_bytes(dut.node_id)
        if default is not None and cob_id != int.from_bytes(default, "little"):
            raise Failed(
                f"{pdo} with COB-ID 0x{int.from_bytes(default, 'little'):08X} given in the EDS",
                f"0x{cob_id:08X}",
            )
        number = pdo.parameter % 0x200
        wanted = base + 0x100 * number + dut.node_id
        if number < 4 and not cob_id & INVALID and cob_id & CAN_ID != wanted:
            raise Failed(
                f"{pdo} with CAN-ID 0x{wanted:03X} from the pre-defined connection set", f"0x{cob_id:08X}"
            )
        if not cob_id & INVALID and (other := valid.setdefault(cob_id & CAN_ID, pdo)) != pdo:
            raise Failed("a different CAN-ID for each PDO", f"0x{cob_id & CAN_ID:03X} for {other} and {pdo}")
        kind = dut.sdo.integer(pdo.parameter, 2)
        if kind in _RESERVED_KINDS:
            raise Failed(f"{pdo} with a transmission type that is not reserved", str(kind))


@case(
    "PDO-01",
    "The COB-IDs of the RPDOs match the EDS and the pre-defined connection set",
    "7.5.2.35; 7.3.3",
)
def scan_rpdos(dut: Dut) -> None:
    pdos = rpdos(dut)
    if not pdos:
        raise NotApplicable("the EDS has no RPDO (0x1400 to 0x15FF)")
    _scan(dut, pdos, 0x200)


@case(
    "PDO-02",
    "The COB-IDs of the TPDOs match the EDS and the pre-defined connection set",
    "7.5.2.37; 7.3.3",
)
def scan_tpdos(dut: Dut) -> None:
    pdos = tpdos(dut)
    if not pdos:
        raise NotApplicable("the EDS has no TPDO (0x1800 to 0x19FF)")
    _scan(dut, pdos, 0x180)


# --- OPERATIONAL


@case(
    "PDO-03", "OPERATIONAL: the device answers a remote frame by sending the TPDO once", "7.2.2.5.2, 7.5.2.37"
)
def remote(dut: Dut) -> None:
    def trial(dut: Dut, pdo: Pdo) -> None:
        can_id, length = _for_remote(dut, pdo)
        dut.operational()
        drain(dut, can_id)
        for _ in range(2):
            dut.bus.send(can_id, remote=True)
            expect_pdo(dut, can_id, length, f"{pdo} after a remote frame")
            dut.bus.expect_silence(can_id, f"second {pdo} after one remote frame")

    each_tpdo(dut, trial)


def _for_remote(dut: Dut, pdo: Pdo) -> tuple[int, int]:
    """Configure a TPDO to be sent in response to a remote frame; return its CAN-ID and its length in bytes.

    Raises Unsupported if bit 30 of the COB-ID disallows remote frames.
    """
    if dut.sdo.integer(pdo.parameter, 1) & NO_REMOTE:
        raise Unsupported(f"{pdo} does not allow remote frames: bit 30 of 0x{pdo.parameter:04X}:01 is set")
    return set_up(dut, pdo, PdoSetup(253, remote=True)), payload_bytes(mapped(dut, pdo))


@case(
    "PDO-04",
    "OPERATIONAL: the event timer triggers TPDOs of types 254 and 255, but not within the inhibit time",
    "7.2.2.2, 7.5.2.37",
)
def event_driven(dut: Dut) -> None:
    def trial(dut: Dut, pdo: Pdo) -> None:
        length = payload_bytes(mapped(dut, pdo))
        for kind in (254, 255):
            can_id = set_up(dut, pdo, PdoSetup(kind, event_ms=_EVENT_MS))
            dut.operational()
            expect_pdo(dut, can_id, length, f"{pdo} of type {kind} with an event timer of {_EVENT_MS} ms")
            dut.nmt(PRE_OPERATIONAL)
        can_id = set_up(dut, pdo, PdoSetup(254, event_ms=10, inhibit_100us=400))
        dut.operational()
        frames = [expect_pdo(dut, can_id, length, f"{pdo} when its event timer elapses") for _ in range(8)]
        gaps = gaps_ms(frames)
        # A delayed frame shortens the following interval; the mean is hardly affected.
        if statistics.mean(gaps) < 40 * 0.95 or min(gaps) < 20:
            shown = ", ".join(f"{gap:.1f}" for gap in gaps)
            raise Failed(f"{pdo} at intervals of at least its inhibit time of 40 ms", f"gaps of {shown} ms")

    each_tpdo(dut, trial)


@case(
    "PDO-05",
    "OPERATIONAL: the TPDO is sent each time its event timer elapses, and never if the timer is 0",
    "7.5.2.37",
)
def event_timer(dut: Dut) -> None:
    def trial(dut: Dut, pdo: Pdo) -> None:
        length = payload_bytes(mapped(dut, pdo))
        can_id = set_up(dut, pdo, PdoSetup(254))
        dut.operational()
        # Application events may also trigger the PDO.
        busy = bool(dut.bus.listen(can_id, 3 * _EVENT_MS * 1e-3))
        dut.nmt(PRE_OPERATIONAL)
        set_up(dut, pdo, PdoSetup(254, event_ms=_EVENT_MS))
        dut.operational()
        frames = [expect_pdo(dut, can_id, length, f"{pdo} every {_EVENT_MS} ms") for _ in range(9)]
        check_period(frames, _EVENT_MS, str(pdo), or_sooner=busy)
        if not busy:
            dut.sdo.write_integer(pdo.parameter, EVENT_TIMER, 0, 2)
            dut.bus.pending(can_id)
            dut.bus.expect_silence(can_id, f"{pdo} with an event timer of 0", 2.5 * _EVENT_MS * 1e-3)

    each_tpdo(dut, trial)


@case("PDO-06", "OPERATIONAL: a TPDO of type 1 follows every SYNC; a TPDO of type 3 follows every third",
      "7.2.2.2, 7.5.2.37")  # fmt: skip
def cyclic(dut: Dut) -> None:
    def trial(dut: Dut, pdo: Pdo) -> None:
        length = payload_bytes(mapped(dut, pdo))
        for kind in (1, 3):
            can_id = set_up(dut, pdo, PdoSetup(kind))
            dut.operational()
            dut.bus.expect_silence(can_id, f"{pdo} of type {kind} without SYNC")
            first = _first_of_cycle(dut, can_id, kind, str(pdo))
            for number in range(first + 1, first + 2 * kind + 1):
                what = f"{pdo} of type {kind} after SYNC {number}; the first TPDO followed SYNC {first}"
                _after_sync(dut, can_id, length, (number - first) % kind == 0, what)
            dut.nmt(PRE_OPERATIONAL)

    each_tpdo(dut, trial)


def _first_of_cycle(dut: Dut, can_id: int, kind: int, name: str) -> int:
    """Send SYNCs until a TPDO arrives; return the number of SYNCs sent."""
    for number in range(1, kind + 1):
        sync(dut)
        if dut.bus.take(can_id, _FIRST_S if number < kind else ANSWER_S) is not None:
            drain(dut, can_id)
            return number
    after = "the SYNC" if kind == 1 else f"one of {kind} SYNCs"
    raise Failed(f"{name} of type {kind} after {after}", "nothing")


def _after_sync(  # noqa: PLR0913 - one PDO, one SYNC
    dut: Dut, can_id: int, length: int, due: bool, what: str, counter: int | None = None
) -> None:
    sync(dut, counter)
    if due:
        expect_pdo(dut, can_id, length, what)
        drain(dut, can_id)
    else:
        dut.bus.expect_silence(can_id, what)


@case(
    "PDO-07",
    "OPERATIONAL: a TPDO of type 0 is sent only after a SYNC, and no later than the third SYNC",
    "7.2.2.2, 7.5.2.37",
)
def acyclic(dut: Dut) -> None:
    def trial(dut: Dut, pdo: Pdo) -> None:
        length = payload_bytes(mapped(dut, pdo))
        can_id = set_up(dut, pdo, PdoSetup(0))
        dut.operational()
        dut.bus.expect_silence(can_id, f"{pdo} of type 0 without SYNC")
        for _ in range(3):
            sync(dut)
            if dut.bus.take(can_id, QUIET_S, lambda frame: len(frame.data) == length) is not None:
                return
        raise Failed(f"{pdo} of type 0 after one of three SYNCs", "nothing")

    each_tpdo(dut, trial)


@case(
    "PDO-08",
    "OPERATIONAL: the cycle of a synchronous TPDO begins at the SYNC start value",
    "7.5.2.37, 7.5.2.22",
)
def sync_start(dut: Dut) -> None:
    def trial(dut: Dut, pdo: Pdo) -> None:
        length = payload_bytes(mapped(dut, pdo))
        can_id = _for_start(dut, pdo)
        dut.operational()
        for counter in range(1, 8):
            due = counter in (3, 5, 7)
            _after_sync(
                dut, can_id, length, due, f"{pdo} at SYNC counter {counter}, with start value 3", counter
            )

    each_tpdo(dut, trial)


def _for_start(dut: Dut, pdo: Pdo) -> int:
    dut.need(_SYNC_COUNTER)
    dut.sdo.write_integer(_SYNC_COUNTER, 0, 10, 1)
    return set_up(dut, pdo, PdoSetup(2, start=3))


# --- no PDO is sent in STOPPED, nor in PRE-OPERATIONAL after OPERATIONAL


def _silent(command: int, kind: int, state: str, *, event_ms: int = 0, start: bool = False) -> Trial:
    """Return a trial that checks that a TPDO is not sent in ``state``.

    The trial moves the device from OPERATIONAL to ``state`` and then triggers the TPDO.
    """

    def trial(dut: Dut, pdo: Pdo) -> None:
        if kind == 253:
            can_id, _ = _for_remote(dut, pdo)
        elif start:
            can_id = _for_start(dut, pdo)
        else:
            can_id = set_up(dut, pdo, PdoSetup(kind, event_ms=event_ms))
        dut.nmt(START)
        dut.nmt(command)
        drain(dut, can_id)
        what = f"{pdo} of type {kind} in {state}"
        if kind in (254, 255):
            dut.bus.expect_silence(can_id, what, 2.5 * _EVENT_MS * 1e-3)
            return
        for number in range(1, 5):
            if kind == 253:
                dut.bus.send(can_id, remote=True)
            else:
                sync(dut, number if start else None)
            dut.bus.expect_silence(can_id, what, QUIET_S / 2)

    return trial


@case("PDO-09", "STOPPED: a remote frame is not answered", "7.3.2.2.4")
def stopped_remote(dut: Dut) -> None:
    each_tpdo(dut, _silent(STOP, 253, "STOPPED"))


@case("PDO-10", "STOPPED: an event-driven TPDO (255) is not sent", "7.3.2.2.4")
def stopped_event(dut: Dut) -> None:
    each_tpdo(dut, _silent(STOP, 255, "STOPPED", event_ms=_EVENT_MS))


@case("PDO-11", "STOPPED: a timer-driven TPDO (254) is not sent", "7.3.2.2.4")
def stopped_timer(dut: Dut) -> None:
    each_tpdo(dut, _silent(STOP, 254, "STOPPED", event_ms=_EVENT_MS))


@case("PDO-12", "STOPPED: a cyclic synchronous TPDO is not sent", "7.3.2.2.4")
def stopped_cyclic(dut: Dut) -> None:
    each_tpdo(dut, _silent(STOP, 1, "STOPPED"))


@case("PDO-13", "STOPPED: an acyclic synchronous TPDO is not sent", "7.3.2.2.4")
def stopped_acyclic(dut: Dut) -> None:
    each_tpdo(dut, _silent(STOP, 0, "STOPPED"))


@case("PDO-14", "STOPPED: a synchronous TPDO with a SYNC start value is not sent", "7.3.2.2.4")
def stopped_start(dut: Dut) -> None:
    each_tpdo(dut, _silent(STOP, 2, "STOPPED", start=True))


@case("PDO-15", "PRE-OPERATIONAL: a remote frame is not answered", "7.3.2.2.2")
def pre_operational_remote(dut: Dut) -> None:
    each_tpdo(dut, _silent(PRE_OPERATIONAL, 253, "PRE-OPERATIONAL"))


@case("PDO-16", "PRE-OPERATIONAL: an event-driven TPDO (255) is not sent", "7.3.2.2.2")
def pre_operational_event(dut: Dut) -> None:
    each_tpdo(dut, _silent(PRE_OPERATIONAL, 255, "PRE-OPERATIONAL", event_ms=_EVENT_MS))


@case("PDO-17", "PRE-OPERATIONAL: a timer-driven TPDO (254) is not sent", "7.3.2.2.2")
def pre_operational_timer(dut: Dut) -> None:
    each_tpdo(dut, _silent(PRE_OPERATIONAL, 254, "PRE-OPERATIONAL", event_ms=_EVENT_MS))


@case("PDO-18", "PRE-OPERATIONAL: a cyclic synchronous TPDO is not sent", "7.3.2.2.2")
def pre_operational_cyclic(dut: Dut) -> None:
    each_tpdo(dut, _silent(PRE_OPERATIONAL, 1, "PRE-OPERATIONAL"))


@case("PDO-19", "PRE-OPERATIONAL: an acyclic synchronous TPDO is not sent", "7.3.2.2.2")
def pre_operational_acyclic(dut: Dut) -> None:
    each_tpdo(dut, _silent(PRE_OPERATIONAL, 0, "PRE-OPERATIONAL"))


@case("PDO-20", "PRE-OPERATIONAL: a synchronous TPDO with a SYNC start value is not sent", "7.3.2.2.2")
def pre_operational_start(dut: Dut) -> None:
    each_tpdo(dut, _silent(PRE_OPERATIONAL, 2, "PRE-OPERATIONAL", start=True))
