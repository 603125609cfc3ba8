"""A node with faults: everything between it and its bus passes here, and so do its readings.

The node itself is the real one. What is injected is drawn from a seed and the order of frames, not from the
clock, except for what happens so often a second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

import numpy as np

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtCommand
from skinnode.errors import BusError
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NmtState, PatchNode
from skinnode.node.clock import THRIFTY, Pacing
from skinnode.node.patch.source import ResistanceSource
from skinnode.protocol.chunk import chunk_indexer, unpack_scan_with_check
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.summary import SummaryFlag, pack_checked_summary, pack_summary, unpack_summary
from vcan_sim.faults import LOST_IN, LOST_OUT, NO_FAULTS, OF_CHUNKS, OF_SCANS, OF_WIRES, Faults, Injected
from vcan_sim.tally import Kind, Tally, kind_of

BABBLE_COB_ID: Final = 0x3F0
SIMULATED: Final = Pacing(slack_ns=THRIFTY.slack_ns, catch_up_ns=40_000_000)
"""Pacing of a simulated node. It may be away for half a SYNC period of the reference hand and still finish
its scan in time, because a busy machine is not part of the simulation. Four nodes then send bursts of up to
270 frames, which fit the default receive buffer of a socket."""

_STORM: Final = bytes.fromhex("0fff810000000000")
"""EMCY 0xFF0F, error register: generic and manufacturer's."""
_MOST_AT_ONCE: Final = 32
"""Frames of a storm that are sent in one turn at most: nobody saves up for a burst."""
WIRE_NOISE: Final = 3e-3
"""Standard deviation of a resistance through a bad contact, relative."""
_CHUNK_COUNTER_BYTE: Final = 1
_SUMMARY_COUNTER_BYTE: Final = 0


class Emit(Protocol):
    """Puts a frame on the bus, as :meth:`skinnode.transport.CanPort.send` does."""

    def __call__(self, can_id: int, data: bytes, *, remote: bool = False) -> None: ...


class FaultyNode(PatchNode):
    """A :class:`PatchNode` that suffers :attr:`faults`, which may be replaced at any time from any thread.

    Args as of PatchNode; ``emit`` sends to the bus, ``on_sent`` is told of each frame of the node's own after
    it was sent or lost.
    """

    def __init__(
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
    ) -> None:
        self.faults = faults
        self.injected, self.tally = Injected(), Tally()
        self._emit, self._on_sent = emit, on_sent
        self._source = source
        self._reading: Float | None = None
        self._random = np.random.default_rng([faults.seed, node_id])
        self._chunk_id, self._summary_id = od.chunk_cob_id(node_id), od.summary_cob_id(node_id)
        self._counter = -1  # of the scan being sent, as the node gave it
        self._chunks = 0  # of it, so far
        self._half = max(1, profile.n_chunks // 2)
        self._fate = ""  # of this scan: one of OF_SCANS
        self._spoilt = False
        self._counter_instead: int | None = None  # of a scan that follows a torn one
        self._index_of = chunk_indexer(profile)
        self._packed: list[bytes] = []  # chunks of this scan, as the node packed them
        self._struck = -1  # index of the chunk of this scan that a fault of scans strikes
        self._lost_next = -1  # index of the chunk that the next scan loses
        self._swapped: tuple[int, bytes] | None = None
        self._late: list[tuple[int, bytes]] = []  # with the counter they had
        self._to_reset = self._unplugged = self._stormed = False
        self._due_ns = dict.fromkeys(("restart", "emcy", "babble"), 0)
        super().__init__(
            node_id, layout, self, send=self._out, serial=serial, profile=profile, pacing=SIMULATED
        )

    # --- the analogue port

    def read(self, t_ns: int) -> Float:
        """A reading, or the one before again."""
        if self.faults.frozen and self._reading is not None:
            self.injected.frozen += 1
        else:
            self._reading = self._miswired(self._source.read(t_ns))
        return self._reading

    def _miswired(self, read: Float) -> Float:
        """A reading through wires that are not all sound."""
        faults = self.faults
        if all(getattr(faults, name) is None for name in OF_WIRES) or self.nmt_state is NmtState.INITIALISING:
            return read
        self.injected.miswired += 1
        read = read.copy()
        for wire, ohm in ((faults.noisy_upper, read), (faults.noisy_lower, read.T)):
            if wire is not None:
                ohm[wire] *= 1.0 + WIRE_NOISE * self._random.standard_normal(ohm.shape[1])
        for wire, ohm, value in (
            (faults.shorted_upper, read, 0.0),
            (faults.shorted_lower, read.T, 0.0),
            (faults.open_upper, read, np.inf),
            (faults.open_lower, read.T, np.inf),
        ):
            if wire is not None:
                ohm[wire] = value
        return read

    # --- what drives it

    def on_frame(self, can_id: int, data: bytes, t_ns: int, remote: bool = False) -> None:
        kind = kind_of(can_id, data, remote)
        self.tally.heard[kind] += 1
        if self.faults.deaf or self._unplugged:
            self.injected.unheard += 1
            self.tally.unheard[kind] += 1
            return
        next_is_needed = self._fate in ("torn", "displaced")  # soon enough to be taken for that scan
        if can_id == od.SYNC_COB_ID and not next_is_needed and self._draw(self.faults.sync_lost):
            self.injected.sync_lost += self.nmt_state is NmtState.OPERATIONAL
            self.tally.lost_in[kind] += 1
            return
        if self._concerns(kind, can_id) and self._loses(LOST_IN.get(kind)):
            self.tally.lost_in[kind] += 1
            return
        self.tally.taken[kind] += 1
        super().on_frame(can_id, data, t_ns, remote)
        self._reset_if_due(t_ns)

    def _concerns(self, kind: Kind, can_id: int) -> bool:
        """Return whether the frame is meant for the node: requests to its neighbours are not its loss."""
        if kind is Kind.SDO_REQUEST:
            return can_id == od.sdo_request_cob_id(self.node_id)
        return kind is not Kind.COMMAND or can_id == od.command_cob_id(self.node_id)

    def on_timer(self, t_ns: int) -> None:
        if self.faults.unplugged != self._unplugged:
            self._plug(t_ns)
        if self._unplugged:
            return
        super().on_timer(t_ns)
        self._reset_if_due(t_ns)
        self._by_the_clock(t_ns)

    def next_deadline_ns(self) -> int | None:
        faults = self.faults
        if faults.unplugged != self._unplugged:
            return 0
        if self._unplugged:
            return None
        own = super().next_deadline_ns()
        due = [self._due_ns[name] for name, period_ns in _periods_ns(faults).items() if period_ns]
        if self._stormed and not faults.emcy_per_s:
            due.append(0)
        if not due or self.nmt_state is NmtState.INITIALISING:
            return own
        return min(due) if own is None else min(own, *due)

    def _plug(self, t_ns: int) -> None:
        self._unplugged = self.faults.unplugged
        if self._unplugged:
            self.power_off()
            self.tally.silenced[Kind.CHUNK] += self.tally.waiting.pop(Kind.CHUNK, 0)
            self._swapped, self._late = None, []
            self.injected.unplugged += 1
        else:
            self.power_on(t_ns)

    def _reset_if_due(self, t_ns: int) -> None:
        if self._to_reset:
            self._to_reset = False
            self._reset_node(t_ns)

    def _reset_node(self, t_ns: int) -> None:
        super().on_frame(od.NMT_COB_ID, bytes([NmtCommand.RESET_NODE, self.node_id]), t_ns)

    def _by_the_clock(self, t_ns: int) -> None:
        for name, period_ns in _periods_ns(self.faults).items():
            if not period_ns:
                self._due_ns[name] = 0
                continue
            if not self._due_ns[name]:  # just set
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
            self._pass_or_lose(od.emcy_cob_id(self.node_id), bytes(8))

    def _do(self, name: str, t_ns: int) -> None:
        match name:
            case "restart":
                self.injected.restarts += 1
                self._reset_node(t_ns)
            case "emcy":
                self._stormed = True
                self.injected.emergencies += self._pass_or_lose(od.emcy_cob_id(self.node_id), _STORM)
            case _:
                self.injected.babbled += self._pass_or_lose(BABBLE_COB_ID, bytes(8))

    # --- what the node sends

    def _out(self, can_id: int, data: bytes) -> None:
        if can_id == self._chunk_id:
            self.tally.handed[Kind.CHUNK] += 1
            self._out_chunk(data)
        elif can_id == self._summary_id:
            self.tally.handed[Kind.SUMMARY] += 1
            self._out_summary(data)
        else:
            self._pass_or_lose(can_id, self._imposture(can_id, data))
        self._on_sent(can_id)

    def _pass_or_lose(self, can_id: int, data: bytes) -> bool:
        """Send or drop a frame other than a PDO. Returns whether it was sent."""
        kind = kind_of(can_id, data)
        self.tally.handed[kind] += 1
        if not self._is_cut_off and self._loses(LOST_OUT.get(kind)):
            self.tally.lost[kind] += 1
            return False
        if can_id == od.heartbeat_cob_id(self.node_id) and self._draw(self.faults.long):
            too_long = self._pass(can_id, data + b"\0")
            self.injected.long += too_long
            return too_long
        return self._pass(can_id, data)

    def _out_chunk(self, data: bytes) -> None:
        counter = data[_CHUNK_COUNTER_BYTE]
        if counter != self._counter:
            self._begin_scan(counter)
        self._chunks += 1
        injected = self.injected
        if self._fate == "reset" and self._chunks > self._half and not self._to_reset:
            self._to_reset, self._fate = True, ""
            injected.reset += 1
        if self._fate == "torn":
            if self._chunks > self._half:
                self.tally.lost[Kind.CHUNK] += 1
                return
            injected.torn_chunks += 1
        index = self._index_of(data) if max(self._struck, self._lost_next) >= 0 else -2
        if self._fate == "understated":
            self._packed.append(data)
        if index == self._lost_next or (index == self._struck and self._fate == "understated"):
            self.tally.lost[Kind.CHUNK] += 1
            return
        if index == self._struck and self._fate == "displaced":
            data = _with_byte(data, _CHUNK_COUNTER_BYTE, self._following(self._counter))
            injected.displaced += 1
        if self._counter_instead is not None:
            data = _with_byte(data, _CHUNK_COUNTER_BYTE, self._counter_instead)
        fault = self._draw_one(OF_CHUNKS) if self._fate == "" and self._counter_instead is None else ""
        swapped, self._swapped = self._swapped, None
        try:
            self._send_chunk(fault, data)
        finally:  # a bus may refuse one frame and accept the other
            self._release([] if swapped is None else [swapped])

    def _begin_scan(self, counter: int) -> None:
        was_torn, before = self._fate == "torn", self._counter
        self._lost_next = self._struck if self._fate == "displaced" else -1
        self._counter, self._chunks, self._spoilt = counter, 0, False
        self._counter_instead = before if was_torn else None
        self._fate = "" if was_torn or self._lost_next >= 0 else self._draw_one(OF_SCANS)
        if self._fate == "torn":
            self.injected.torn += 1
        self._packed, self._struck = [], -1
        if self._fate in ("displaced", "understated"):
            struck = self.faults.struck
            self._struck = int(self._random.integers(self.profile.n_chunks)) if struck is None else struck

    def _send_chunk(self, fault: str, data: bytes) -> None:
        injected, chunk_id = self.injected, self._chunk_id
        match fault:
            case "":
                self._pass(chunk_id, data)
                return
            case "lost":
                self.tally.lost[Kind.CHUNK] += 1
            case "duplicated":
                self._pass(chunk_id, data)
                self.tally.handed[Kind.CHUNK] += 1
                self._pass(chunk_id, data)
            case "reordered":
                self._swapped = chunk_id, data
                self.tally.waiting[Kind.CHUNK] += 1
            case "late":
                self._late.append((data[_CHUNK_COUNTER_BYTE], data))
                self.tally.waiting[Kind.CHUNK] += 1
            case "short":
                if not self._pass(chunk_id, data[:-1], spoilt=True):
                    return  # silenced, whatever it would have been
            case "remote":
                self.tally.lost[Kind.CHUNK] += 1
                self.tally.handed[Kind.REMOTE] += 1
                if not self._pass(chunk_id, b"", remote=True):
                    return
            case "miscounted":
                wrong = _with_byte(data, _CHUNK_COUNTER_BYTE, self._another(self._counter))
                if not self._pass(chunk_id, wrong, spoilt=True):
                    return
            case "corrupted":
                at = self.profile.chunk_head_bytes
                wrong = _with_byte(data, at, data[at] ^ int(self._random.integers(1, 256)))
                if not self._pass(chunk_id, wrong):
                    return
        setattr(injected, fault, getattr(injected, fault) + 1)
        if fault not in ("duplicated", "reordered") and not self._spoilt:
            self._spoilt = True
            injected.scans_spoilt += 1

    def _another(self, counter: int) -> int:
        off = self.faults.miscounted_by
        return (counter + (int(self._random.integers(1, 256)) if off is None else off)) & 0xFF

    def _following(self, counter: int) -> int:
        """Return the counter of the scan after the one with ``counter``."""
        overflow = self._store.integer(od.SYNC_COUNTER_OVERFLOW)
        return counter % overflow + 1 if overflow else counter + 1 & 0xFF

    def _out_summary(self, data: bytes) -> None:
        if data[_SUMMARY_COUNTER_BYTE] != self._counter:  # a scan without chunks
            self._begin_scan(data[_SUMMARY_COUNTER_BYTE])
        swapped, self._swapped = self._swapped, None
        try:
            if self._fate == "summary_lost":
                self.injected.summary_lost += 1
                self.tally.lost[Kind.SUMMARY] += 1
            elif self._fate == "torn":
                self.tally.lost[Kind.SUMMARY] += 1
            else:
                if self._counter_instead is not None:
                    data = _with_byte(data, _SUMMARY_COUNTER_BYTE, self._counter_instead)
                if self._fate in ("understated", "unchecked"):
                    data = self._untrue(data)
                self._pass(self._summary_id, data)
        finally:
            self._release([] if swapped is None else [swapped])

    def _untrue(self, data: bytes) -> bytes:
        """Return the summary of a scan that is understated or unchecked."""
        said = unpack_summary(data)
        if self._fate == "unchecked":
            self.injected.unchecked += 1
            return pack_summary(
                said.scan, said.flags & ~SummaryFlag.CHECKED, said.chunks, said.device_time_us
            )
        if len(self._packed) != self.profile.n_chunks:  # the codes of the other chunks are unknown here
            return data
        self.injected.understated += 1
        head = said.scan, said.flags | SummaryFlag.CHANGED_ONLY, said.chunks - 1, said.device_time_us
        if said.check is None:
            return pack_summary(*head)
        return pack_checked_summary(*head, unpack_scan_with_check(b"".join(self._packed), self.profile)[1])

    def _imposture(self, can_id: int, data: bytes) -> bytes:
        """The answer to an upload, changed where it is about who the node is."""
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
            return _with_byte(data, 4, data[4] ^ 0xFF)
        return data

    def _pass(self, can_id: int, data: bytes, *, remote: bool = False, spoilt: bool = False) -> bool:
        """On the bus with it; unless it is ``spoilt``, so that nobody takes it for one of its scan, also with
        whatever waited for the next scan. Whether it was let out."""
        kind = kind_of(can_id, data, remote)
        if self._is_cut_off:
            self.injected.silenced += 1
            self.tally.silenced[kind] += 1
            return False
        try:
            self._emit(can_id, data, remote=remote)
        except BusError:
            self.tally.refused[kind] += 1
            raise
        self.tally.emitted[kind] += 1
        is_pdo = can_id in (self._chunk_id, self._summary_id) and not remote
        self.injected.pdos += is_pdo
        if self._late and is_pdo and not spoilt:
            due = [chunk for counter, chunk in self._late if counter != self._counter]
            self._late = [(counter, chunk) for counter, chunk in self._late if counter == self._counter]
            self._release([(self._chunk_id, chunk) for chunk in due])
        return True

    def _release(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Send chunks that waited, even after the bus has refused one. Raises BusError if it refused any."""
        failure: BusError | None = None
        for can_id, data in frames:
            self.tally.waiting[Kind.CHUNK] -= 1
            try:
                self._pass(can_id, data)
            except BusError as error:
                failure = error
        if failure is not None:
            raise failure

    @property
    def _is_cut_off(self) -> bool:
        """Return whether no frame of the node reaches the bus."""
        return self.faults.silent or self._unplugged or self._to_reset

    # --- chance

    def _draw(self, share: float) -> bool:
        return share > 0.0 and bool(self._random.random() < share)

    def _loses(self, fault: str | None) -> bool:
        """Return whether the fault of its kind drops a frame, and count the drop."""
        if fault is None or not self._draw(getattr(self.faults, fault)):
            return False
        setattr(self.injected, fault, getattr(self.injected, fault) + 1)
        return True

    def _draw_one(self, names: tuple[str, ...]) -> str:
        """One of the faults by its share, or none."""
        faults = self.faults
        if faults is NO_FAULTS:
            return ""
        left = self._random.random()
        for name in names:
            left -= getattr(faults, name)
            if left < 0.0:
                return name
        return ""


def _with_byte(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + bytes([value]) + data[at + 1 :]


def _periods_ns(faults: Faults) -> dict[str, int]:
    """How often each thing is done that is done by the clock; 0: never."""
    rates = {"emcy": faults.emcy_per_s, "babble": faults.babble_per_s}
    periods = {name: round(1e9 / rate) if rate else 0 for name, rate in rates.items()}
    return {"restart": round(faults.restart_every_s * 1e9), **periods}
