"""LSS slave (CiA 305 v3.0), through which a master finds nodes and sets their node-IDs and bit rates.

The slave turns requests into responses and accesses neither a bus nor a clock. It handles requests in every
NMT state. A node without a node-ID handles no other requests.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Collection
from typing import Final

from skinnode.canopen.indices import MAX_NODE_ID
from skinnode.canopen.lss import (
    BIT_RATES_BPS,
    LSS_DONE,
    NOT_CONFIGURED,
    RESET_SCAN,
    LssAddress,
    LssCommand,
    LssState,
)
from skinnode.node.pacing import NO_DEADLINE_NS

_CIA_301_TABLE: Final = 0

_OUT_OF_RANGE, _CANNOT_STORE, _STORE_FAILED = 1, 1, 2
"""Error codes in responses. The meaning of code 1 depends on the request."""


# LSS address part and comparison for each request of *switch state selective* and *identify*.
_QUESTIONS: Final[dict[int, tuple[int, Callable[[int, int], bool]]]] = {
    0x40: (0, operator.eq),
    0x41: (1, operator.eq),
    0x42: (2, operator.eq),
    0x43: (3, operator.eq),
    0x46: (0, operator.eq),
    0x47: (1, operator.eq),
    0x48: (2, operator.ge),
    0x49: (2, operator.le),
    0x4A: (3, operator.ge),
    0x4B: (3, operator.le),
}
_FIRST_QUESTIONS: Final = (LssCommand.SELECT_VENDOR, LssCommand.IDENTIFY_VENDOR)


class LssSlave:
    """LSS slave of one node.

    Args:
        address: LSS address, from the identity object (0x1018).
        node_id: Persistent node-ID, 1 to 127, or :data:`NOT_CONFIGURED`.
        bit_rates_bps: Supported bit rates, in bit/s; empty if the bit rate cannot be changed.
        bit_rate_bps: Stored bit rate, bit/s, or None.
        store: Function that stores the pending node-ID and bit rate (bit/s or None), or raises OSError; None
            if the node has no memory.
        activate: Function that starts a bit rate change, given the pending bit rate (bit/s or None) and the
            delay in ms; None if the bit rate cannot be changed. See :meth:`on_request`.
    """

    def __init__(  # noqa: PLR0913 - keywords with defaults, one for each ability of a slave
        self,
        address: LssAddress,
        node_id: int,
        *,
        bit_rates_bps: Collection[int] = (),
        bit_rate_bps: int | None = None,
        store: Callable[[int, int | None], None] | None = None,
        activate: Callable[[int | None, int], None] | None = None,
    ) -> None:
        self._address = address
        self._bit_rates_bps = frozenset(bit_rates_bps)
        self._store, self._activate = store, activate
        self.state = LssState.WAITING
        """LSS state."""
        self.node_id = node_id
        """Active node-ID."""
        self.pending_node_id = node_id
        """Node-ID that becomes active at the next *reset communication*."""
        self._persistent_node_id = node_id
        self.pending_bit_rate_bps = bit_rate_bps
        """Bit rate in bit/s for the next *activate bit timing*; None to keep the current bit rate."""
        self._next_question = 0
        self._scan_part = 0

    @property
    def configured(self) -> bool:
        """Whether the node has a node-ID."""
        return self.node_id != NOT_CONFIGURED

    @property
    def may_boot(self) -> bool:
        """Whether the node must boot: it has been assigned a node-ID and left the configuration state."""
        return (
            not self.configured and self.pending_node_id != NOT_CONFIGURED and self.state is LssState.WAITING
        )

    def reset_node(self) -> None:
        """Handle NMT *reset node*: the persistent node-ID becomes the pending node-ID.

        The caller must then call :meth:`reset_communication`. The CANopen stacks c-open (src/co_nmt.c) and
        CANopenNode (305/CO_LSSslave.h) work in the same way.
        """
        self.pending_node_id = self._persistent_node_id

    def reset_communication(self) -> None:
        """Handle NMT *reset communication*: the pending node-ID becomes the active node-ID."""
        self.node_id = self.pending_node_id
        self._enter(LssState.WAITING)
        self._scan_part = 0

    def on_request(self, data: bytes) -> bytes | None:
        """Handle a request from the LSS master.

        CiA 305 requires a slave to ignore frames that are not 8 bytes long, unknown commands, and requests
        that are not allowed in its current state, because these may be intended for other slaves.

        After *activate bit timing*, the node is silent for twice the delay given in the request and changes
        its bit rate halfway through. The second half gives the other nodes time to change their bit rates.

        Args:
            data: Payload of the frame.

        Returns:
            The response, or None if there is none.
        """
        if len(data) != 8:
            return None
        command, value = data[0], int.from_bytes(data[1:5], "little")
        if command == LssCommand.SWITCH_GLOBAL:
            if data[1] in (LssState.WAITING, LssState.CONFIGURATION):
                self._enter(LssState(data[1]))
            return None
        if LssCommand.IDENTIFY_VENDOR <= command <= LssCommand.IDENTIFY_SERIAL_HIGH:
            agreed = self._agrees(command, value) and command == LssCommand.IDENTIFY_SERIAL_HIGH
            return _frame(LssCommand.IDENTIFIED) if agreed else None
        if command == LssCommand.IDENTIFY_NOT_CONFIGURED:
            return _frame(LssCommand.IDENTIFIED_NOT_CONFIGURED) if self._seeks_node_id else None
        if self.state is LssState.CONFIGURATION:
            return self._configure(command, data)
        if LssCommand.SELECT_VENDOR <= command <= LssCommand.SELECT_SERIAL:
            if self._agrees(command, value) and command == LssCommand.SELECT_SERIAL:
                self._enter(LssState.CONFIGURATION)
                return _frame(LssCommand.SELECTED)
        elif command == LssCommand.FASTSCAN and self._seeks_node_id:
            return self._fastscan(value, *data[5:])
        return None

    @property
    def _seeks_node_id(self) -> bool:
        return not self.configured and self.pending_node_id == NOT_CONFIGURED

    def _enter(self, state: LssState) -> None:
        self.state = state
        self._next_question = 0

    def _agrees(self, command: int, value: int) -> bool:
        """Return whether the LSS address matches this request and the preceding requests in its sequence."""
        part, holds = _QUESTIONS[command]
        in_turn = command in _FIRST_QUESTIONS or command == self._next_question
        agreed = in_turn and holds(self._address[part], value)
        self._next_question = command + 1 if agreed else 0
        return agreed

    def _fastscan(self, value: int, bit: int, part: int, next_part: int) -> bytes | None:
        """Return the response to a fastscan request, or None if the LSS address does not match.

        The address part must match ``value`` from bit ``bit`` to bit 31.
        """
        if bit == RESET_SCAN:
            self._scan_part = 0
        else:
            if bit > 31 or part > 3 or next_part > 3 or part != self._scan_part:
                return None
            if (self._address[part] ^ value) >> bit:
                return None
            self._scan_part = next_part
            # The entire address matches: the master has found this slave.
            if bit == 0 and next_part < part:
                self._enter(LssState.CONFIGURATION)
        return _frame(LssCommand.IDENTIFIED)

    def _configure(self, command: int, data: bytes) -> bytes | None:
        match command:
            case LssCommand.CONFIGURE_NODE_ID:
                node_id = data[1]
                if not (1 <= node_id <= MAX_NODE_ID or node_id == NOT_CONFIGURED):
                    return _frame(command, _OUT_OF_RANGE)
                self.pending_node_id = node_id
                return _frame(command, LSS_DONE)
            case LssCommand.CONFIGURE_BIT_TIMING:
                bit_rate_bps = BIT_RATES_BPS.get(data[2]) if data[1] == _CIA_301_TABLE else None
                if bit_rate_bps not in self._bit_rates_bps:
                    return _frame(command, _OUT_OF_RANGE)
                self.pending_bit_rate_bps = bit_rate_bps
                return _frame(command, LSS_DONE)
            case LssCommand.ACTIVATE_BIT_TIMING:
                if self._activate is not None:
                    self._activate(self.pending_bit_rate_bps, int.from_bytes(data[1:3], "little"))
                return None
            case LssCommand.STORE:
                return _frame(command, self._stored())
            case LssCommand.INQUIRE_NODE_ID:
                return _frame(command, self.node_id)
        if LssCommand.INQUIRE_VENDOR <= command <= LssCommand.INQUIRE_SERIAL:
            return _frame(command, self._address[command - LssCommand.INQUIRE_VENDOR])
        return None

    def _stored(self) -> int:
        if self._store is None:
            return _CANNOT_STORE
        try:
            self._store(self.pending_node_id, self.pending_bit_rate_bps)
        except OSError:
            return _STORE_FAILED
        self._persistent_node_id = self.pending_node_id
        return LSS_DONE


class BitRateChange:
    """Performs the bit rate change for *activate bit timing*, with a delay before and after the change.

    Args:
        set_bit_rate: Function that changes the bit rate (bit/s), or None if it cannot be changed.
    """

    def __init__(self, set_bit_rate: Callable[[int], None] | None) -> None:
        self._set_bit_rate = set_bit_rate
        self._bit_rate_bps: int | None = None
        self._change_ns = self._over_ns = NO_DEADLINE_NS
        self.deadline_ns = NO_DEADLINE_NS
        """Time (ns) at which :meth:`silent` must be called next."""

    def begin(self, bit_rate_bps: int | None, delay_ms: int, t_ns: int) -> None:
        """Start a bit rate change.

        Args:
            bit_rate_bps: New bit rate, in bit/s; None to keep the current bit rate.
            delay_ms: Delay in the request, in ms.
            t_ns: Arrival time of the request, in ns.
        """
        self._bit_rate_bps = bit_rate_bps
        self._change_ns = self.deadline_ns = t_ns + delay_ms * 1_000_000
        self._over_ns = t_ns + 2 * delay_ms * 1_000_000

    def silent(self, t_ns: int) -> bool:
        """Change the bit rate if the first delay has elapsed. Return whether the node must be silent."""
        if self.deadline_ns == NO_DEADLINE_NS:
            return False
        if t_ns >= self._change_ns:
            self._change_ns, self.deadline_ns = NO_DEADLINE_NS, self._over_ns
            if self._bit_rate_bps is not None and self._set_bit_rate is not None:
                self._set_bit_rate(self._bit_rate_bps)
        if t_ns >= self._over_ns:
            self.deadline_ns = NO_DEADLINE_NS
        return self.deadline_ns != NO_DEADLINE_NS

    def cancel(self) -> None:
        """Cancel the bit rate change when the node is switched off."""
        self.deadline_ns = NO_DEADLINE_NS


def _frame(command: int, value: int = 0) -> bytes:
    return bytes((command,)) + value.to_bytes(4, "little") + bytes(3)
