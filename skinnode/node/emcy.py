"""EMCY producer (CiA 301 v4.2, 7.2.7), including objects 0x1001, 0x1003, 0x1014 and 0x1015."""

from __future__ import annotations

import contextlib
import struct
from collections import deque
from collections.abc import Callable
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.emergency import EmcyCode
from skinnode.errors import BusError
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.pdo.parameters import COB_ID_MASK, INVALID_BIT, check_cob_id

_WAITING: Final = 16
"""Capacity of the emergency message queue. Messages wait during the inhibit time, in the STOPPED state, and
while frames cannot be sent. If the queue is full, the oldest message is dropped."""
_RESERVED_BIT: Final = 1 << 30


class EmcyProducer:
    """EMCY producer of a node, which reports the beginning and the end of each error.

    Args:
        store: Object dictionary.
        send: Function that sends a frame, given its COB-ID and payload.
    """

    def __init__(self, store: ObjectStore, send: Callable[[int, bytes], None]) -> None:
        self._store, self._send = store, send
        self._present: dict[tuple[EmcyCode, int], bytes] = {}
        self._history: deque[int] = deque(maxlen=od.ERROR_FIELD_LENGTH)  # newest first
        self._waiting: deque[bytes] = deque()
        self._lost = 0  # number of dropped messages not yet reported
        self._sent_ns = -NO_DEADLINE_NS
        self._allowed = False
        self._connect()

    @property
    def register(self) -> int:
        """Value of the error register (0x1001). Bit 0 is set while any error is active."""
        bits = 0
        for code, _ in self._present:
            bits |= code.register_bit | 1
        return bits

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which the next queued message may be sent."""
        return self._free_ns if self._waiting and self._allowed else NO_DEADLINE_NS

    def report_once(self, code: EmcyCode, detail: bytes, t_ns: int) -> None:
        """Report an error and then, immediately, its end.

        Args:
            code: Error code.
            detail: Up to five manufacturer-specific bytes.
            t_ns: Current time, in ns.
        """
        self._send_error(code, self.register | code.register_bit | 1, detail, t_ns)
        self._send_end(code, t_ns)

    def report(self, code: EmcyCode, detail: bytes, t_ns: int, who: int = 0) -> None:
        """Report an error that lasts until :meth:`clear` is called.

        Repeated calls with the same detail have no effect.

        Args:
            code: Error code.
            detail: Up to five manufacturer-specific bytes.
            t_ns: Current time, in ns.
            who: Number that distinguishes independent errors with the same code.
        """
        if self._present.get((code, who)) != detail:
            self._present[code, who] = detail
            self._send_error(code, self.register, detail, t_ns)

    def clear(self, code: EmcyCode, t_ns: int, who: int = 0) -> None:
        """Report the end of an error. If the error is not active, do nothing.

        Args:
            code: Error code.
            t_ns: Current time, in ns.
            who: As in :meth:`report`.
        """
        if self._present.pop((code, who), None) is not None:
            self._send_end(code, t_ns)

    def allow(self, allowed: bool, t_ns: int) -> None:
        """Enable or disable sending, depending on the NMT state of the node."""
        self._allowed = allowed
        self._try(t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send queued messages as the inhibit time allows. A message that cannot be sent stays queued."""
        if not self._waiting:
            return
        cob_id = self._store.integer(od.COB_ID_EMCY) & COB_ID_MASK
        while self._waiting and self._allowed and t_ns >= self._free_ns:
            if self._lost:  # the dropped messages were the oldest
                detail = self._loss()
                self._send(cob_id, self._loss_message(detail))
                self._remember(EmcyCode.CAN_OVERRUN, detail)  # not at each attempt to send it
                self._lost = 0
            else:
                self._send(cob_id, self._waiting[0])
                self._waiting.popleft()
            self._sent_ns = t_ns

    def reset(self) -> None:
        """Discard all errors, the error history and all queued messages."""
        self._present.clear()
        self._history.clear()
        self._waiting.clear()
        self._lost, self._sent_ns = 0, -NO_DEADLINE_NS

    def _send_error(self, code: EmcyCode, register: int, detail: bytes, t_ns: int) -> None:
        self._remember(code, detail)
        self._queue(_message(code, register, detail), t_ns)

    def _send_end(self, code: EmcyCode, t_ns: int) -> None:
        """Queue a message that reports the end of an error; its error register shows the remaining errors."""
        self._queue(_message(EmcyCode.RESET, self.register, code.to_bytes(2, "little")), t_ns)

    def _remember(self, code: EmcyCode, detail: bytes) -> None:
        # The upper 16 bits of an entry are manufacturer-specific: here, the first two detail bytes.
        self._history.appendleft(code | int.from_bytes(detail[:2], "little") << 16)

    def _queue(self, message: bytes, t_ns: int) -> None:
        if not self._exists:
            return
        if len(self._waiting) >= _WAITING:
            self._waiting.popleft()
            self._lost += 1
        self._waiting.append(message)
        self._try(t_ns)

    def _try(self, t_ns: int) -> None:
        """Send queued messages. A message that cannot be sent is retried at a later timer event.

        No BusError is raised, because the caller is still handling the error that the message reports.
        """
        with contextlib.suppress(BusError):
            self.on_timer(t_ns)

    def _loss(self) -> bytes:
        """Return the detail bytes of the emergency message (0x8110) that reports dropped emergency messages.

        Their number is in detail bytes 2 and 3. Detail bytes 0 and 1 are 0 to distinguish this message from
        one about skipped scans, in which they contain the number of skipped scans.
        """
        return struct.pack("<HH", 0, min(self._lost, 0xFFFF))

    def _loss_message(self, detail: bytes) -> bytes:
        return _message(EmcyCode.CAN_OVERRUN, self.register | EmcyCode.CAN_OVERRUN.register_bit | 1, detail)

    @property
    def _free_ns(self) -> int:
        """Time (ns) at which the inhibit time of the last message ends."""
        return self._sent_ns + self._store.integer(od.EMCY_INHIBIT_TIME) * 100_000

    # --- object dictionary

    @property
    def _exists(self) -> bool:
        return not self._store.integer(od.COB_ID_EMCY) & INVALID_BIT

    def _connect(self) -> None:
        store = self._store
        store.bind(od.ERROR_REGISTER, lambda _: bytes((self.register,)))
        store.bind(od.ERROR_FIELD, self._read_history, count=True)
        store.guard(od.ERROR_FIELD, _only_zero)
        store.watch(od.ERROR_FIELD, lambda _: self._history.clear())
        store.guard(od.COB_ID_EMCY, self._guard_cob_id)
        store.watch(od.COB_ID_EMCY, lambda _: self._on_cob_id())

    def _read_history(self, subindex: int) -> bytes:
        """Return a sub-index of the error history: the number of entries (0) or an entry (1 = newest)."""
        if subindex == 0:
            return bytes((len(self._history),))
        if subindex > len(self._history):
            raise Refused(AbortCode.NO_DATA)
        return self._history[subindex - 1].to_bytes(4, "little")

    def _guard_cob_id(self, _: int, value: int) -> None:
        if value & _RESERVED_BIT:
            raise Refused(AbortCode.INVALID_VALUE)
        check_cob_id(value, self._store.integer(od.COB_ID_EMCY))

    def _on_cob_id(self) -> None:
        if not self._exists:  # queued messages must not be sent when EMCY is enabled again
            self._waiting.clear()
            self._lost = 0


def _message(code: EmcyCode, register: int, detail: bytes) -> bytes:
    return code.to_bytes(2, "little") + bytes((register,)) + detail[:5].ljust(5, b"\0")


def _only_zero(_: int, value: int) -> None:
    if value:
        raise Refused(AbortCode.INVALID_VALUE)
