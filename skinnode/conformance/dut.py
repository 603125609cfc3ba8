"""Device under test: NMT, error control and object dictionary."""

from __future__ import annotations

import contextlib
from typing import Final

from skinnode.conformance.case import NotApplicable
from skinnode.conformance.eds_reader import Eds, EdsEntry
from skinnode.conformance.sdo import Aborted, SdoClient
from skinnode.conformance.tester import QUIET_S, Failed, Tester, describe
from skinnode.errors import NodeTimeout
from skinnode.process import clock

START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
"""NMT command specifiers."""

STATES: Final = {0: "initialising", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE-OPERATIONAL"}

_HEARTBEATS: Final = tuple(bytes((state,)) for state in STATES if state)

BOOT_S: Final = 5.0
"""Maximum boot time of a device, in s."""

_ASK_EACH_S: Final = 0.25

HEARTBEAT: Final = 0x1017
GUARD_TIME, LIFE_TIME_FACTOR = 0x100C, 0x100D
STORE, RESTORE = 0x1010, 0x1011
_ABSENT: Final = (0x0602_0000, 0x0609_0011)
"""SDO abort codes for a missing object and for a missing sub-index."""


class Dut:
    """Device under test: node ``node_id`` on a bus, and its EDS."""

    def __init__(self, bus: Tester, node_id: int, eds: Eds) -> None:
        self.bus, self.node_id, self.eds = bus, node_id, eds
        self.sdo = SdoClient(bus, node_id)
        self.stored = False
        """Whether a case has stored or restored parameters, so that the configuration must be restored."""
        self.up = False
        """Whether the node responded after its last reset."""

    @property
    def error_control_id(self) -> int:
        """COB-ID of boot-up messages, heartbeats and node guarding."""
        return 0x700 + self.node_id

    @property
    def emcy_id(self) -> int:
        """COB-ID of emergency messages."""
        return 0x80 + self.node_id

    # --- network management

    def nmt(self, command: int) -> None:
        """Send an NMT command to this node only."""
        self.bus.send(0x000, bytes((command, self.node_id)))

    def reset(self, command: int = RESET_NODE) -> None:
        """Reset the node and wait for its boot-up message. Raises Failed if the message does not arrive."""
        self.bus.clear()
        self.nmt(command)
        frame = self.bus.expect(
            self.error_control_id,
            "the boot-up message",
            BOOT_S,
            lambda frame: frame.data not in _HEARTBEATS,  # ignore heartbeats sent before the reset
        )
        self.bus.forget()
        if frame.data != b"\0":
            raise Failed(f"the boot-up message 0x{self.error_control_id:03X} [1] 00", describe(frame))

    def prepare(self) -> None:
        """Reset the node and bring it to PRE-OPERATIONAL.

        The node is ready when it sends its boot-up message or an SDO response. The boot-up message is not
        required here, because case STATE-01 checks it.

        Raises:
            NodeTimeout: The node does not answer.
        """
        self._await_reset()
        self.nmt(PRE_OPERATIONAL)

    def _await_reset(self) -> None:
        self.bus.clear()
        self.nmt(RESET_NODE)
        self.up = False
        end_s = clock.monotonic() + BOOT_S
        while clock.monotonic() < end_s:
            boot = self.bus.take(self.error_control_id, _ASK_EACH_S, lambda frame: frame.data == b"\0")
            if boot is not None:
                self.bus.forget()
                self.up = True
                return
            self.sdo.send(b"\x40\x00\x10\x00")
            if self.bus.take(self.sdo.answer_id, _ASK_EACH_S) is not None:
                self.up = True
                return
        raise NodeTimeout(self.node_id, f"no boot-up message and no response within {BOOT_S:g} s of a reset")

    def operational(self) -> None:
        """Start the node."""
        self.nmt(START)

    # --- error control

    def start_heartbeat(self, period_ms: int = 20) -> None:
        """Start the node's heartbeat; do nothing if the node supports only guarding.

        Raises:
            NotApplicable: The node supports neither heartbeat nor guarding.
        """
        if self.eds.find(HEARTBEAT) is not None:
            self.sdo.write_integer(HEARTBEAT, 0, period_ms, 2)
        else:
            self.need(GUARD_TIME)

    def state(self, what: str) -> int:
        """Return the NMT state from a heartbeat or, if the node has no heartbeat, from a guarding response.

        Call :meth:`start_heartbeat` first. The state is taken from the second heartbeat received, because the
        first may have been sent before the call.
        """
        if self.eds.find(HEARTBEAT) is None:
            return (self.guard(what) or 0) & 0x7F
        self.bus.pending(self.error_control_id)
        for _ in range(2):
            frame = self.bus.expect(self.error_control_id, f"a heartbeat {what}")
            if len(frame.data) != 1:
                raise Failed(f"a heartbeat of one byte {what}", describe(frame))
        return frame.data[0]

    def expect_state(self, state: int, what: str) -> None:
        """Raise Failed unless the node is in the NMT state ``state``."""
        got = self.state(what)
        if got != state:
            raise Failed(f"{STATES[state]} {what}", STATES.get(got, f"state {got}"))

    def guard(self, what: str) -> int | None:
        """Send a guarding request (remote frame); return the response byte, or None if there is none."""
        self.bus.pending(self.error_control_id)
        self.bus.send(self.error_control_id, remote=True)
        frame = self.bus.take(self.error_control_id, 4 * QUIET_S)
        if frame is not None and len(frame.data) != 1:
            raise Failed(f"one byte in response to a remote frame, {what}", describe(frame))
        return None if frame is None else frame.data[0]

    # --- object dictionary

    def need(self, index: int, subindex: int = 0) -> EdsEntry:
        """Return an EDS entry. Raises NotApplicable if the EDS does not contain it."""
        entry = self.eds.find(index, subindex)
        if entry is None:
            raise NotApplicable(f"the EDS has no object 0x{index:04X}:{subindex:02X}")
        return entry

    def need_storage(self, index: int, subindex: int) -> None:
        """Raise NotApplicable if the device cannot store (0x1010) or restore (0x1011) parameters on command.

        This capability is indicated by bit 0 of the value read (CiA 301, 7.5.2.13 and 7.5.2.14).
        """
        self.need(index, subindex)
        try:
            capability = self.sdo.integer(index, subindex)
        except Aborted as abort:
            if abort.code not in _ABSENT:
                raise
            raise NotApplicable(f"0x{index:04X}:{subindex:02X} does not exist: {abort}") from abort
        if not capability & 1:
            what = "saving on command" if index == STORE else "restoring"
            entry = f"0x{index:04X}:{subindex:02X}"
            raise NotApplicable(f"{entry} = 0x{capability:08X}: bit 0, {what}, is not set")

    def to_defaults(self) -> None:
        """Restore the default values if the node supports 0x1011, then reset the node."""
        with contextlib.suppress(NotApplicable):
            self.need_storage(RESTORE, 1)
            self.restore(1)
        self.reset()

    def store(self, subindex: int, signature: bytes = b"save") -> None:
        """Store parameters (0x1010); the original configuration is restored after the case."""
        self.stored = True
        self.sdo.write(STORE, subindex, signature)

    def restore(self, subindex: int) -> None:
        """Restore default parameters (0x1011), which take effect at the next reset."""
        self.stored = True
        self.sdo.write(RESTORE, subindex, b"load")
