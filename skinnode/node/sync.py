"""SYNC consumer and producer (CiA 301 v4.2, 7.2.5), including objects 0x1005, 0x1006, 0x1007 and 0x1019."""

from __future__ import annotations

from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.emergency import EmcyCode
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.pdo.parameters import COB_ID_MASK, INVALID_BIT, check_cob_id
from skinnode.node.rejected import Rejected
from skinnode.node.services import NodeServices

PRODUCER_BIT: Final = 1 << 30
"""Bit in 0x1005 that enables SYNC production."""

SHORTEST_PERIOD_US: Final = 100
"""Minimum communication cycle period (0x1006) in µs; twice the duration of a SYNC at 1 Mbit/s."""

_DO_NOT_CARE_BIT: Final = 1 << 31
"""Bit in 0x1005 that can be set but has no effect (CiA 301 v4.2, table 44)."""


class SyncWindow:
    """Synchronous window (0x1007): the time after a SYNC within which synchronous PDOs are valid."""

    def __init__(self, store: ObjectStore, emcy: EmcyProducer) -> None:
        self._store, self._emcy = store, emcy
        self._sync_ns: int | None = None
        self._missed: set[int] = set()

    def start(self, t_ns: int) -> None:
        """Open the window on a SYNC."""
        self._sync_ns = t_ns

    def forget(self, t_ns: int) -> None:
        """Forget the last SYNC and clear all errors when the NMT state changes."""
        self._sync_ns = None
        for number in tuple(self._missed):
            self._clear(number, t_ns)

    def is_open(self, t_ns: int) -> bool:
        """Return whether synchronous PDOs are valid at ``t_ns``; always true before the first SYNC."""
        length_us = self._store.integer(od.SYNC_WINDOW)
        return not length_us or self._sync_ns is None or t_ns - self._sync_ns <= length_us * 1000

    def lets_out(self, number: int, t_ns: int) -> bool:
        """Return whether a synchronous TPDO may be sent. If not, the caller must discard it.

        A discarded TPDO is reported in an emergency message. The error ends when the same TPDO is next sent
        within the window.

        Args:
            number: Number of the TPDO, counted from 0.
            t_ns: Current time, in ns.
        """
        if self.is_open(t_ns):
            self._clear(number, t_ns)
            return True
        self._missed.add(number)
        self._emcy.report(EmcyCode.SYNC_WINDOW, (number + 1).to_bytes(2, "little"), t_ns, number)
        return False

    def _clear(self, number: int, t_ns: int) -> None:
        if number in self._missed:
            self._missed.discard(number)
            self._emcy.clear(EmcyCode.SYNC_WINDOW, t_ns, number)


class Sync:
    """SYNC consumer and, if 0x1005 enables it, SYNC producer.

    A SYNC producer also consumes its own SYNCs. The caller must handle a SYNC returned by :meth:`on_timer`
    like one accepted by :meth:`accept`.

    Args:
        services: Resources that all services of the node share.
    """

    def __init__(self, services: NodeServices) -> None:
        store = services.store
        self._store, self._emcy, self._rejected = store, services.emcy, services.rejected
        self._send, self._now = services.send, services.now
        self.window = SyncWindow(store, services.emcy)
        """Synchronous window."""
        self._communicates = False
        self._counter = 0  # counter of the last SYNC sent
        self._period_ns = 0
        self._wrong_length: int | None = None  # length of the last SYNC received; None if correct
        self.cob_id = od.SYNC_COB_ID
        """COB-ID of the SYNC."""
        self.deadline_ns = NO_DEADLINE_NS
        """Time (ns) at which the next SYNC must be sent."""
        store.guard(od.COB_ID_SYNC, self._guard_cob_id)
        store.guard(od.CYCLE_PERIOD, _guard_period)
        store.guard(od.SYNC_COUNTER_OVERFLOW, self._guard_overflow)

    @property
    def _overflow(self) -> int:
        return self._store.integer(od.SYNC_COUNTER_OVERFLOW)

    @property
    def _produces(self) -> bool:
        return bool(self._store.integer(od.COB_ID_SYNC) & PRODUCER_BIT)

    def reload(self) -> None:
        """Apply 0x1005 and 0x1006 after a write or a reset.

        A SYNC producer sends its next SYNC one period later. When production starts, the SYNC counter starts
        at 1.
        """
        self.cob_id = self._store.integer(od.COB_ID_SYNC) & COB_ID_MASK
        self._start()

    def enter(self, *, communicates: bool) -> None:
        """Handle a change in the NMT state.

        SYNCs are produced and consumed in PRE-OPERATIONAL and OPERATIONAL. When the node enters either state
        from any other state, the SYNC counter restarts at 1.
        """
        if communicates != self._communicates:
            self._communicates, self._wrong_length, self._period_ns = communicates, None, 0
            self._start()

    def _start(self) -> None:
        if not self._period_ns:
            self._counter = 0
        self._period_ns = self._store.integer(od.CYCLE_PERIOD) * 1000 if self._produces else 0
        runs = self._communicates and self._period_ns
        self.deadline_ns = self._now() + self._period_ns if runs else NO_DEADLINE_NS

    def on_timer(self, t_ns: int) -> bytes | None:
        """Send a SYNC and return its payload, or return None if no SYNC is due.

        SYNCs that are overdue by a full period are skipped. The phase of the schedule does not change.
        """
        if t_ns < self.deadline_ns:
            return None
        self.deadline_ns += (t_ns - self.deadline_ns) // self._period_ns * self._period_ns + self._period_ns
        message = b""
        if self._overflow:
            self._counter = self._counter % self._overflow + 1
            message = bytes((self._counter,))
        self._send(self.cob_id, message)
        return message

    def accept(self, message: bytes, t_ns: int) -> bool:
        """Return whether the length of a received SYNC matches 0x1019.

        A wrong length is reported in an emergency message, but not again while it stays the same.

        Args:
            message: Payload of the SYNC.
            t_ns: Arrival time, in ns.
        """
        counted = self._overflow > 0
        if len(message) == counted:
            self._wrong_length = None
            return True
        self._rejected.count(Rejected.SYNC)
        if len(message) != self._wrong_length:
            self._wrong_length = len(message)
            self._emcy.report_once(EmcyCode.SYNC_LENGTH, bytes((len(message), counted)), t_ns)
        return False

    # --- guards

    def _guard_cob_id(self, _: int, value: int) -> None:
        check_cob_id(value & ~(PRODUCER_BIT | _DO_NOT_CARE_BIT), INVALID_BIT)
        moved = (value ^ self._store.integer(od.COB_ID_SYNC)) & COB_ID_MASK
        if moved and value & PRODUCER_BIT and self._produces:
            raise Refused(AbortCode.INVALID_VALUE)

    def _guard_overflow(self, _: int, value: int) -> None:
        if value == 1:  # CiA 301 allows 0 and 2 to 240
            raise Refused(AbortCode.INVALID_VALUE)
        if self._store.integer(od.CYCLE_PERIOD):
            raise Refused(AbortCode.DEVICE_STATE)


def _guard_period(_: int, value: int) -> None:
    if 0 < value < SHORTEST_PERIOD_US:
        raise Refused(AbortCode.VALUE_TOO_LOW)
