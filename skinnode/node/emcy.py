"""EMCY producer: emergency messages (0x1014, 0x1015), error register (0x1001), error history (0x1003).

CiA 301 v4.2, 7.2.7.
"""

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
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pdo.parameters import COB_ID_MASK, INVALID_BIT, check_cob_id

_WAITING: Final = 16
"""Maximum number of queued emergency messages; if the queue is full, the oldest message is dropped. Messages
are queued during the inhibit time, in the STOPPED state, and while the bus refuses frames."""
_RESERVED_BIT: Final = 1 << 30


class EmcyProducer:
    """Producer of emergency messages, which report the beginning and the end of each error.

    Args:
        store: object dictionary.
        send: called with the COB-ID and payload of each message.
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
        """Value of the error register (0x1001); bit 0 is set while an error is active."""
        bits = 0
        for code, _ in self._present:
            bits |= code.register_bit | 1
        return bits

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which the next queued message may be sent."""
        return self._free_ns if self._waiting and self._allowed else NO_DEADLINE_NS

    def report_once(self, code: EmcyCode, detail: bytes, t_ns: int) -> None:
        """Report a momentary error in two messages: one for the error, and one for its end.

        Args:
            code: error code.
            detail: up to five manufacturer-specific bytes.
            t_ns: current time, ns.
        """
        self._send_error(code, self.register | code.register_bit | 1, detail, t_ns)
        self._send_end(code, t_ns)

    def report(self, code: EmcyCode, detail: bytes, t_ns: int, who: int = 0) -> None:
        """Report an error that lasts until :meth:`clear`, unless it was already reported with this detail.

        Args:
            code: error code.
            detail: up to five manufacturer-specific bytes.
            t_ns: current time, ns.
            who: number that distinguishes errors with the same code that occur and end independently.
        """
        if self._present.get((code, who)) != detail:
            self._present[code, who] = detail
            self._send_error(code, self.register, detail, t_ns)

    def clear(self, code: EmcyCode, t_ns: int, who: int = 0) -> None:
        """Report the end of an error; do nothing if :meth:`report` has not reported the error.

        Args:
            code: error code.
            t_ns: current time, ns.
            who: as in :meth:`report`.
        """
        if self._present.pop((code, who), None) is not None:
            self._send_end(code, t_ns)

    def allow(self, allowed: bool, t_ns: int) -> None:
        """Set whether messages may be sent, which depends on the NMT state of the node."""
        self._allowed = allowed
        self._try(t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send the messages allowed at ``t_ns``. A message refused by the bus stays in the queue."""
        cob_id = self._store.integer(od.COB_ID_EMCY) & COB_ID_MASK
        while self._waiting and self._allowed and t_ns >= self._free_ns:
            if self._lost:  # report this first: the dropped messages were the oldest
                self._send(cob_id, self._loss())
                self._lost = 0
            else:
                self._send(cob_id, self._waiting[0])
                self._waiting.popleft()
            self._sent_ns = t_ns

    def reset(self) -> None:
        """Discard all errors and messages, as after power-on."""
        self._present.clear()
        self._history.clear()
        self._waiting.clear()
        self._lost, self._sent_ns = 0, -NO_DEADLINE_NS

    def _send_error(self, code: EmcyCode, register: int, detail: bytes, t_ns: int) -> None:
        self._remember(code, detail)
        self._queue(_message(code, register, detail), t_ns)

    def _send_end(self, code: EmcyCode, t_ns: int) -> None:
        """Queue a message about the end of an error; its register byte shows the remaining errors."""
        self._queue(_message(EmcyCode.RESET, self.register, code.to_bytes(2, "little")), t_ns)

    def _remember(self, code: EmcyCode, detail: bytes) -> None:
        # The upper 16 bits of an error history entry are manufacturer-specific: the first two detail bytes.
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
        """Send the queued messages; if the bus refuses a message, try again at the next timer event.

        A BusError is suppressed, so that the caller can continue to handle the error being reported.
        """
        with contextlib.suppress(BusError):
            self.on_timer(t_ns)

    def _loss(self) -> bytes:
        """Return an emergency message that reports how many emergency messages were dropped.

        Detail bytes 2 and 3 contain the number of dropped messages. Detail bytes 0 and 1 are 0; in overrun
        messages (0x8110) about scans, they contain the number of skipped scans.
        """
        detail = struct.pack("<HH", 0, min(self._lost, 0xFFFF))
        self._remember(EmcyCode.CAN_OVERRUN, detail)
        return _message(EmcyCode.CAN_OVERRUN, self.register | EmcyCode.CAN_OVERRUN.register_bit | 1, detail)

    @property
    def _free_ns(self) -> int:
        """End (ns) of the inhibit time after the last message, when the next message may be sent."""
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
        """Return a sub-object of the error history: the number of entries, or an entry, newest first."""
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
        if not self._exists:  # discard queued messages, so that they are not sent when EMCY is enabled again
            self._waiting.clear()
            self._lost = 0


def _message(code: EmcyCode, register: int, detail: bytes) -> bytes:
    return code.to_bytes(2, "little") + bytes((register,)) + detail[:5].ljust(5, b"\0")


def _only_zero(_: int, value: int) -> None:
    if value:
        raise Refused(AbortCode.INVALID_VALUE)
