"""Emergency messages, error register (0x1001) and error history (0x1003): CiA 301 v4.2, 7.2.7."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Final

from skinnode.node.abort import AbortCode, Refused
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.wire.indices import ERROR_FIELD_LENGTH

_WAITING: Final = 16  # messages kept while inhibit time or a stopped node hold them back; the oldest give way


class EmcyCode(IntEnum):
    """Emergency error codes this node uses."""

    RESET = 0x0000
    HARDWARE = 0x5000
    DATA_SET = 0x6300
    CAN_OVERRUN = 0x8110
    HEARTBEAT = 0x8130
    PDO_NOT_PROCESSED = 0x8210
    PDO_LENGTH_EXCEEDED = 0x8220
    SYNC_LENGTH = 0x8240

    @property
    def register_bit(self) -> int:
        """Bit of the error register: 4 is communication, 7 the manufacturer's own."""
        return 0x10 if self >= 0x8000 else 0x80


class EmcyProducer:
    """Which errors are present, what was told about them and when more may be told."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self._send = send
        self._present: set[EmcyCode] = set()
        self._history: deque[int] = deque(maxlen=ERROR_FIELD_LENGTH)  # the newest first
        self._waiting: deque[bytes] = deque(maxlen=_WAITING)
        self._free_ns = 0
        self.inhibit_ns = 0
        self.enabled = False
        """Whether the node's state, and COB-ID 0x1014, let messages out; they wait otherwise."""

    @property
    def register(self) -> int:
        """Error register: bit 0 is set as long as any error is present."""
        bits = 0
        for code in self._present:
            bits |= code.register_bit | 1
        return bits

    @property
    def deadline_ns(self) -> int:
        """When a waiting message may be sent."""
        return self._free_ns if self._waiting and self.enabled else NO_DEADLINE_NS

    def happened(self, code: EmcyCode, detail: bytes, t_ns: int) -> None:
        """An error that is over as soon as it is told. ``detail`` is up to five bytes."""
        self._tell(code, self.register | code.register_bit | 1, detail, t_ns)

    def present(self, code: EmcyCode, detail: bytes, t_ns: int) -> None:
        """An error that lasts until :meth:`over`; told again each time, since the detail says what is new."""
        self._present.add(code)
        self._tell(code, self.register, detail, t_ns)

    def over(self, code: EmcyCode, t_ns: int) -> None:
        """A lasting error has gone; nothing happens if it was not there."""
        if code in self._present:
            self._present.discard(code)
            self._queue(EmcyCode.RESET, self.register, code.to_bytes(2, "little"), t_ns)

    def _tell(self, code: EmcyCode, register: int, detail: bytes, t_ns: int) -> None:
        # The upper half of an entry is ours: the first two bytes of the detail.
        self._history.appendleft(code | int.from_bytes(detail[:2], "little") << 16)
        self._queue(code, register, detail, t_ns)

    def _queue(self, code: EmcyCode, register: int, detail: bytes, t_ns: int) -> None:
        self._waiting.append(code.to_bytes(2, "little") + bytes((register,)) + detail[:5].ljust(5, b"\0"))
        self.on_timer(t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send what may be sent."""
        while self._waiting and self.enabled and t_ns >= self._free_ns:
            self._free_ns = t_ns + self.inhibit_ns
            self._send(self._waiting.popleft())

    def reset(self) -> None:
        """As after power-on."""
        self._present.clear()
        self._history.clear()
        self._waiting.clear()
        self._free_ns = 0

    def read_history(self, subindex: int) -> bytes:
        """Object 0x1003: the count at sub-index 0, then the errors, the newest first."""
        if subindex == 0:
            return bytes((len(self._history),))
        if subindex > len(self._history):
            raise Refused(AbortCode.NO_DATA)
        return self._history[subindex - 1].to_bytes(4, "little")

    def clear_history(self) -> None:
        """A client wrote 0 to the count."""
        self._history.clear()
