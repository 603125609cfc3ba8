"""Simulated node with injected faults. All frames to and from the node pass through this module.

:mod:`vcan_sim.faulty_converter` implements the faults in readings, and :mod:`vcan_sim.faulty_scans` the
faults in scans. All faults other than periodic events are determined by a seed and the sequence of frames.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

import numpy as np

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtCommand
from skinnode.errors import BusError
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NmtState, PatchNode
from skinnode.node.pacing import THRIFTY, Pacing
from skinnode.node.patch.source import ResistanceSource
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from skinnode.transport.bus_state import BusState
from vcan_sim.faults import LOST_IN, LOST_OUT, NO_FAULTS, Faults, Injected
from vcan_sim.faulty_converter import FaultyConverter
from vcan_sim.faulty_scans import FaultyScans
from vcan_sim.injector import Injector
from vcan_sim.skin.imperfections import EXACT
from vcan_sim.tally import Kind, Tally, kind_of

BABBLE_COB_ID: Final = 0x3F0
SIMULATED: Final = Pacing(slack_ns=THRIFTY.slack_ns, catch_up_ns=40_000_000)
"""Timing tolerances of a simulated node. After a delay on a busy machine, the node sends its overdue chunks
in a burst instead of skipping the next scan."""

_STORM: Final = bytes.fromhex("0fff810000000000")
"""Emergency message: error code 0xFF0F, with the generic and manufacturer-specific bits of the error register
set."""
_MOST_AT_ONCE: Final = 32
"""Maximum number of overdue periodic events of one kind executed at once. The rest are dropped."""


TWIN_SERIAL: Final = 0x8000_0000
"""Bit that distinguishes the second node's serial number from the first node's."""


class Resting:
    """Source of constant resistances, as measured on an untouched patch.

    Args:
        baseline_ohm: (U, K) resistances at rest, in ohms. Values of 0 or less are replaced by 1 ohm.
    """

    def __init__(self, baseline_ohm: Float) -> None:
        self._ohm = np.where(baseline_ohm > 0.0, baseline_ohm, 1.0)

    def read(self, t_ns: int) -> Float:
        """Return the constant resistances (U, K) in ohms."""
        return self._ohm


class Emit(Protocol):
    """Function that puts a frame on the bus, like :meth:`skinnode.transport.CanPort.send`."""

    def __call__(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        """Put a frame on the bus. Raises BusError if the bus rejects the frame."""


class FaultyNode(PatchNode):
    """:class:`PatchNode` with injected faults. Any thread may assign :attr:`faults` at any time.

    Args:
        node_id: Node-ID.
        layout: Layout of the patch.
        source: Source of the resistances that the converter reads.
        emit: Function that puts a frame on the bus.
        on_sent: Function called with the COB-ID of each outgoing frame, even if the frame is lost.
        serial: Serial number.
        profile: Protocol profile of the node.
        faults: Initial faults. Their seed remains in use when the faults are replaced.
        temperature_per_k: Temperature coefficient of all resistances, 1/K.
        on_repeat: Function called with the time (ns) of each reading in which a frozen converter repeats the
            last one.
    """

    def __init__(  # noqa: PLR0913 - the arguments of PatchNode and four more
        self,
        node_id: int,
        layout: PatchLayout,
        source: ResistanceSource,
        *,
        emit: Emit,
        on_sent: Callable[[int], None],
        serial: int,
        profile: PatchProfile,
        faults: Faults = NO_FAULTS,
        temperature_per_k: float = EXACT.temperature_per_k,
        on_repeat: Callable[[int], object] = lambda t_ns: None,
    ) -> None:
        self._injector = Injector(faults, node_id)
        self._periods_ns = _periods_ns(faults)
        self._emit, self._on_sent = emit, on_sent
        self._chunk_id, self._summary_id = od.chunk_cob_id(node_id), od.summary_cob_id(node_id)
        self._faulty_scans = FaultyScans(
            self._injector,
            node_id,
            profile,
            put=self._put,
            counter_overflow=lambda: self._store.integer(od.SYNC_COUNTER_OVERFLOW),
        )
        self._unplugged = self._stormed = self._passive = False
        self._controller = BusState.ACTIVE  # actual state, disregarding faults
        self._twin: PatchNode | None = None
        self._layout, self._serial = layout, serial
        self._due_ns = dict.fromkeys(("restart", "emcy", "babble"), 0)
        self.converter = FaultyConverter(
            source,
            self._injector,
            booting=lambda: self.nmt_state is NmtState.INITIALISING,
            baseline_ohm=lambda: self.baseline_ohm,
            scale=CodeScale(profile.code_bits),
            temperature_per_k=temperature_per_k,
            on_repeat=on_repeat,
        )
        super().__init__(
            node_id,
            layout,
            self.converter,
            send=self._out,
            serial=serial,
            profile=profile,
            pacing=SIMULATED,
        )

    @property
    def faults(self) -> Faults:
        """Current faults of the node."""
        return self._injector.faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        self._injector.faults = faults
        self._periods_ns = _periods_ns(faults)

    @property
    def injected(self) -> Injected:
        """Counts of injected faults, updated as the node runs."""
        return self._injector.injected

    @property
    def tally(self) -> Tally:
        """Frame counts of the node by kind, updated as the node runs."""
        return self._injector.tally

    # --- input to the node: frames and time

    def on_frame(self, can_id: int, data: bytes, t_ns: int, remote: bool = False) -> None:
        """Pass a frame to the node unless a fault drops it, and to the second node, if any."""
        self._hear(can_id, data, t_ns, remote)
        if self._twin is not None:
            self._twin.on_frame(can_id, data, t_ns, remote)

    def _hear(self, can_id: int, data: bytes, t_ns: int, remote: bool) -> None:
        if self.faults.unplugged != self._unplugged:
            self._plug(t_ns)
        kind = kind_of(can_id, data, remote)
        self.tally.heard[kind] += 1
        if self.faults.deaf or self._unplugged:
            self.injected.unheard += 1
            self.tally.unheard[kind] += 1
            return
        needed = self._faulty_scans.needs_next_scan
        if can_id == od.SYNC_COB_ID and not needed and self._injector.draw(self.faults.sync_lost):
            self.injected.sync_lost += self.nmt_state is NmtState.OPERATIONAL
            self.tally.lost_in[kind] += 1
            return
        if self._concerns(kind, can_id) and self._injector.loses(LOST_IN.get(kind)):
            self.tally.lost_in[kind] += 1
            return
        self.tally.taken[kind] += 1
        super().on_frame(can_id, data, t_ns, remote)
        self._reset_if_due(t_ns)

    def _concerns(self, kind: Kind, can_id: int) -> bool:
        """Return whether a frame is addressed to this node. Faults drop only such frames."""
        if kind is Kind.SDO_REQUEST:
            return can_id == od.sdo_request_cob_id(self.node_id)
        return kind is not Kind.COMMAND or can_id == od.command_cob_id(self.node_id)

    def on_timer(self, t_ns: int) -> None:
        """Process the timers and periodic events that are due at ``t_ns``."""
        self._meet_twin(t_ns)
        if self.faults.unplugged != self._unplugged:
            self._plug(t_ns)
        if self._unplugged:
            return
        if self.faults.error_passive != self._passive:
            self._passive = self.faults.error_passive
            self.injected.error_passive += self._passive
            self.on_bus(self._controller, t_ns)
        super().on_timer(t_ns)
        self._reset_if_due(t_ns)
        self._do_due_events(t_ns)

    def next_deadline_ns(self) -> int | None:
        """Return the time (ns) at which to call :meth:`on_timer` next; None if nothing is due."""
        faults = self.faults
        if faults.unplugged != self._unplugged or faults.duplicate_node_id != (self._twin is not None):
            return 0
        own = None if self._unplugged else self._own_deadline_ns(faults)
        if self._twin is None:
            return own
        of_twin = self._twin.next_deadline_ns()
        return min((each for each in (own, of_twin) if each is not None), default=None)

    def _own_deadline_ns(self, faults: Faults) -> int | None:
        """Return the time (ns) of this node's next timer or periodic event; None if nothing is due."""
        if faults.error_passive != self._passive:
            return 0
        own = super().next_deadline_ns()
        if not (self._periods_ns or self._stormed):
            return own
        due = [self._due_ns[name] for name in self._periods_ns]
        if self._stormed and not faults.emcy_per_s:
            due.append(0)
        if not due or self.nmt_state is NmtState.INITIALISING:
            return own
        return min(due) if own is None else min(own, *due)

    def on_bus(self, state: BusState, t_ns: int) -> None:
        """Pass the CAN controller state to the node, or error-passive while that fault is active."""
        self._controller = state
        passive = self._passive and state is not BusState.OFF
        super().on_bus(BusState.PASSIVE if passive else state, t_ns)

    def _meet_twin(self, t_ns: int) -> None:
        """Start or remove the second node with the same node-ID, and run its timers."""
        if self.faults.duplicate_node_id and self._twin is None:
            self._twin = PatchNode(
                self.node_id,
                self._layout,
                Resting(self.baseline_ohm),
                send=self._from_twin,
                serial=self._serial ^ TWIN_SERIAL,
                profile=self.profile,
                pacing=SIMULATED,
            )
            self.injected.twins += 1
            self._twin.power_on(t_ns)
        elif not self.faults.duplicate_node_id:
            self._twin = None
        if self._twin is not None:
            self._twin.on_timer(t_ns)

    def _plug(self, t_ns: int) -> None:
        self._unplugged = self.faults.unplugged
        if self._unplugged:
            self.power_off()
            self._faulty_scans.power_off()
            self.injected.unplugged += 1
        else:
            self._due_ns = dict.fromkeys(self._due_ns, 0)  # nothing was due while the power was off
            self.power_on(t_ns)

    def _reset_if_due(self, t_ns: int) -> None:
        if self._faulty_scans.reset_due:
            self._faulty_scans.reset_due = False
            self._reset_node(t_ns)

    def _reset_node(self, t_ns: int) -> None:
        super().on_frame(od.NMT_COB_ID, bytes([NmtCommand.RESET_NODE, self.node_id]), t_ns)

    # --- periodic events

    def _do_due_events(self, t_ns: int) -> None:
        periods_ns = self._periods_ns
        for name in self._due_ns:
            if name not in periods_ns:
                self._due_ns[name] = 0
        for name, period_ns in periods_ns.items():
            if not self._due_ns[name]:  # the first event comes one period after the fault starts
                self._due_ns[name] = t_ns + period_ns
            for _ in range(_MOST_AT_ONCE):
                if self._due_ns[name] > t_ns:
                    break
                self._due_ns[name] += period_ns
                self._do(name, t_ns)
            else:
                self._due_ns[name] = t_ns + period_ns
        if self._stormed and not self.faults.emcy_per_s:
            self._stormed = False
            self._put_or_lose(od.emcy_cob_id(self.node_id), bytes(8))

    def _do(self, name: str, t_ns: int) -> None:
        match name:
            case "restart":
                self.injected.restarts += 1
                self._reset_node(t_ns)
            case "emcy":
                self._stormed = True
                self.injected.emergencies += self._put_or_lose(od.emcy_cob_id(self.node_id), _STORM)
            case _:
                self.injected.babbled += self._put_or_lose(BABBLE_COB_ID, bytes(8))

    # --- frames sent by the node

    def _out(self, can_id: int, data: bytes) -> None:
        if can_id == self._chunk_id:
            self._injector.tally.handed[Kind.CHUNK] += 1
            self._faulty_scans.send_chunk(data)
        elif can_id == self._summary_id:
            self._injector.tally.handed[Kind.SUMMARY] += 1
            self._faulty_scans.send_summary(data)
        else:
            self._put_or_lose(can_id, self._imposture(can_id, data))
        self._on_sent(can_id)

    def _put_or_lose(self, can_id: int, data: bytes) -> bool:
        """Send a non-PDO frame unless a fault drops it, and return whether it was sent."""
        kind = kind_of(can_id, data)
        self.tally.handed[kind] += 1
        if not self._is_cut_off and self._injector.loses(LOST_OUT.get(kind)):
            self.tally.lost[kind] += 1
            return False
        if can_id == od.heartbeat_cob_id(self.node_id) and self._injector.draw(self.faults.long):
            too_long = self._put(can_id, data + b"\0")
            self.injected.long += too_long
            return too_long
        return self._put(can_id, data)

    def _imposture(self, can_id: int, data: bytes) -> bytes:
        """Return an outgoing frame's data, with a false product code or layout hash if a fault is set."""
        faults = self.faults
        if not (faults.wrong_identity or faults.wrong_layout) or can_id != od.sdo_response_cob_id(
            self.node_id
        ):
            return data
        index, subindex = int.from_bytes(data[1:3], "little"), data[3]
        about_identity = (index, subindex) == (od.IDENTITY, od.IDENTITY_PRODUCT)
        about_layout = (index, subindex) == (od.DESCRIPTOR, od.LAYOUT_HASH)
        expedited_upload = data[0] & 0xE2 == 0x42
        if expedited_upload and (
            (about_identity and faults.wrong_identity) or (about_layout and faults.wrong_layout)
        ):
            self.injected.impostures += 1
            return data[:4] + bytes([data[4] ^ 0xFF]) + data[5:]
        return data

    def _put(self, can_id: int, data: bytes, *, remote: bool = False) -> bool:
        """Put a frame on the bus unless the node is cut off, and return whether it was sent."""
        kind, tally = kind_of(can_id, data, remote), self._injector.tally
        if self._is_cut_off:
            self.injected.silenced += 1
            tally.silenced[kind] += 1
            return False
        try:
            self._emit(can_id, data, remote=remote)
        except BusError:
            tally.refused[kind] += 1
            raise
        tally.emitted[kind] += 1
        return True

    def _from_twin(self, can_id: int, data: bytes) -> None:
        """Put a frame from the second node on the bus. Its heartbeats also reach this node."""
        kind = kind_of(can_id, data)
        self.tally.handed[kind] += 1
        try:
            self._emit(can_id, data)
        except BusError:
            self.tally.refused[kind] += 1
            raise
        self.tally.emitted[kind] += 1
        self.injected.twin_frames += 1
        self.injected.pdos += can_id in (self._chunk_id, self._summary_id)
        if can_id == od.heartbeat_cob_id(self.node_id) and not (self._unplugged or self.faults.deaf):
            super().on_frame(can_id, data, self._now_ns)

    @property
    def _is_cut_off(self) -> bool:
        """Whether the node cannot send because it is silent, unplugged or about to be reset."""
        return self._injector.faults.silent or self._unplugged or self._faulty_scans.reset_due


def _periods_ns(faults: Faults) -> dict[str, int]:
    """Return the period (ns) of each active kind of periodic event."""
    rates = {"emcy": faults.emcy_per_s, "babble": faults.babble_per_s}
    periods = {name: round(1e9 / rate) for name, rate in rates.items() if rate}
    if faults.restart_every_s:
        periods = {"restart": round(faults.restart_every_s * 1e9), **periods}
    return periods
