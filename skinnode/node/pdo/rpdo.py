"""RPDOs: takes what others send and writes it into the object dictionary (CiA 301 v4.2, 7.2.2 and 7.5.2.33).

Types 0 to 240 act at the next SYNC on the last PDO received within the synchronous window (0x1007), 254 and
255 at once. Bytes beyond the mapping are
left alone, a PDO that is too short is not taken at all; both are told by EMCY once, until the length is right
again. An event timer watches over its RPDO from the first one on that comes, in OPERATIONAL.
"""

from __future__ import annotations

import contextlib
import functools

from skinnode.canopen import indices as od
from skinnode.canopen.abort import Refused
from skinnode.canopen.data_length import fd_length
from skinnode.canopen.emergency import EmcyCode
from skinnode.node.clock import NO_DEADLINE_NS, Clock
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pdo.parameters import PdoRecords
from skinnode.node.rejected import Rejected, RejectedFrames
from skinnode.node.sync import SyncWindow
from skinnode.node.timers import Timers


class _Rpdo:
    """One RPDO: its parameters, and what is wrong with it."""

    def __init__(self, number: int, records: PdoRecords) -> None:
        self.number, self._records = number, records
        self.wrong: EmcyCode | None = None
        """What was told about the length of the last one."""
        self.parameters = records.read()
        self.fields = self._fields()

    def reload(self) -> None:
        """Take over parameters that were written."""
        self.parameters = self._records.read()
        self.fields = self._fields()

    def _fields(self) -> list[tuple[int, int, int, int]]:
        """Index, sub-index, first byte and the one after the last, of everything but dummies."""
        at, fields = 0, []
        for each in self.parameters.mapping:
            if each.index not in od.DUMMY_BITS:
                fields.append((each.index, each.subindex, at, at + each.size))
            at += each.size
        return fields


class RpdoEngine:
    """The RPDOs of a node. ``now`` is the time of the event being handled."""

    def __init__(
        self,
        store: ObjectStore,
        count: int,
        emcy: EmcyProducer,
        rejected: RejectedFrames,
        now: Clock,
        window: SyncWindow,
    ) -> None:
        self._store, self._emcy, self._rejected, self._now = store, emcy, rejected, now
        self._window = window
        self._operational = False
        self._timers = Timers()
        self._by_cob_id: dict[int, list[_Rpdo]] = {}
        self._pending: dict[int, bytes] = {}  # of synchronous ones, until the next SYNC
        # Numbers of those with an error that lasts.
        self._short: set[int] = set()
        self._late: set[int] = set()
        self._rpdos: list[_Rpdo] = []
        for number in range(count):
            parameter, mapping = od.RPDO1_PARAMETER + number, od.RPDO1_MAPPING + number
            records = PdoRecords(store, parameter, mapping, transmits=False)
            self._rpdos.append(_Rpdo(number, records))
            for index in (parameter, mapping):
                store.watch(index, functools.partial(self._on_written, number))
        self.restore()

    @property
    def deadline_ns(self) -> int:
        """When an RPDO that is watched over is missed."""
        return self._timers.deadline_ns

    # --- parameters

    def restore(self) -> None:
        """All parameters may have changed at once, and all errors have been forgotten: a reset."""
        self._by_cob_id.clear()
        self._pending.clear()
        self._timers.clear()
        self._short.clear()
        self._late.clear()
        for rpdo in self._rpdos:
            rpdo.wrong = None
            self._load(rpdo)

    def _on_written(self, number: int, _subindex: int) -> None:
        rpdo = self._rpdos[number]
        others = self._by_cob_id.get(rpdo.parameters.cob_id, [])
        if rpdo in others:
            others.remove(rpdo)
        self._pending.pop(number, None)
        self._timers.set(number, NO_DEADLINE_NS)
        self._set_wrong(rpdo, None, b"", self._now())
        self._recover(self._late, number, EmcyCode.RPDO_TIMEOUT, self._now())
        self._load(rpdo)

    def _load(self, rpdo: _Rpdo) -> None:
        rpdo.reload()
        if rpdo.parameters.enabled:
            self._by_cob_id.setdefault(rpdo.parameters.cob_id, []).append(rpdo)

    # --- events

    def enter(self, *, operational: bool) -> None:
        """The node entered another state: what was received before is void, and nothing is waited for. None
        is late any more: the deadline is monitored in OPERATIONAL only (CiA 301 v4.2, 7.5.2.33)."""
        self._operational = operational
        self._pending.clear()
        self._timers.clear()
        for number in tuple(self._late):
            self._recover(self._late, number, EmcyCode.RPDO_TIMEOUT, self._now())

    def on_frame(self, cob_id: int, data: bytes, t_ns: int) -> None:
        """A frame came; it may be an RPDO, or several that share the COB-ID."""
        if self._operational:
            for rpdo in tuple(self._by_cob_id.get(cob_id, ())):
                self._receive(rpdo, data, t_ns)

    def on_sync(self) -> None:
        """Act on the synchronous ones that came since the last SYNC."""
        pending, self._pending = self._pending, {}
        for number in sorted(pending):
            self._execute(self._rpdos[number], pending[number])

    def on_timer(self, t_ns: int) -> None:
        """Tell of those that have not come in time. They are waited for again from their next one on."""
        for number in self._timers.take(t_ns):
            self._late.add(number)
            self._emcy.present(EmcyCode.RPDO_TIMEOUT, (number + 1).to_bytes(2, "little"), t_ns)

    def _receive(self, rpdo: _Rpdo, data: bytes, t_ns: int) -> None:
        parameters = rpdo.parameters
        wrong = None
        if len(data) < parameters.size:
            wrong = EmcyCode.PDO_NOT_PROCESSED
        elif len(data) > fd_length(parameters.size):  # of a classic frame that is what is mapped itself
            wrong = EmcyCode.PDO_LENGTH_EXCEEDED
        self._set_wrong(rpdo, wrong, data, t_ns)
        if wrong is EmcyCode.PDO_NOT_PROCESSED:
            self._rejected.count(Rejected.RPDO)
            return
        self._recover(self._late, rpdo.number, EmcyCode.RPDO_TIMEOUT, t_ns)
        if parameters.event_timer_ns:
            self._timers.set(rpdo.number, t_ns + parameters.event_timer_ns)
        if parameters.event_driven:
            self._execute(rpdo, data)
        elif self._window.is_open(t_ns):
            self._pending[rpdo.number] = data

    def _execute(self, rpdo: _Rpdo, data: bytes) -> None:
        """Write the objects mapped. One that refuses its value does not keep the others from theirs: process
        data have no way to answer."""
        for index, subindex, start, end in rpdo.fields:
            with contextlib.suppress(Refused):
                self._store.write(index, subindex, data[start:end])

    # --- errors

    def _set_wrong(self, rpdo: _Rpdo, wrong: EmcyCode | None, data: bytes, t_ns: int) -> None:
        """Tell of a length that is wrong in another way than before, and of the end of one too short."""
        if wrong is rpdo.wrong:
            return
        rpdo.wrong = wrong
        number = rpdo.number + 1
        detail = bytes((number & 0xFF, len(data), rpdo.parameters.size, number >> 8))
        if wrong is EmcyCode.PDO_NOT_PROCESSED:
            self._short.add(rpdo.number)
            self._emcy.present(wrong, detail, t_ns)
            return
        self._recover(self._short, rpdo.number, EmcyCode.PDO_NOT_PROCESSED, t_ns)
        if wrong is not None:
            self._emcy.happened(wrong, detail, t_ns)

    def _recover(self, faulty: set[int], number: int, code: EmcyCode, t_ns: int) -> None:
        if number in faulty:
            faulty.discard(number)
            if not faulty:
                self._emcy.over(code, t_ns)
