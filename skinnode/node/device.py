"""CANopen device: the CiA 301 communication services and an application that uses them.

The device has no thread and reads no clock, so its behaviour is deterministic. The caller passes received
frames and their arrival times to :meth:`CanopenDevice.on_frame`, and calls :meth:`CanopenDevice.on_timer` at
the time given by :meth:`CanopenDevice.next_deadline_ns`. On a bus, :class:`~skinnode.node.runner.NodeRunner`
is the caller. The device handles every frame without raising an exception. Exceptions from the application
and from ``send`` propagate to the caller.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Sequence
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.dictionary import Object
from skinnode.canopen.emergency import EmcyCode
from skinnode.canopen.lss import NOT_CONFIGURED, LssAddress
from skinnode.canopen.nmt import NmtCommand, NmtState
from skinnode.errors import BusError
from skinnode.node.application import Application, ApplicationServices
from skinnode.node.emcy import EmcyProducer
from skinnode.node.error_control import ErrorControl
from skinnode.node.lss import BitRateChange, LssSlave
from skinnode.node.memory import Memory
from skinnode.node.nmt import NmtSlave
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.pdo.rpdo import RpdoEngine
from skinnode.node.pdo.tpdo import TpdoEngine
from skinnode.node.rejected import Rejected, RejectedFrames
from skinnode.node.sdo.server import SdoServer
from skinnode.node.services import NodeServices, Send
from skinnode.node.storage import COMMUNICATION, EVERYTHING, Storage
from skinnode.node.sync import Sync
from skinnode.node.time_of_day import TimeConsumer
from skinnode.transport.bus_state import BusState

HARDWARE_VERSION: Final = "none"
"""Hardware version (0x1009) of a software node, which has no board."""

Handler = Callable[[bytes, int], None]
"""Callback with two arguments: the payload of a frame, and its arrival time in ns."""


class CanopenDevice:
    """CANopen device. It is silent until :meth:`power_on` is called.

    Args:
        node_id: 1 to 127, or 255 to wait until LSS assigns a node-ID. A node-ID that LSS has stored in the
            memory takes precedence.
        objects: Declarations of the objects in the node's object dictionary.
        application: Function that creates the application, given the device's services.
        send: Function that sends a frame, given its COB-ID and payload.
        serial: Serial number (0x1018:4), u32.
        memory: Non-volatile memory of the device, or None.
        kind: Identifier of the patch's dimensions and layout. Memory contents saved with another identifier
            are not used.
        set_bit_rate: Function that changes the bit rate (bit/s), or None if LSS cannot change it.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(  # noqa: PLR0913 - the keywords of the public PatchNode, passed on
        self,
        node_id: int,
        objects: Sequence[Object],
        application: Callable[[ApplicationServices], Application],
        *,
        send: Send,
        serial: int,
        memory: Memory | None,
        kind: str,
        set_bit_rate: Callable[[int], None] | None,
    ) -> None:
        if not (1 <= node_id <= od.MAX_NODE_ID or node_id == NOT_CONFIGURED):
            raise ValueError(f"node_id: got {node_id}, must be 1 to 127, or {NOT_CONFIGURED} for none")
        if not 0 <= serial < 1 << 32:
            raise ValueError(f"serial: got {serial}, must be an unsigned 32-bit integer")
        self._default_node_id = node_id
        self.node_id = node_id
        """Active node-ID; 255 while the device has no node-ID."""
        self._send_frame = send
        self._now_ns = 0
        self._store = ObjectStore(objects, node_id)
        self._sdo = SdoServer(self._store, self._send_sdo)
        self._rejected = RejectedFrames(self._store)
        self._emcy = EmcyProducer(self._store, self._send)
        services = NodeServices(self._store, self._emcy, self._rejected, self._send, self._now)
        self._nmt = NmtSlave(self._store, self._rejected, self._entered)
        self._storage = Storage(services, memory, kind)
        self._set_bit_rate = set_bit_rate
        self._bit_rate_change = BitRateChange(set_bit_rate)
        self._error_control = ErrorControl(services, self._reload, self._nmt.on_communication_error)
        self._time = TimeConsumer(self._store, self._now)
        tpdos, rpdos = (_count(objects, first) for first in (od.TPDO1_PARAMETER, od.RPDO1_PARAMETER))
        self._sync = Sync(services)
        self._tpdos = TpdoEngine(services, tpdos, self._sync.window)
        self._rpdos = RpdoEngine(services, rpdos, self._sync.window)
        self._bus_state = BusState.ACTIVE
        self._handlers: dict[int, Handler] = {}
        self._application = application(
            ApplicationServices(self._store, self._storage, self._tpdos, self._emcy, self._now)
        )
        self._describe(serial)
        self._connect()
        self._lss = self._lss_slave()

    # --- events

    def power_on(self, t_ns: int) -> None:
        """Start the application and boot. A device without a node-ID first waits until LSS assigns one.

        Args:
            t_ns: Current time, in ns.
        """
        self._now_ns = t_ns
        self._storage.load()
        self._lss = self._lss_slave()
        bit_rate_bps = self._storage.kept.bit_rate_bps
        if bit_rate_bps is not None and self._set_bit_rate is not None:
            self._set_bit_rate(bit_rate_bps)
        self._application.power_on(t_ns)
        self._reset(EVERYTHING, t_ns)

    def power_off(self) -> None:
        """Switch the device off. It stops sending immediately."""
        self._enter(NmtState.INITIALISING, self._now_ns)
        self._bit_rate_change.cancel()
        self._handlers = {}

    def on_frame(self, can_id: int, data: bytes, t_ns: int, remote: bool = False) -> None:
        """Handle a frame with an 11-bit identifier.

        Args:
            can_id: Identifier of the frame.
            data: Payload of the frame; ignored for a remote frame.
            t_ns: Arrival time, in ns.
            remote: Whether the frame is a remote frame.
        """
        if self._bit_rate_change.silent(t_ns):
            return
        self._now_ns = t_ns
        # Before boot-up, the only handler, if any, is the LSS handler.
        if not remote and (handler := self._handlers.get(can_id)) is not None:
            handler(data, t_ns)
        elif self.nmt_state is NmtState.INITIALISING:
            return
        elif not remote:
            self._rpdos.on_frame(can_id, data, t_ns)
        elif can_id == od.heartbeat_cob_id(self.node_id):
            self._error_control.on_request(self.nmt_state, t_ns)
        elif self.nmt_state is NmtState.OPERATIONAL:
            self._tpdos.on_remote(can_id, t_ns)

    def on_bus(self, state: BusState, t_ns: int) -> None:
        """Handle a change in the CAN controller's state.

        At bus-off, the error behaviour (0x1029) takes effect immediately. The emergency message follows once
        the bus has recovered.

        Args:
            state: New state of the CAN controller.
            t_ns: Current time, in ns.
        """
        was, self._bus_state = self._bus_state, state
        if self.nmt_state is NmtState.INITIALISING or state is was:
            return
        self._now_ns = t_ns
        if state is BusState.OFF:
            self._nmt.on_communication_error(t_ns)
            return
        if was is BusState.OFF:
            self._emcy.report_once(EmcyCode.BUS_OFF_RECOVERED, b"", t_ns)
        self._report_passive(t_ns)

    def next_deadline_ns(self) -> int | None:
        """Return the time (ns) at which :meth:`on_timer` must be called, or None if nothing is scheduled."""
        if self._bit_rate_change.deadline_ns != NO_DEADLINE_NS:
            return self._bit_rate_change.deadline_ns
        if self.nmt_state is NmtState.INITIALISING:
            return None
        deadline_ns = min(
            self._sync.deadline_ns,
            self._tpdos.deadline_ns,
            self._rpdos.deadline_ns,
            self._error_control.deadline_ns,
            self._application.deadline_ns,
            self._emcy.deadline_ns,
            self._sdo.deadline_ns,
        )
        return None if deadline_ns == NO_DEADLINE_NS else deadline_ns

    @property
    def silent_from_ns(self) -> int:
        """Time (ns) from which :meth:`on_timer` reports a missed heartbeat or guarding request.

        Before that call, the caller must pass all received frames to :meth:`on_frame`, because the heartbeat
        or guarding request may be among them.
        """
        return self._error_control.silent_from_ns

    def on_timer(self, t_ns: int) -> None:
        """Perform all actions that are due at ``t_ns``. Calls before the next deadline have no effect.

        Args:
            t_ns: Current time, in ns.
        """
        if self._bit_rate_change.silent(t_ns) or self.nmt_state is NmtState.INITIALISING:
            return
        self._now_ns = t_ns
        self._error_control.on_timer(self.nmt_state, t_ns)
        self._application.on_timer(t_ns)
        self._tpdos.on_timer(t_ns)
        self._rpdos.on_timer(t_ns)
        sync = self._sync.on_timer(t_ns)
        if sync is not None:
            self._synchronise(sync, t_ns)
        self._emcy.on_timer(t_ns)
        self._sdo.on_timer(t_ns)

    def _now(self) -> int:
        return self._now_ns

    def _send(self, can_id: int, data: bytes) -> None:
        """Send a frame. During a bit rate change, raise BusError: an emergency message then stays queued."""
        if self._bit_rate_change.deadline_ns != NO_DEADLINE_NS:
            raise BusError(f"0x{can_id:03X} not sent: the bit rate is being changed")
        self._send_frame(can_id, data)

    # --- states

    @property
    def nmt_state(self) -> NmtState:
        """Current NMT state."""
        return self._nmt.state

    def _on_nmt(self, data: bytes, t_ns: int) -> None:
        match command := self._nmt.command(data, self.node_id):
            case None:
                return
            case NmtCommand.RESET_NODE:
                self._lss.reset_node()
                self._reset(EVERYTHING, t_ns)
            case NmtCommand.RESET_COMMUNICATION:
                self._reset(COMMUNICATION, t_ns)
            case _:
                self._nmt.obey(command, t_ns)

    def _reset(self, objects: tuple[int, int], t_ns: int) -> None:
        """Reset the objects and services, and boot if the node has a node-ID."""
        self._enter(NmtState.INITIALISING, t_ns)
        self._lss.reset_communication()
        self.node_id = self._lss.node_id
        if self.node_id == NOT_CONFIGURED:
            self._handlers = {od.LSS_REQUEST_COB_ID: self._on_lss}
            return
        self._store.renumber(self.node_id)
        self._storage.restore(*objects)
        if objects == EVERYTHING:
            self._rejected.reset()
            self._time.reset()
        self._emcy.reset()
        self._error_control.reset(self.node_id)
        self._tpdos.restore()
        self._rpdos.restore()
        self._sync.reload()
        self._application.reset(everything=objects == EVERYTHING)
        self._reload()
        self._error_control.boot_up(t_ns)
        self._enter(NmtState.PRE_OPERATIONAL, t_ns)
        self._report_passive(t_ns)
        self._storage.report(t_ns)

    def _enter(self, state: NmtState, t_ns: int) -> None:
        self._nmt.enter(state, t_ns)

    def _entered(self, state: NmtState, before: NmtState, t_ns: int) -> None:
        # The EMCY producer comes first, because the calls below may report errors.
        self._emcy.allow(state.communicates, t_ns)
        if not state.communicates:
            self._sdo.reset()
        if state is NmtState.OPERATIONAL:
            self._tpdos.start(t_ns)
        elif before is NmtState.OPERATIONAL:
            self._tpdos.stop()
        self._sync.window.forget(t_ns)
        self._rpdos.enter(operational=state is NmtState.OPERATIONAL)
        self._sync.enter(communicates=state.communicates)
        self._application.enter(operational=state is NmtState.OPERATIONAL)

    def _report_passive(self, t_ns: int) -> None:
        if self._bus_state is BusState.PASSIVE:
            self._emcy.report(EmcyCode.CAN_PASSIVE, b"", t_ns)
        else:
            self._emcy.clear(EmcyCode.CAN_PASSIVE, t_ns)

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
        if self.nmt_state.communicates and self._sync.accept(data, t_ns):
            self._synchronise(data, t_ns)

    def _synchronise(self, sync: bytes, t_ns: int) -> None:
        """Handle a SYNC received in OPERATIONAL: apply RPDOs, call the application, then send TPDOs."""
        if self.nmt_state is not NmtState.OPERATIONAL:
            return
        counter = sync[0] if sync else None
        self._sync.window.start(t_ns)
        turns = self._tpdos.count_sync(counter)
        self._rpdos.on_sync()
        self._application.on_sync(counter, turns, t_ns)
        self._tpdos.on_sync(turns, t_ns)

    def _on_time(self, data: bytes, t_ns: int) -> None:
        if self.nmt_state.communicates and not self._time.on_time(data, t_ns):
            self._rejected.count(Rejected.TIME)

    def _on_lss(self, data: bytes, t_ns: int) -> None:
        response = self._lss.on_request(data)
        if response is not None:
            self._send(od.LSS_RESPONSE_COB_ID, response)
        if self._lss.may_boot:
            self._reset(EVERYTHING, t_ns)

    def _lss_slave(self) -> LssSlave:
        kept, store = self._storage.kept, self._store
        own_bit_rate = self._set_bit_rate is not None
        return LssSlave(
            LssAddress(*(store.integer(od.IDENTITY, subindex) for subindex in (1, 2, 3, 4))),
            self._default_node_id if kept.node_id is None else kept.node_id,
            bit_rates_bps=od.BIT_RATES_BPS if own_bit_rate else (),
            bit_rate_bps=kept.bit_rate_bps,
            store=self._storage.keep_lss if self._storage.has_memory else None,
            activate=self._activate_bit_rate if own_bit_rate else None,
        )

    def _activate_bit_rate(self, bit_rate_bps: int | None, delay_ms: int) -> None:
        self._bit_rate_change.begin(bit_rate_bps, delay_ms, self._now_ns)

    # --- object dictionary

    def _describe(self, serial: int) -> None:
        """Set the serial number and the versions."""
        self._store.put(od.IDENTITY, od.IDENTITY_SERIAL, serial)
        self._store.put(od.HARDWARE_VERSION, 0, HARDWARE_VERSION)
        self._store.put(od.SOFTWARE_VERSION, 0, importlib.metadata.version("skinnode"))

    def _connect(self) -> None:
        store = self._store
        for index in (od.COB_ID_SYNC, od.CYCLE_PERIOD):
            store.watch(index, lambda _: self._reload_sync())
        store.watch(od.COB_ID_TIME, lambda _: self._reload())

    def _reload_sync(self) -> None:
        self._sync.reload()
        self._reload()

    def _reload(self) -> None:
        """Rebuild the table of handlers for all received COB-IDs except the RPDO COB-IDs."""
        handlers: dict[int, Handler] = self._error_control.handlers()
        if self._time.cob_id is not None:
            handlers[self._time.cob_id] = self._on_time
        # SYNC, SDO, NMT and LSS come last, so that no other service can take over their COB-IDs.
        handlers[self._sync.cob_id] = self._on_sync
        handlers[od.sdo_request_cob_id(self.node_id)] = self._on_sdo
        handlers[od.NMT_COB_ID] = self._on_nmt
        handlers[od.LSS_REQUEST_COB_ID] = self._on_lss
        self._handlers = handlers


def _count(objects: Sequence[Object], first: int) -> int:
    """Return the number of RPDOs or TPDOs, given the index of the first communication record."""
    return sum(first <= item.index < first + od.MAX_PDOS for item in objects)
