"""Faults in outgoing chunks and summaries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

from skinnode.canopen import indices as od
from skinnode.errors import BusError
from skinnode.protocol.chunk import chunk_indexer, unpack_scan_with_check
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.summary import SummaryFlag, pack_checked_summary, pack_summary, unpack_summary
from vcan_sim.faults import NO_FAULTS, OF_CHUNKS, OF_SCANS
from vcan_sim.injector import Injector
from vcan_sim.tally import Kind

_CHUNK_COUNTER_BYTE: Final = 1
_SUMMARY_COUNTER_BYTE: Final = 0


class Put(Protocol):
    """Function that puts a frame on the bus unless the node is cut off, and returns whether it was sent."""

    def __call__(self, can_id: int, data: bytes, *, remote: bool = False) -> bool:
        """Put a frame on the bus. Raises BusError if the bus rejects the frame."""


class FaultyScans:
    """Injects faults into the chunks and summaries that a node sends.

    A scan has either one scan fault or chunk faults in any number of its chunks. A chunk has at most one
    fault.

    Args:
        injector: The node's faults, random generator and counts.
        node_id: Node-ID.
        profile: Protocol profile of the node.
        put: Function that puts a frame on the bus.
        counter_overflow: Function that returns the node's SYNC counter overflow value (0x1019).
    """

    def __init__(
        self,
        injector: Injector,
        node_id: int,
        profile: PatchProfile,
        *,
        put: Put,
        counter_overflow: Callable[[], int],
    ) -> None:
        self.reset_due = False
        """Whether the node must be reset. It sends nothing until it is reset."""
        self._injector, self._profile = injector, profile
        self._put, self._counter_overflow = put, counter_overflow
        self._chunk_id, self._summary_id = od.chunk_cob_id(node_id), od.summary_cob_id(node_id)
        self._counter = -1  # counter of the current scan, as set by the node
        self._chunks = 0  # number of chunks so far in the current scan
        self._half = max(1, profile.n_chunks // 2)
        self._fate = ""  # fault of the current scan, from OF_SCANS
        self._spoilt = False
        self._intact = False  # whether this scan is unaffected by its own and earlier scans' faults
        self._counter_instead: int | None = None  # counter of a torn scan, repeated in this scan
        self._index_of = chunk_indexer(profile)
        self._packed: list[bytes] = []  # chunks of the current scan, as packed by the node
        self._struck = -1  # index of the chunk affected by the scan fault
        self._lost_next = -1  # index of the chunk to drop after a displaced scan
        self._swapped: bytes | None = None  # chunk to be sent after the next frame
        self._late: list[tuple[int, bytes]] = []  # late chunks, with the counters of their scans

    @property
    def needs_next_scan(self) -> bool:
        """Whether this scan's fault extends into the next scan, so that the next SYNC must not be lost."""
        return self._fate in ("torn", "displaced")

    def power_off(self) -> None:
        """Discard the late and reordered chunks that have not been sent yet."""
        tally = self._injector.tally
        tally.silenced[Kind.CHUNK] += tally.waiting.pop(Kind.CHUNK, 0)
        self._swapped, self._late = None, []

    def send_chunk(self, data: bytes) -> None:
        """Apply the scan fault or a chunk fault to a chunk, and send it."""
        counter = data[_CHUNK_COUNTER_BYTE]
        if counter != self._counter:
            self._begin_scan(counter)
        self._chunks += 1
        if self._intact and self._injector.faults is NO_FAULTS:  # this path is three times as fast
            self._send(self._chunk_id, data)
            return
        changed = self._suffer_scan(data)
        if changed is None:
            self._injector.tally.lost[Kind.CHUNK] += 1
            return
        if self._counter_instead is not None:
            changed = _with_byte(changed, _CHUNK_COUNTER_BYTE, self._counter_instead)
        untouched = self._fate == "" and self._counter_instead is None
        fault = self._injector.draw_one(OF_CHUNKS) if untouched else ""
        swapped, self._swapped = self._swapped, None
        try:
            self._suffer_chunk(fault, changed)
        finally:  # send the swapped chunk even if the bus rejects this one
            self._release([] if swapped is None else [swapped])

    def send_summary(self, data: bytes) -> None:
        """Apply the scan fault to a summary, and send it."""
        injected, tally = self._injector.injected, self._injector.tally
        if data[_SUMMARY_COUNTER_BYTE] != self._counter:  # a scan without chunks
            self._begin_scan(data[_SUMMARY_COUNTER_BYTE])
        swapped, self._swapped = self._swapped, None
        try:
            if self._fate == "summary_lost":
                injected.summary_lost += 1
                tally.lost[Kind.SUMMARY] += 1
            elif self._fate == "torn":
                tally.lost[Kind.SUMMARY] += 1
            else:
                if self._counter_instead is not None:
                    data = _with_byte(data, _SUMMARY_COUNTER_BYTE, self._counter_instead)
                if self._fate in ("understated", "unchecked"):
                    data = self._untrue(data)
                self._send(self._summary_id, data)
        finally:
            self._release([] if swapped is None else [swapped])

    # --- scan faults

    def _begin_scan(self, counter: int) -> None:
        was_torn, before = self._fate == "torn", self._counter
        self._lost_next = self._struck if self._fate == "displaced" else -1
        self._counter, self._chunks, self._spoilt = counter, 0, False
        self._counter_instead = before if was_torn else None
        self._fate = "" if was_torn or self._lost_next >= 0 else self._injector.draw_one(OF_SCANS)
        if self._fate == "torn":
            self._injector.injected.torn += 1
        self._packed, self._struck = [], -1
        self._intact = (
            self._fate == ""
            and self._counter_instead is None
            and self._lost_next < 0
            and self._swapped is None
        )
        if self._fate in ("displaced", "understated"):
            struck = self._injector.faults.struck
            chunks = self._profile.n_chunks
            self._struck = int(self._injector.random.integers(chunks)) if struck is None else struck

    def _suffer_scan(self, data: bytes) -> bytes | None:
        """Apply the scan fault to a chunk. Return the resulting chunk, or None if it is lost."""
        injected = self._injector.injected
        if self._fate == "reset" and self._chunks > self._half and not self.reset_due:
            self.reset_due, self._fate = True, ""
            injected.reset += 1
        if self._fate == "torn":
            if self._chunks > self._half:
                return None
            injected.torn_chunks += 1
        index = self._index_of(data) if max(self._struck, self._lost_next) >= 0 else -2
        if self._fate == "understated":
            self._packed.append(data)
        if index == self._lost_next or (index == self._struck and self._fate == "understated"):
            return None
        if index == self._struck and self._fate == "displaced":
            injected.displaced += 1
            return _with_byte(data, _CHUNK_COUNTER_BYTE, self._following(self._counter))
        return data

    def _following(self, counter: int) -> int:
        """Return the scan counter that follows ``counter``."""
        overflow = self._counter_overflow()
        return counter % overflow + 1 if overflow else counter + 1 & 0xFF

    def _untrue(self, data: bytes) -> bytes:
        """Return the falsified summary of an understated or unchecked scan."""
        said, injected = unpack_summary(data), self._injector.injected
        if self._fate == "unchecked":
            injected.unchecked += 1
            return pack_summary(
                said.scan, said.flags & ~SummaryFlag.CHECKED, said.chunks, said.device_time_us
            )
        if len(self._packed) != self._profile.n_chunks:  # the check requires the codes of all chunks
            return data
        injected.understated += 1
        head = said.scan, said.flags | SummaryFlag.CHANGED_ONLY, said.chunks - 1, said.device_time_us
        if said.check is None:
            return pack_summary(*head)
        return pack_checked_summary(*head, unpack_scan_with_check(b"".join(self._packed), self._profile)[1])

    # --- chunk faults

    def _suffer_chunk(self, fault: str, data: bytes) -> None:
        if not fault:
            self._send(self._chunk_id, data)
            return
        if not _CHUNK_FAULTS[fault](self, data):
            return  # the node is cut off, and the frame counts as silenced
        self._injector.count(fault)
        if fault not in ("duplicated", "reordered") and not self._spoilt:
            self._spoilt = True
            self._injector.injected.scans_spoilt += 1

    # Each of these methods tries to inject one chunk fault and returns whether it succeeded.

    def _lose(self, data: bytes) -> bool:
        self._injector.tally.lost[Kind.CHUNK] += 1
        return True

    def _duplicate(self, data: bytes) -> bool:
        self._send(self._chunk_id, data)
        self._injector.tally.handed[Kind.CHUNK] += 1
        self._send(self._chunk_id, data)
        return True

    def _reorder(self, data: bytes) -> bool:
        self._swapped = data
        self._injector.tally.waiting[Kind.CHUNK] += 1
        return True

    def _delay(self, data: bytes) -> bool:
        self._late.append((data[_CHUNK_COUNTER_BYTE], data))
        self._injector.tally.waiting[Kind.CHUNK] += 1
        return True

    def _shorten(self, data: bytes) -> bool:
        return self._send(self._chunk_id, data[:-1], spoilt=True)

    def _replace_by_remote(self, data: bytes) -> bool:
        tally = self._injector.tally
        tally.lost[Kind.CHUNK] += 1
        tally.handed[Kind.REMOTE] += 1
        return self._put(self._chunk_id, b"", remote=True)

    def _miscount(self, data: bytes) -> bool:
        off = self._injector.faults.miscounted_by
        off = int(self._injector.random.integers(1, 256)) if off is None else off
        wrong = _with_byte(data, _CHUNK_COUNTER_BYTE, (self._counter + off) & 0xFF)
        return self._send(self._chunk_id, wrong, spoilt=True)

    def _corrupt(self, data: bytes) -> bool:
        at = self._profile.chunk_head_bytes
        wrong = _with_byte(data, at, data[at] ^ int(self._injector.random.integers(1, 256)))
        return self._send(self._chunk_id, wrong)

    # --- to the bus

    def _send(self, can_id: int, data: bytes, *, spoilt: bool = False) -> bool:
        """Send a chunk or summary, then the late chunks of earlier scans.

        A ``spoilt`` frame does not release late chunks, because it does not show a receiver that a new scan
        has begun. Returns whether the frame itself was sent.
        """
        if not self._put(can_id, data):
            return False
        self._injector.injected.pdos += 1
        if self._late and not spoilt:
            due = [chunk for counter, chunk in self._late if counter != self._counter]
            self._late = [(counter, chunk) for counter, chunk in self._late if counter == self._counter]
            self._release(due)
        return True

    def _release(self, chunks: Sequence[bytes]) -> None:
        """Send delayed chunks. Raises BusError after the last frame if the bus rejects any of them."""
        failure: BusError | None = None
        for data in chunks:
            self._injector.tally.waiting[Kind.CHUNK] -= 1
            try:
                self._send(self._chunk_id, data)
            except BusError as error:
                failure = error
        if failure is not None:
            raise failure


_CHUNK_FAULTS: Final[dict[str, Callable[[FaultyScans, bytes], bool]]] = {
    "lost": FaultyScans._lose,
    "duplicated": FaultyScans._duplicate,
    "reordered": FaultyScans._reorder,
    "late": FaultyScans._delay,
    "short": FaultyScans._shorten,
    "remote": FaultyScans._replace_by_remote,
    "miscounted": FaultyScans._miscount,
    "corrupted": FaultyScans._corrupt,
}


def _with_byte(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + bytes([value]) + data[at + 1 :]
