"""Emergency messages (0x1014, 0x1015), error register (0x1001) and error history (0x1003): CiA 301 v4.2,
7.2.7."""

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
"""Messages kept while inhibit time, a stopped node or the bus hold them back; the oldest give way."""
_RESERVED_BIT: Final = 1 << 30


class EmcyProducer:
    """Which errors are present, what was told about them and when more may be told."""

    def __init__(self, store: ObjectStore, send: Callable[[int, bytes], None]) -> None:
        self._store, self._send = store, send
        self._present: dict[tuple[EmcyCode, int], bytes] = {}
        self._history: deque[int] = deque(maxlen=od.ERROR_FIELD_LENGTH)  # the newest first
        self._waiting: deque[bytes] = deque()
        self._lost = 0  # messages that gave way, and nobody knows yet
        self._sent_ns = -NO_DEADLINE_NS
        self._allowed = False
        self._connect()

    @property
    def register(self) -> int:
        """Error register: bit 0 is set as long as any error is present."""
        bits = 0
        for code, _ in self._present:
            bits |= code.register_bit | 1
        return bits

    @property
    def deadline_ns(self) -> int:
        """When a waiting message may be sent."""
        return self._free_ns if self._waiting and self._allowed else NO_DEADLINE_NS

    def happened(self, code: EmcyCode, detail: bytes, t_ns: int) -> None:
        """An error that is over as soon as it is told: it comes and goes, and both are told. ``detail`` is up
        to five bytes."""
        self._tell(code, self.register | code.register_bit | 1, detail, t_ns)
        self._tell_over(code, t_ns)

    def present(self, code: EmcyCode, detail: bytes, t_ns: int, who: int = 0) -> None:
        """An error that lasts until :meth:`over`; told again only if ``detail`` says something new. ``who``
        tells apart errors of one code that come and go by themselves."""
        if self._present.get((code, who)) != detail:
            self._present[code, who] = detail
            self._tell(code, self.register, detail, t_ns)

    def over(self, code: EmcyCode, t_ns: int, who: int = 0) -> None:
        """A lasting error has gone; nothing happens if it was not there."""
        if self._present.pop((code, who), None) is not None:
            self._tell_over(code, t_ns)

    def allow(self, allowed: bool, t_ns: int) -> None:
        """Whether the state of the node lets messages out; they wait otherwise."""
        self._allowed = allowed
        self._try(t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send what may be sent. What the bus refuses stays to be sent later."""
        cob_id = self._store.integer(od.COB_ID_EMCY) & COB_ID_MASK
        while self._waiting and self._allowed and t_ns >= self._free_ns:
            if self._lost:  # older than anything that waits
                self._send(cob_id, self._loss())
                self._lost = 0
            else:
                self._send(cob_id, self._waiting[0])
                self._waiting.popleft()
            self._sent_ns = t_ns

    def reset(self) -> None:
        """As after power-on."""
        self._present.clear()
        self._history.clear()
        self._waiting.clear()
        self._lost, self._sent_ns = 0, -NO_DEADLINE_NS

    def _tell(self, code: EmcyCode, register: int, detail: bytes, t_ns: int) -> None:
        self._remember(code, detail)
        self._queue(_message(code, register, detail), t_ns)

    def _tell_over(self, code: EmcyCode, t_ns: int) -> None:
        """An error reason is gone; the register holds what is left."""
        self._queue(_message(EmcyCode.RESET, self.register, code.to_bytes(2, "little")), t_ns)

    def _remember(self, code: EmcyCode, detail: bytes) -> None:
        # The upper half of an entry is ours: the first two bytes of the detail.
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
        """Send at once if the bus lets it. Whoever tells of an error has more to do because of it than to
        tell, so what the bus refuses is left to the next turn of the timer."""
        with contextlib.suppress(BusError):
            self.on_timer(t_ns)

    def _loss(self) -> bytes:
        """How many emergencies gave way; the first two bytes are those of the application's lost scans. Those
        that wait follow, and the last of them has the register as it is."""
        detail = struct.pack("<HH", 0, min(self._lost, 0xFFFF))
        self._remember(EmcyCode.CAN_OVERRUN, detail)
        return _message(EmcyCode.CAN_OVERRUN, self.register | EmcyCode.CAN_OVERRUN.register_bit | 1, detail)

    @property
    def _free_ns(self) -> int:
        """From when on the inhibit time lets out another message."""
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
        """The count at sub-index 0, then the errors, the newest first."""
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
        if not self._exists:  # nobody wants to hear of it later what was told to nobody
            self._waiting.clear()
            self._lost = 0


def _message(code: EmcyCode, register: int, detail: bytes) -> bytes:
    return code.to_bytes(2, "little") + bytes((register,)) + detail[:5].ljust(5, b"\0")


def _only_zero(_: int, value: int) -> None:
    if value:
        raise Refused(AbortCode.INVALID_VALUE)
