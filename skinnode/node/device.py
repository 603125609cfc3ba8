"""A CANopen device: the communication of CiA 301 around an application.

Synchronous and deterministic: it has no thread and reads no clock. Whoever drives it hands it frames and
times and asks when it wants to be called again; :class:`~skinnode.node.runner.NodeRunner` does so on a bus, a
test does so with numbers. No frame whatever raises out of it; an error of the application does, and one of
``send``.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from skinnode.node.abort import AbortCode, Refused
from skinnode.node.clock import NO_DEADLINE_NS, Clock
from skinnode.node.emcy import EmcyCode, EmcyProducer
from skinnode.node.error_control import ErrorControl
from skinnode.node.nmt import AFTER_COMMAND, NmtCommand, NmtState, parse
from skinnode.node.od import ObjectStore
from skinnode.node.pdo import COB_ID_MASK, INVALID_BIT, PdoRecords, check_cob_id
from skinnode.node.rejected import Rejected, RejectedFrames
from skinnode.node.sdo import SdoServer
from skinnode.node.time_of_day import TimeConsumer
from skinnode.node.tpdo import TpdoEngine
from skinnode.wire import indices as od
from skinnode.wire.dictionary import Object
from skinnode.wire.timing import fd_length

HARDWARE_VERSION: Final = "none"
"""A node in software has no board."""

_COMMUNICATION: Final = 0x1000, 0x1FFF
_EVERYTHING: Final = 0x1000, 0x9FFF
_SYNC_PRODUCER_BIT: Final = 1 << 30

Send = Callable[[int, bytes], None]
"""Takes COB-ID and payload."""
Handler = Callable[[bytes, int], None]
"""Takes the payload of a frame and its time."""


class Application(Protocol):
    """What a device is for. Its objects are in the dictionary from the start."""

    @property
    def deadline_ns(self) -> int:
        """When :meth:`on_timer` has something to do."""
        ...

    def power_on(self, t_ns: int) -> None:
        """Before the boot-up message of a start; a reset is no start."""
        ...

    def reset(self) -> None:
        """The node was reset, its objects have their defaults."""
        ...

    def enter(self, *, operational: bool) -> None:
        """The node entered another state."""
        ...

    def on_sync(self, counter: int | None, turns: frozenset[int], t_ns: int) -> None:
        """A SYNC came, in OPERATIONAL; ``turns`` are the synchronous TPDOs whose turn it is."""
        ...

    def on_timer(self, t_ns: int) -> None:
        """Do what is due."""
        ...


@dataclass(frozen=True, slots=True)
class Services:
    """What a device offers its application."""

    store: ObjectStore
    tpdos: TpdoEngine
    emcy: EmcyProducer
    now: Clock


class CanopenDevice:
    """One node.

    Args:
        node_id: 1 to 127.
        objects: its object dictionary.
        application: made once, with the services of the device.
        send: called with COB-ID and payload of every frame the node sends, in order.
        serial: serial number (0x1018:4), u32.
        catch_up_ns: see :mod:`skinnode.node.tpdo`; 0 for a strict inhibit time.

    Raises ValueError for an argument out of range. The node is silent until :meth:`power_on`.
    """

    def __init__(
        self,
        node_id: int,
        objects: Sequence[Object],
        application: Callable[[Services], Application],
        *,
        send: Send,
        serial: int,
        catch_up_ns: int,
    ) -> None:
        if not 1 <= node_id <= 127:
            raise ValueError(f"node_id: got {node_id}, must be 1 to 127")
        if not 0 <= serial < 1 << 32:
            raise ValueError(f"serial: got {serial}, must be an unsigned number of 32 bits")
        self.node_id = node_id
        self.nmt_state = NmtState.INITIALISING
        self._send = send
        self._now_ns = 0
        self._store = ObjectStore(objects, node_id)
        self._sdo = SdoServer(self._store, self._send_sdo)
        self._rejected = RejectedFrames(self._store)
        self._emcy = EmcyProducer(self._store, send)
        self._error_control = ErrorControl(
            node_id,
            self._store,
            self._emcy,
            self._rejected,
            send,
            self._now,
            self._reload,
            self._communication_failed,
        )
        self._time = TimeConsumer(self._store, self._now)
        tpdos = sum(od.TPDO1_PARAMETER <= item.index < od.TPDO1_PARAMETER + od.MAX_PDOS for item in objects)
        self._tpdos = TpdoEngine(self._store, tpdos, send, self._now, catch_up_ns)
        self._rpdo = PdoRecords(self._store, od.RPDO1_PARAMETER, od.RPDO1_MAPPING, transmits=False)
        self._command = self._rpdo.read()
        self._pending_command: bytes | None = None  # of a synchronous RPDO, until the next SYNC
        self._wrong_sync_length: int | None = None
        self._handlers: dict[int, Handler] = {}
        self._application = application(Services(self._store, self._tpdos, self._emcy, self._now))
        self._describe(serial)
        self._connect()

    # --- what drives it

    def power_on(self, t_ns: int) -> None:
        """Start the application, send the boot-up message, become PRE-OPERATIONAL."""
        self._now_ns = t_ns
        self._application.power_on(t_ns)
        self._reset(_EVERYTHING, t_ns)

    def power_off(self) -> None:
        """Fall silent at once."""
        self._enter(NmtState.INITIALISING, self._now_ns)

    def on_frame(self, can_id: int, data: bytes, t_ns: int, remote: bool = False) -> None:
        """A classic frame with an 11-bit identifier was received; ``data`` of a remote frame says nothing."""
        if self.nmt_state is NmtState.INITIALISING:
            return
        self._now_ns = t_ns
        if remote:
            if can_id == od.heartbeat_cob_id(self.node_id):
                self._error_control.on_request(self.nmt_state, t_ns)
            return
        handler = self._handlers.get(can_id)
        if handler is not None:
            handler(data, t_ns)

    def next_deadline_ns(self) -> int | None:
        """When :meth:`on_timer` is to be called; None while there is nothing to wait for."""
        if self.nmt_state is NmtState.INITIALISING:
            return None
        deadline_ns = min(
            self._tpdos.deadline_ns,
            self._error_control.deadline_ns,
            self._application.deadline_ns,
            self._emcy.deadline_ns,
            self._sdo.deadline_ns,
        )
        return None if deadline_ns == NO_DEADLINE_NS else deadline_ns

    def on_timer(self, t_ns: int) -> None:
        """Do what is due at ``t_ns``; too early or too often does no harm."""
        if self.nmt_state is NmtState.INITIALISING:
            return
        self._now_ns = t_ns
        self._error_control.on_timer(self.nmt_state, t_ns)
        self._application.on_timer(t_ns)
        self._tpdos.on_timer(t_ns)
        self._emcy.on_timer(t_ns)
        self._sdo.on_timer(t_ns)

    def _now(self) -> int:
        return self._now_ns

    # --- states

    def _on_nmt(self, data: bytes, t_ns: int) -> None:
        try:
            command = parse(data, self.node_id)
        except ValueError:
            self._rejected.count(Rejected.NMT)
            return
        match command:
            case None:
                return
            case NmtCommand.RESET_NODE:
                self._reset(_EVERYTHING, t_ns)
            case NmtCommand.RESET_COMMUNICATION:
                self._reset(_COMMUNICATION, t_ns)
            case _:
                self._enter(AFTER_COMMAND[command], t_ns)

    def _reset(self, objects: tuple[int, int], t_ns: int) -> None:
        self._enter(NmtState.INITIALISING, t_ns)
        self._store.restore(*objects)
        if objects == _EVERYTHING:
            self._rejected.reset()
            self._time.reset()
        self._emcy.reset()
        self._error_control.reset()
        self._wrong_sync_length = None
        self._tpdos.restore()
        self._application.reset()
        self._reload()
        self._error_control.boot_up(t_ns)
        self._enter(NmtState.PRE_OPERATIONAL, t_ns)

    def _enter(self, state: NmtState, t_ns: int) -> None:
        if state is self.nmt_state:
            return
        was, self.nmt_state = self.nmt_state, state
        self._pending_command = None
        if not state.communicates:
            self._sdo.reset()
        if state is NmtState.OPERATIONAL:
            self._tpdos.start(t_ns)
        elif was is NmtState.OPERATIONAL:
            self._tpdos.stop()
        self._application.enter(operational=state is NmtState.OPERATIONAL)
        self._emcy.allow(state.communicates, t_ns)

    def _communication_failed(self, t_ns: int) -> None:
        """Heartbeat or guarding failed, or the bus. Error behaviour, 0x1029: 0 pre-operational, 1 nothing,
        2 stopped."""
        behaviour = self._store.integer(od.ERROR_BEHAVIOUR, 1)
        if behaviour == 2:
            self._enter(NmtState.STOPPED, t_ns)
        elif behaviour == 0 and self.nmt_state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL, t_ns)

    # --- services

    def _on_sdo(self, data: bytes, t_ns: int) -> None:
        if not self.nmt_state.communicates:
            return
        if len(data) == 8:
            self._sdo.on_request(data, t_ns)
        else:
            self._rejected.count(Rejected.SDO)

    def _send_sdo(self, response: bytes) -> None:
        self._send(od.sdo_response_cob_id(self.node_id), response)

    def _on_sync(self, data: bytes, t_ns: int) -> None:
        if not self.nmt_state.communicates:
            return
        counted = self._store.integer(od.SYNC_COUNTER_OVERFLOW) > 0
        if len(data) != counted:
            self._rejected.count(Rejected.SYNC)
            if len(data) != self._wrong_sync_length:  # once, not with every SYNC
                self._wrong_sync_length = len(data)
                self._emcy.happened(EmcyCode.SYNC_LENGTH, bytes((len(data), counted)), t_ns)
            return
        self._wrong_sync_length = None
        if self.nmt_state is not NmtState.OPERATIONAL:
            return
        if self._pending_command is not None:
            pending, self._pending_command = self._pending_command, None
            self._execute(pending)
        counter = data[0] if counted else None
        self._application.on_sync(counter, self._tpdos.on_sync(counter, t_ns), t_ns)

    def _on_command(self, data: bytes, t_ns: int) -> None:
        if self.nmt_state is not NmtState.OPERATIONAL:
            return
        wanted = self._command.size
        if len(data) < wanted:
            self._rejected.count(Rejected.RPDO)
            self._emcy.present(EmcyCode.PDO_NOT_PROCESSED, bytes((1, len(data), wanted)), t_ns)
            return
        self._emcy.over(EmcyCode.PDO_NOT_PROCESSED, t_ns)
        if len(data) > fd_length(wanted):  # of a classic frame that is what is wanted itself
            self._emcy.happened(EmcyCode.PDO_LENGTH_EXCEEDED, bytes((1, len(data), wanted)), t_ns)
        if self._command.event_driven:
            self._execute(data)
        else:
            self._pending_command = data

    def _execute(self, data: bytes) -> None:
        """Write the objects mapped into RPDO1. One that refuses its value does not keep the others from
        theirs: process data have no way to answer."""
        at = 0
        for index, subindex in self._command.mapping:
            size = self._store.find(index, subindex).data_type.bits // 8
            with contextlib.suppress(Refused):
                self._store.write(index, subindex, data[at : at + size])
            at += size

    def _on_time(self, data: bytes, t_ns: int) -> None:
        if self.nmt_state.communicates and not self._time.on_time(data, t_ns):
            self._rejected.count(Rejected.TIME)

    # --- object dictionary

    def _describe(self, serial: int) -> None:
        """Values that only this device knows."""
        self._store.put(od.IDENTITY, od.IDENTITY_SERIAL, serial)
        self._store.put(od.HARDWARE_VERSION, 0, HARDWARE_VERSION)
        self._store.put(od.SOFTWARE_VERSION, 0, importlib.metadata.version("skinnode"))

    def _connect(self) -> None:
        store = self._store
        for index in (od.STORE, od.RESTORE):
            # Nothing is kept over a power cycle yet: 0 says so, and commands are refused as CiA 301 wants it.
            store.bind(index, lambda _: bytes(4))
            store.guard(index, _cannot_store)
        store.guard(od.COB_ID_SYNC, _guard_sync)
        store.guard(od.SYNC_COUNTER_OVERFLOW, self._guard_sync_counter)
        for index in (od.COB_ID_SYNC, od.COB_ID_TIME, od.RPDO1_PARAMETER, od.RPDO1_MAPPING):
            store.watch(index, lambda _: self._reload())

    def _reload(self) -> None:
        """Listen to the COB-IDs that the object dictionary names."""
        self._command, self._pending_command = self._rpdo.read(), None
        handlers: dict[int, Handler] = self._error_control.handlers()
        if self._command.enabled:
            handlers[self._command.cob_id] = self._on_command
        if self._time.cob_id is not None:
            handlers[self._time.cob_id] = self._on_time
        # Last, so that no configuration can take the node its SYNC, SDO and NMT.
        handlers[self._store.integer(od.COB_ID_SYNC) & COB_ID_MASK] = self._on_sync
        handlers[od.sdo_request_cob_id(self.node_id)] = self._on_sdo
        handlers[od.NMT_COB_ID] = self._on_nmt
        self._handlers = handlers

    def _guard_sync_counter(self, _: int, value: int) -> None:
        if value == 1:  # 0, or 2 to 240
            raise Refused(AbortCode.INVALID_VALUE)
        if self._store.integer(od.CYCLE_PERIOD):
            raise Refused(AbortCode.DEVICE_STATE)


def _guard_sync(_: int, value: int) -> None:
    if value & (_SYNC_PRODUCER_BIT | INVALID_BIT):  # this node only consumes SYNC; bit 31 means nothing here
        raise Refused(AbortCode.INVALID_VALUE)
    check_cob_id(value, INVALID_BIT)


def _cannot_store(_subindex: int, _value: int) -> None:
    raise Refused(AbortCode.CANNOT_STORE)
