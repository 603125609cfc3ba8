"""TPDO engine (CiA 301 v4.2, 7.2.2 and 7.5.2.37).

=========  =======================================================================================
type       sent
=========  =======================================================================================
0          after a SYNC, if the values have changed since the last transmission
1 to 240   after every n-th SYNC, counted from the SYNC start value if one is set
252        on a remote frame, with the values from the last SYNC; not before the first SYNC
253        on a remote frame
254, 255   on an event (:meth:`TpdoEngine.trigger`), when the event timer elapses, and on a remote frame;
           never before the inhibit time has passed
=========  =======================================================================================

An application can *claim* an object. It then owns all TPDOs whose first mapped object is the claimed object
and sends them itself: SYNCs and events do not trigger them. The engine still counts SYNCs, answers remote
frames and runs the event timers of these TPDOs.

The time to handle a SYNC is proportional to the number of enabled TPDOs that are sent or sampled on SYNCs.
The time to handle a timer event is proportional to the number of TPDOs that are due.
"""

from __future__ import annotations

import functools
from bisect import bisect_left
from collections.abc import Collection
from typing import Protocol

from skinnode.canopen import indices as od
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.pdo.parameters import COB_ID_MASK, INVALID_BIT, REMOTE, SYNC_REMOTE, PdoRecords
from skinnode.node.services import NodeServices
from skinnode.node.sync import SyncWindow
from skinnode.node.timers import Timers


class Tpdo:
    """Parameters and state of one TPDO.

    Args:
        number: Number of the TPDO, counted from 0.
        records: Records of the TPDO in the object dictionary.
    """

    def __init__(self, number: int, records: PdoRecords) -> None:
        self.number, self._records = number, records
        self.ready_ns = -NO_DEADLINE_NS
        """Time (ns) at which the inhibit time ends."""
        self.timer_ns = NO_DEADLINE_NS
        """Time (ns) at which the event timer elapses."""
        self.waiting = False
        """Whether the TPDO is waiting for a SYNC or for the end of the inhibit time."""
        self.last: bytes | None = None
        """Last payload sent or, for type 252, sampled; None before the first payload."""
        self.owner: Owner | None = None
        """Owner that sends the TPDO; None if the engine sends it."""
        self._in_step = False
        self._syncs = 0
        self.parameters = records.read()

    @property
    def first_index(self) -> int:
        """Index of the first mapped object; 0 if none is mapped."""
        mapping = self.parameters.mapping
        return mapping[0].index if mapping else 0

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which the event timer or the inhibit time of a waiting TPDO elapses."""
        held = self.waiting and self.parameters.event_driven
        return min(self.timer_ns, self.ready_ns) if held else self.timer_ns

    def reload(self, t_ns: int) -> None:
        """Apply the parameters in the object dictionary."""
        old, new = self.parameters, self._records.read()
        self.parameters = new
        self.ready_ns += new.inhibit_ns - old.inhibit_ns  # counted from the last transmission
        if (old.enabled, old.kind, old.sync_start) != (new.enabled, new.kind, new.sync_start):
            self.waiting, self.last, self._in_step, self._syncs = False, None, False, 0
        if (old.enabled, old.kind, old.event_timer_ns) != (new.enabled, new.kind, new.event_timer_ns):
            self.start_timer(t_ns)

    def start(self, t_ns: int) -> None:
        """Reset the state and start the event timer when the node enters OPERATIONAL."""
        self.waiting, self.last, self._in_step, self._syncs = False, None, False, 0
        self.start_timer(t_ns)

    def start_timer(self, t_ns: int) -> None:
        """Restart the event timer, if one is configured."""
        parameters = self.parameters
        timed = parameters.enabled and parameters.event_driven and parameters.event_timer_ns > 0
        self.timer_ns = t_ns + parameters.event_timer_ns if timed else NO_DEADLINE_NS

    def elapse(self, t_ns: int) -> None:
        """Restart the event timer after it has elapsed.

        The new period begins at the end of the previous period. After a delay of one period or more, it
        begins at ``t_ns``.
        """
        self.timer_ns += self.parameters.event_timer_ns
        if self.timer_ns <= t_ns:
            self.start_timer(t_ns)

    def turn(self, counter: int | None) -> bool:
        """Count a SYNC.

        Args:
            counter: SYNC counter; None if the SYNC contains no counter.

        Returns:
            Whether this synchronous TPDO is due at this SYNC.
        """
        parameters = self.parameters
        if not self._in_step and parameters.sync_start and counter is not None:
            if counter != parameters.sync_start:
                return False
            self._in_step, self._syncs = True, 0
            return True  # the SYNC with the start value counts as the first
        self._syncs += 1
        if self._syncs < parameters.kind:
            return False
        self._syncs = 0
        return True


class Owner(Protocol):
    """Part of an application that sends the TPDOs whose first mapped object it has claimed."""

    def sends(self, tpdo: Tpdo) -> bool:
        """Return whether the owner is about to send this TPDO without a trigger."""
        ...

    def on_reload(self, tpdo: Tpdo) -> None:
        """Handle a change in a TPDO's parameters or owner."""
        ...


class TpdoEngine:
    """Sends the TPDOs of a node.

    Args:
        services: Resources that all services of the node share.
        count: Number of TPDOs.
        window: Synchronous window of the node.
    """

    def __init__(self, services: NodeServices, count: int, window: SyncWindow) -> None:
        store = services.store
        self._store, self._send, self._now = store, services.send, services.now
        self.window = window
        """Synchronous window (0x1007), which owners must observe for synchronous TPDOs."""
        self._claims: dict[int, Owner] = {}
        self._running = False
        self._timers = Timers()
        # Numbers of enabled TPDOs in ascending order: TPDOs sent or sampled on a SYNC, TPDOs sent on events,
        # and TPDOs with an owner.
        self._listening: list[int] = []
        self._eventful: list[int] = []
        self._owned: list[int] = []
        self._by_cob_id: dict[int, Tpdo] = {}
        self._tpdos: list[Tpdo] = []
        for number in range(count):
            parameter, mapping = od.TPDO1_PARAMETER + number, od.TPDO1_MAPPING + number
            records = PdoRecords(store, parameter, mapping, transmits=True, taken=self._taken)
            self._tpdos.append(Tpdo(number, records))
            for index in (parameter, mapping):
                store.watch(index, functools.partial(self._on_written, number))
        self.restore()

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which :meth:`on_timer` must be called next."""
        return self._timers.deadline_ns

    def claim(self, index: int, owner: Owner) -> None:
        """Claim the object at ``index`` for ``owner``."""
        self._claims[index] = owner
        self.restore()

    def owned(self, index: int) -> list[Tpdo]:
        """Return the enabled TPDOs whose first mapped object is the claimed object at ``index``."""
        return [tpdo for tpdo in map(self._tpdos.__getitem__, self._owned) if tpdo.first_index == index]

    # --- parameters

    def restore(self) -> None:
        """Apply the parameters of all TPDOs after a reset."""
        for number in range(len(self._tpdos)):
            self._reload(number)

    def _on_written(self, number: int, _subindex: int) -> None:
        self._reload(number)

    def _reload(self, number: int) -> None:
        tpdo = self._tpdos[number]
        former, before = tpdo.owner, tpdo.parameters
        if self._by_cob_id.get(before.cob_id) is tpdo:
            del self._by_cob_id[before.cob_id]
        tpdo.reload(self._now())
        now = tpdo.parameters
        tpdo.owner = self._claims.get(tpdo.first_index)
        if now.enabled:
            self._by_cob_id[now.cob_id] = tpdo
        listens = now.synchronous or now.kind == SYNC_REMOTE
        _keep(self._listening, number, now.enabled and listens)
        _keep(self._eventful, number, now.enabled and now.event_driven and tpdo.owner is None)
        _keep(self._owned, number, now.enabled and tpdo.owner is not None)
        for owner in {former, tpdo.owner}:
            if owner is not None:
                owner.on_reload(tpdo)
        self._plan(tpdo)

    def _taken(self, cob_id: int) -> bool:
        # While parameters are being restored, only the object dictionary has the new COB-IDs.
        numbers = range(od.TPDO1_PARAMETER, od.TPDO1_PARAMETER + len(self._tpdos))
        words = [self._store.integer(index, od.PDO_COB_ID) for index in numbers]
        return any(not word & INVALID_BIT and word & COB_ID_MASK == cob_id for word in words)

    # --- events

    def start(self, t_ns: int) -> None:
        """Start all TPDOs when the node enters OPERATIONAL."""
        self._running = True
        for tpdo in self._tpdos:
            tpdo.start(t_ns)
            self._plan(tpdo)

    def stop(self) -> None:
        """Stop all TPDOs when the node leaves OPERATIONAL."""
        self._running = False
        self._timers.clear()

    def count_sync(self, counter: int | None) -> frozenset[int]:
        """Count a SYNC for all synchronous TPDOs.

        Args:
            counter: SYNC counter; None if the SYNC contains no counter.

        Returns:
            Numbers of the synchronous TPDOs that are due.
        """
        tpdos = [self._tpdos[number] for number in self._listening]
        return frozenset(
            [each.number for each in tpdos if each.parameters.synchronous and each.turn(counter)]
        )

    def on_sync(self, turns: Collection[int], t_ns: int) -> None:
        """Send the synchronous TPDOs that are due, and sample the TPDOs of type 252.

        The application must already have handled the SYNC.

        Args:
            turns: Numbers of the synchronous TPDOs that are due.
            t_ns: Arrival time of the SYNC, ns.
        """
        for number in tuple(self._listening):
            tpdo = self._tpdos[number]
            if tpdo.parameters.kind == SYNC_REMOTE:
                tpdo.last = self.payload(tpdo)
            elif number in turns and tpdo.owner is None:
                payload = self.payload(tpdo)
                if tpdo.parameters.kind or payload != tpdo.last:
                    self._transmit(tpdo, payload, t_ns)

    def trigger(self, t_ns: int) -> None:
        """Signal an event, which triggers all event-driven TPDOs without an owner."""
        for number in tuple(self._eventful):
            self.request(self._tpdos[number], t_ns)

    def request(self, tpdo: Tpdo, t_ns: int) -> None:
        """Send an event-driven TPDO as soon as its inhibit time has elapsed."""
        tpdo.waiting = True
        self._let_out(tpdo, t_ns)

    def on_remote(self, cob_id: int, t_ns: int) -> None:
        """Send the TPDO requested by a remote frame. Synchronous TPDOs ignore it (CiA 301, 7.2.2.3)."""
        tpdo = self._by_cob_id.get(cob_id)
        if tpdo is None or not tpdo.parameters.answers_rtr or self._sent_anyway(tpdo):
            return
        parameters = tpdo.parameters
        if parameters.event_driven:
            self.request(tpdo, t_ns)
        elif parameters.kind == REMOTE:
            self._transmit(tpdo, self.payload(tpdo), t_ns)
        elif parameters.kind == SYNC_REMOTE and tpdo.last is not None:
            self._transmit(tpdo, tpdo.last, t_ns)

    def on_timer(self, t_ns: int) -> None:
        """Send all TPDOs that are due at ``t_ns``."""
        for number in self._timers.take(t_ns):
            tpdo = self._tpdos[number]
            if t_ns >= tpdo.timer_ns:
                tpdo.elapse(t_ns)
                tpdo.waiting = tpdo.waiting or not self._sent_anyway(tpdo)
                self._let_out(tpdo, t_ns, timer=False)
            else:
                self._let_out(tpdo, t_ns)

    def _sent_anyway(self, tpdo: Tpdo) -> bool:
        return tpdo.owner is not None and tpdo.owner.sends(tpdo)

    # --- sending

    def payload(self, tpdo: Tpdo) -> bytes:
        """Return the payload of a TPDO: the current values of its mapped objects."""
        raw = self._store.raw
        return b"".join([raw(each.index, each.subindex) for each in tpdo.parameters.mapping])

    def emit(self, tpdo: Tpdo, payload: bytes) -> None:
        """Send a payload immediately, regardless of the inhibit time; used by owners."""
        self._send(tpdo.parameters.cob_id, payload)

    def transmit(self, tpdo: Tpdo, t_ns: int) -> None:
        """Send a synchronous TPDO, or discard it if the synchronous window (0x1007) is closed."""
        if self.window.lets_out(tpdo.number, t_ns):
            self._transmit(tpdo, self.payload(tpdo), t_ns)
        else:
            tpdo.waiting = False

    def _let_out(self, tpdo: Tpdo, t_ns: int, *, timer: bool = True) -> None:
        if tpdo.waiting and t_ns >= tpdo.ready_ns:
            self._transmit(tpdo, self.payload(tpdo), t_ns, timer=timer)
        else:
            self._plan(tpdo)

    def _transmit(self, tpdo: Tpdo, payload: bytes, t_ns: int, *, timer: bool = True) -> None:
        """Send a payload and start the inhibit time. If ``timer`` is true, also restart the event timer."""
        tpdo.last, tpdo.waiting = payload, False
        tpdo.ready_ns = t_ns + tpdo.parameters.inhibit_ns
        if timer:
            tpdo.start_timer(t_ns)
        self._plan(tpdo)
        # This comes last, because it may raise a BusError.
        self._send(tpdo.parameters.cob_id, payload)

    def _plan(self, tpdo: Tpdo) -> None:
        self._timers.set(tpdo.number, tpdo.deadline_ns if self._running else NO_DEADLINE_NS)


def _keep(numbers: list[int], number: int, wanted: bool) -> None:
    """Add ``number`` to the sorted list ``numbers`` if ``wanted`` is true; otherwise remove it."""
    at = bisect_left(numbers, number)
    there = at < len(numbers) and numbers[at] == number
    if wanted and not there:
        numbers.insert(at, number)
    elif there and not wanted:
        del numbers[at]
