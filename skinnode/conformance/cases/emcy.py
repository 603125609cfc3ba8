"""Conformance cases EMCY-01 to EMCY-06: emergency messages, error register and error history."""

from __future__ import annotations

from skinnode.conformance.case import case
from skinnode.conformance.dut import PRE_OPERATIONAL, Dut
from skinnode.conformance.provoked_errors import emcy_code, short_pdo
from skinnode.conformance.sdo import expedited, mux
from skinnode.conformance.tester import Failed, describe

_COB_ID, _REGISTER, _HISTORY = 0x1014, 0x1001, 0x1003
_NO_DATA = 0x0800_0024
_GENERIC = 1


@case("EMCY-01", "0x1014, the COB-ID of emergency messages, is 0x80 + node-ID", "7.5.2.17; 7.3.3")
def cob_id(dut: Dut) -> None:
    dut.need(_COB_ID)
    got = dut.sdo.integer(_COB_ID)
    if got != 0x80 + dut.node_id:
        raise Failed(f"0x1014:00 = 0x{0x80 + dut.node_id:08X}", f"0x{got:08X}")


@case("EMCY-02", "0x1001, the error register, is 0 after a reset", "7.5.2.2")
def register(dut: Dut) -> None:
    got = dut.sdo.integer(_REGISTER)
    if got:
        raise Failed("0x1001:00 = 0x00", f"0x{got:02X}")


@case(
    "EMCY-03",
    "0x1003, the error history, is empty after a reset: its count is 0, and sub-index 1 has no data",
    "7.5.2.4",
)
def history(dut: Dut) -> None:
    dut.need(_HISTORY, 1)
    count = dut.sdo.integer(_HISTORY)
    if count:
        raise Failed("0x1003:00 = 0", str(count))
    dut.sdo.aborts(
        b"\x40" + mux(_HISTORY, 1),
        _HISTORY,
        1,
        (_NO_DATA,),
        "read of 0x1003:01 while the error history is empty",
    )


@case("EMCY-04", "An RPDO that is too short triggers EMCY 0x8210 with the generic error bit set",
      "7.2.7.1, 7.2.2.5.1")  # fmt: skip
def forced(dut: Dut) -> None:
    dut.need(_COB_ID)
    frame = short_pdo(dut)
    if not frame.data[2] & _GENERIC:
        raise Failed("an emergency message with bit 0 of the error register set", describe(frame))
    dut.bus.expect_silence(dut.emcy_id, "second emergency message for the same error")


@case("EMCY-05", "0x1001 equals the error register in the last emergency message", "7.5.2.2")
def register_after(dut: Dut) -> None:
    dut.need(_COB_ID)
    frame = short_pdo(dut)
    for later in dut.bus.listen(dut.emcy_id, 0.05):
        frame = later
    got = dut.sdo.integer(_REGISTER)
    if got != frame.data[2]:
        raise Failed(
            f"0x1001:00 = 0x{frame.data[2]:02X} as in the emergency message {describe(frame)}", f"0x{got:02X}"
        )


@case(
    "EMCY-06", "0x1003:01 contains the last error; only writing 0 to 0x1003:00 clears the history", "7.5.2.4"
)
def history_after(dut: Dut) -> None:
    dut.need(_HISTORY, 1)
    frame = short_pdo(dut)
    dut.nmt(PRE_OPERATIONAL)
    count, newest = dut.sdo.integer(_HISTORY), dut.sdo.integer(_HISTORY, 1)
    if count != 1 or newest & 0xFFFF != emcy_code(frame):
        raise Failed(f"one error, 0x{emcy_code(frame):04X}", f"{count} errors; the last is 0x{newest:08X}")
    request = expedited(_HISTORY, 0, b"\x01")
    dut.sdo.aborts(request, _HISTORY, 0, (0x0609_0030, 0x0609_0031), "write of 1 to 0x1003:00")
    dut.sdo.write_integer(_HISTORY, 0, 0, 1)
    dut.sdo.aborts(
        b"\x40" + mux(_HISTORY, 1),
        _HISTORY,
        1,
        (_NO_DATA,),
        "read of 0x1003:01 after the history was cleared",
    )
