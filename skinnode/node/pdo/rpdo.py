"""RPDO engine: writes received RPDOs to the object dictionary (CiA 301 v4.2, 7.2.2 and 7.5.2.33).

- Types 0 to 240: applied at the next SYNC, if received within the synchronous window (0x1007). If an RPDO is
  received several times between two SYNCs, only the last one counts.
- Types 254 and 255: applied immediately.

Excess bytes are ignored. An RPDO that is too short is not applied. Length errors are reported in emergency
messages, but not again while the same error persists. The event timer monitors an RPDO once it has been
received for the first time in OPERATIONAL.
"""

from __future__ import annotations

import functools

from skinnode.canopen import indices as od
from skinnode.canopen.abort import Refused
from skinnode.canopen.data_length import fd_length
from skinnode.canopen.emergency import EmcyCode
from skinnode.errors import BusError
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.pdo.parameters import PdoRecords
from skinnode.node.rejected import Rejected
from skinnode.node.services import NodeServices
from skinnode.node.sync import SyncWindow
from skinnode.node.timers import Timers


class _Rpdo:
    """Parameters and state of one RPDO."""

    def __init__(self, number: int, records: PdoRecords) -> None:
        self.number, self._records = number, records
        self.wrong: EmcyCode | None = None
        """Length error of the last frame received; None if its length was correct."""
        self.parameters = records.read()
        self.fields = self._fields()

    def reload(self) -> None:
        """Apply the parameters in the object dictionary."""
        self.parameters = self._records.read()
        self.fields = self._fields()

    def _fields(self) -> list[tuple[int, int, int, int]]:
        """Return the index, sub-index, first byte and end byte of each mapped object except dummies."""
        at, fields = 0, []
        for each in self.parameters.mapping:
            if each.index not in od.DUMMY_BITS:
                fields.append((each.index, each.subindex, at, at + each.size))
            at += each.size
        return fields


class RpdoEngine:
    """Receives the RPDOs of a node.

    Args:
        services: Resources that all services of the node share.
        count: Number of RPDOs.
        window: Synchronous window of the node.
    """

    def __init__(self, services: NodeServices, count: int, window: SyncWindow) -> None:
        store = services.store
        self._store, self._emcy, self._rejected = store, services.emcy, services.rejected
        self._now, self._window = services.now, window
        self._operational = False
        self._timers = Timers()
        self._by_cob_id: dict[int, list[_Rpdo]] = {}
        self._pending: dict[int, bytes] = {}  # payloads to apply at the next SYNC, by RPDO number

        # numbers of the RPDOs with an active error: too short or overdue
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
        """Earliest time (ns) at which a monitored RPDO is overdue."""
        return self._timers.deadline_ns

    # --- parameters

    def restore(self) -> None:
        """Apply the parameters of all RPDOs after a reset and discard all errors."""
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
        """Handle a change in the NMT state.

        Pending RPDOs are dropped. Deadlines are monitored only in OPERATIONAL (CiA 301 v4.2, 7.5.2.33), so
        monitoring stops and RPDO timeout errors end.
        """
        self._operational = operational
        self._pending.clear()
        self._timers.clear()
        for number in tuple(self._late):
            self._recover(self._late, number, EmcyCode.RPDO_TIMEOUT, self._now())

    def on_frame(self, cob_id: int, data: bytes, t_ns: int) -> None:
        """Handle a frame, which may belong to several RPDOs.

        Args:
            cob_id: Identifier of the frame.
            data: Payload of the frame.
            t_ns: Arrival time, in ns.
        """
        if self._operational:
            for rpdo in tuple(self._by_cob_id.get(cob_id, ())):
                self._receive(rpdo, data, t_ns)

    def on_sync(self) -> None:
        """Apply the synchronous RPDOs received since the last SYNC."""
        pending, self._pending = self._pending, {}
        for number in sorted(pending):
            self._execute(self._rpdos[number], pending[number])

    def on_timer(self, t_ns: int) -> None:
        """Report each overdue RPDO. Monitoring restarts when the RPDO is received again."""
        for number in self._timers.take(t_ns):
            self._late.add(number)
            self._emcy.report(EmcyCode.RPDO_TIMEOUT, (number + 1).to_bytes(2, "little"), t_ns)

    def _receive(self, rpdo: _Rpdo, data: bytes, t_ns: int) -> None:
        parameters = rpdo.parameters
        wrong = None
        if len(data) < parameters.size:
            wrong = EmcyCode.PDO_NOT_PROCESSED
        elif len(data) > fd_length(parameters.size):  # CAN FD payloads may be padded
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
        """Write the mapped objects. Refused values are ignored, because a PDO has no response.

        Writing an object may trigger a frame that the bus refuses, such as the first chunk of a single scan.
        The other objects are still written before the error is raised.
        """
        failure: BusError | None = None
        for index, subindex, start, end in rpdo.fields:
            try:
                self._store.write(index, subindex, data[start:end])
            except Refused:
                continue
            except BusError as error:
                failure = error
        if failure is not None:
            raise failure

    # --- errors

    def _set_wrong(self, rpdo: _Rpdo, wrong: EmcyCode | None, data: bytes, t_ns: int) -> None:
        """Report the beginning or the end of a length error."""
        if wrong is rpdo.wrong:
            return
        rpdo.wrong = wrong
        number = rpdo.number + 1
        detail = bytes((number & 0xFF, len(data), rpdo.parameters.size, number >> 8))
        if wrong is EmcyCode.PDO_NOT_PROCESSED:
            self._short.add(rpdo.number)
            self._emcy.report(wrong, detail, t_ns)
            return
        self._recover(self._short, rpdo.number, EmcyCode.PDO_NOT_PROCESSED, t_ns)
        if wrong is not None:
            self._emcy.report_once(wrong, detail, t_ns)

    def _recover(self, faulty: set[int], number: int, code: EmcyCode, t_ns: int) -> None:
        if number in faulty:
            faulty.discard(number)
            if not faulty:
                self._emcy.clear(code, t_ns)
