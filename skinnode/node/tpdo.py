"""The TPDO engine: transmits what the object dictionary says, when it says so. No clock of its own.

What a TPDO carries follows from the first object mapped into it:

========  ==================  ==========================================================================
content   first object        sent
========  ==================  ==========================================================================
chunks    0x2010              once per chunk of a scan, paced by the inhibit time
summary   0x2011              when the scan has been sent; by a synchronous TPDO whose turn it was not at the
                              scan's SYNC, after the next SYNC whose turn it is
values    any other           synchronous: after the SYNC (type 0: if they changed); event-driven: when a scan
                              has been sent and when the event timer elapses
========  ==================  ==========================================================================

Pacing. The standard's inhibit time is a shortest distance. A thread of a general-purpose system wakes late,
and distances that only ever grow would let a scan outgrow its SYNC period; so lateness up to ``catch_up_ns``
is made up for, with several frames at once if need be, while the mean rate is never exceeded (the generic
cell rate algorithm, ITU-T I.371). With ``catch_up_ns = 0`` the shortest distance is strict.

A scan that is offered while one is being sent waits for it to end, and there is room for one to wait. Chunks
of two scans are never sent in turns, and a scan once begun is sent whole unless the node leaves OPERATIONAL
or its chunk TPDO is disabled; then its summary says so, or there is none.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from skinnode.node.clock import NO_DEADLINE_NS, Clock
from skinnode.node.od import ObjectStore
from skinnode.node.pdo import PdoRecords
from skinnode.wire import indices as od
from skinnode.wire.codec import SummaryFlag, pack_summary

Send = Callable[[int, bytes], None]


@dataclass(frozen=True, slots=True)
class OutgoingScan:
    """A scan ready to be sent."""

    counter: int
    chunks: list[bytes]
    """Payloads of the chunk record, in order; only those to be sent."""
    flags: int
    device_time_us: int
    turns: frozenset[int] = frozenset()
    """Numbers of the synchronous TPDOs whose turn it was at the SYNC that started the scan."""


class _Content(Enum):
    CHUNKS = auto()
    SUMMARY = auto()
    VALUES = auto()


class _Tpdo:
    """One TPDO: its parameters and when it may send next."""

    def __init__(self, number: int, records: PdoRecords, store: ObjectStore) -> None:
        self.number, self._records, self._store = number, records, store
        self.ready_ns = 0
        """From when on the inhibit time allows to send again."""
        self.timer_ns = NO_DEADLINE_NS
        """When the event timer elapses."""
        self.waiting = False
        """There is something to tell, but neither SYNC nor inhibit time have let it out yet."""
        self.last: bytes | None = None
        self._in_step = False
        self._syncs = 0
        self.parameters = records.read()
        self.content, self.whole_record = self._classify()

    def reload(self, t_ns: int) -> None:
        """Take over parameters that were written."""
        old, new = self.parameters, self._records.read()
        self.parameters = new
        self.content, self.whole_record = self._classify()
        if (old.enabled, old.kind, old.sync_start) != (new.enabled, new.kind, new.sync_start):
            self._in_step, self._syncs = False, 0
        if (old.enabled, old.kind, old.event_timer_ns) != (new.enabled, new.kind, new.event_timer_ns):
            self.start_timer(t_ns)

    def _classify(self) -> tuple[_Content, bool]:
        mapping = self.parameters.mapping
        contents = {od.CHUNK: _Content.CHUNKS, od.SUMMARY: _Content.SUMMARY}
        content = contents.get(mapping[0][0], _Content.VALUES) if mapping else _Content.VALUES
        if content is _Content.VALUES:
            return content, False
        index = mapping[0][0]
        record = tuple((index, sub) for sub in range(1, self._store.integer(index, 0) + 1))
        return content, mapping == record

    def start(self, t_ns: int) -> None:
        """The node became OPERATIONAL."""
        self.waiting, self.last, self._in_step, self._syncs = False, None, False, 0
        self.start_timer(t_ns)

    def start_timer(self, t_ns: int) -> None:
        """Run the event timer anew, if the TPDO has one."""
        parameters = self.parameters
        timed = parameters.enabled and parameters.event_driven and self.content is not _Content.CHUNKS
        timed = timed and parameters.event_timer_ns > 0
        self.timer_ns = t_ns + parameters.event_timer_ns if timed else NO_DEADLINE_NS

    def turn(self, counter: int | None) -> bool:
        """Count a SYNC; True if this TPDO is synchronous and it is its turn."""
        parameters = self.parameters
        if not parameters.enabled or parameters.event_driven:
            return False
        if not self._in_step and parameters.sync_start and counter is not None:
            if counter != parameters.sync_start:
                return False
            self._in_step, self._syncs = True, 0
            return True  # the SYNC with the start value is the first of the cycle
        self._syncs += 1
        if self._syncs < max(parameters.kind, 1):
            return False
        self._syncs = 0
        return True

    def takes_part(self, scan: OutgoingScan) -> bool:
        """Whether it is this TPDO's turn to carry a part of ``scan``."""
        return self.parameters.enabled and (self.parameters.event_driven or self.number in scan.turns)

    @property
    def deadline_ns(self) -> int:
        held = self.waiting and self.parameters.event_driven
        return min(self.timer_ns, self.ready_ns) if held else self.timer_ns


class TpdoEngine:
    """The TPDOs of a node, and the scans that pass through them. ``now`` is the time of the event being
    handled."""

    def __init__(self, store: ObjectStore, count: int, send: Send, now: Clock, catch_up_ns: int) -> None:
        self._store, self._send, self._now, self._catch_up_ns = store, send, now, catch_up_ns
        self._tpdos: list[_Tpdo] = []
        for number in range(count):
            parameter, mapping = od.TPDO1_PARAMETER + number, od.TPDO1_MAPPING + number
            records = PdoRecords(store, parameter, mapping, transmits=True)
            self._tpdos.append(_Tpdo(number, records, store))
            for index in (parameter, mapping):
                store.watch(index, functools.partial(self._on_written, number))
        self._running = False
        self._scan: OutgoingScan | None = None
        self._next_scan: OutgoingScan | None = None
        self._unsent: deque[bytes] = deque()
        self._carrier: _Tpdo | None = None  # of the chunks of the scan being sent
        self._chunks_sent = 0
        self.chunk = bytes(64)
        """The chunk record (0x2010) as last sent, zeros before the first; over CAN FD up to 64 bytes."""
        self.summary = bytes(8)
        """The summary record (0x2011) of the last scan."""
        self.scans_sent = 0
        self.deadline_ns = NO_DEADLINE_NS
        """When :meth:`on_timer` has something to do."""

    @property
    def full(self) -> bool:
        """Whether a scan is being sent and another one waits already."""
        return self._next_scan is not None

    def restore(self) -> None:
        """All parameters have changed at once: a reset."""
        for number in range(len(self._tpdos)):
            self._reload(number)

    def _on_written(self, number: int, _subindex: int) -> None:
        self._reload(number)

    def _reload(self, number: int) -> None:
        tpdo = self._tpdos[number]
        tpdo.reload(self._now())
        if tpdo is self._carrier and not (tpdo.parameters.enabled and tpdo.content is _Content.CHUNKS):
            self._unsent.clear()
            self._carrier = None
        self._plan()

    def start(self, t_ns: int) -> None:
        """The node became OPERATIONAL."""
        self._running = True
        for tpdo in self._tpdos:
            tpdo.start(t_ns)
        self._plan()

    def stop(self) -> None:
        """The node left OPERATIONAL: a scan in progress ends without a summary."""
        self._running = False
        self._unsent.clear()
        self._scan = self._next_scan = self._carrier = None
        self._plan()

    def on_sync(self, counter: int | None, t_ns: int) -> frozenset[int]:
        """Send the values whose turn it is. Returns the numbers of all synchronous TPDOs whose turn it is,
        for the scan that starts here. ``counter`` is the SYNC counter, None without one."""
        turns = frozenset([tpdo.number for tpdo in self._tpdos if tpdo.turn(counter)])
        for tpdo in self._tpdos:
            if tpdo.number not in turns or tpdo.content is _Content.CHUNKS:
                continue
            if tpdo.content is _Content.VALUES:
                payload = self._payload(tpdo)
                if tpdo.parameters.kind or payload != tpdo.last:
                    self._transmit(tpdo, payload, t_ns)
            elif tpdo.waiting:
                self._transmit(tpdo, self._payload(tpdo), t_ns)
        return turns

    def offer(self, scan: OutgoingScan, t_ns: int) -> None:
        """Send ``scan``, at once or after the one being sent. Must not be called while :attr:`full`."""
        if self._scan is None:
            self._begin(scan, t_ns)
        else:
            self._next_scan = scan
        self.on_timer(t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send everything that is due at ``t_ns``."""
        if not self._running:
            return
        while self._scan is not None and self._stream(t_ns):
            self._end(self._scan, t_ns)
            self._scan, following, self._next_scan = None, self._next_scan, None
            if following is not None:
                self._begin(following, t_ns)
        for tpdo in self._tpdos:
            if t_ns >= tpdo.timer_ns:
                tpdo.waiting = True
                tpdo.start_timer(t_ns)
            if tpdo.waiting and tpdo.parameters.event_driven and t_ns >= tpdo.ready_ns:
                self._transmit(tpdo, self._payload(tpdo), t_ns)
        self._plan()

    def _begin(self, scan: OutgoingScan, t_ns: int) -> None:
        self._scan, self._carrier, self._chunks_sent = scan, None, 0
        for tpdo in self._tpdos:
            if tpdo.content is _Content.CHUNKS and tpdo.takes_part(scan):
                self._carrier = tpdo
                self._unsent.extend(scan.chunks)
                tpdo.ready_ns = max(tpdo.ready_ns, t_ns)  # an idle while earns no burst
                return

    def _stream(self, t_ns: int) -> bool:
        """Send the chunks that the pace allows. True when there are no more."""
        unsent, carrier = self._unsent, self._carrier
        if carrier is None:
            return True
        cob_id, inhibit_ns = carrier.parameters.cob_id, carrier.parameters.inhibit_ns
        earliest_ns = t_ns - self._catch_up_ns
        while unsent and carrier.ready_ns <= t_ns:
            self.chunk = unsent.popleft()
            carrier.ready_ns = max(carrier.ready_ns, earliest_ns) + inhibit_ns
            self._send(cob_id, self.chunk if carrier.whole_record else self._payload(carrier))
            self._chunks_sent += 1  # after it has been sent: a bus may refuse it
        return not unsent

    def _end(self, scan: OutgoingScan, t_ns: int) -> None:
        flags = scan.flags if self._chunks_sent == len(scan.chunks) else scan.flags | SummaryFlag.OVERRUN
        self.summary = pack_summary(scan.counter, flags, self._chunks_sent, scan.device_time_us)
        self.scans_sent += 1
        for tpdo in self._tpdos:
            if tpdo.content is _Content.SUMMARY:
                tpdo.waiting = tpdo.parameters.enabled
                if tpdo.number in scan.turns:
                    self._transmit(tpdo, self._payload(tpdo), t_ns)
            elif tpdo.content is _Content.VALUES and tpdo.parameters.event_driven:
                tpdo.waiting = tpdo.parameters.enabled

    def _payload(self, tpdo: _Tpdo) -> bytes:
        if tpdo.whole_record:
            return self.chunk if tpdo.content is _Content.CHUNKS else self.summary
        raw = self._store.raw
        return b"".join([raw(index, subindex) for index, subindex in tpdo.parameters.mapping])

    def _transmit(self, tpdo: _Tpdo, payload: bytes, t_ns: int) -> None:
        tpdo.last, tpdo.waiting = payload, False
        tpdo.ready_ns = t_ns + tpdo.parameters.inhibit_ns
        tpdo.start_timer(t_ns)
        self._send(tpdo.parameters.cob_id, payload)

    def _plan(self) -> None:
        if not self._running:
            self.deadline_ns = NO_DEADLINE_NS
            return
        deadline_ns = min([tpdo.deadline_ns for tpdo in self._tpdos])
        if self._scan is not None:
            ready_ns = self._carrier.ready_ns if self._carrier is not None else 0
            deadline_ns = min(deadline_ns, ready_ns)
        self.deadline_ns = deadline_ns
