"""Sends scans through the TPDOs of a node: first the chunks, then the summary.

Chunks are sent in the first TPDO whose first mapped object is 0x2010 and that is event-driven or due at the
SYNC that starts the scan. The summary is sent in every TPDO whose first mapped object is 0x2011. If such a
TPDO is event-driven, or was due at the SYNC that started the scan, it immediately follows the chunks.
Otherwise, it is sent at the next SYNC at which it is due. If that SYNC starts a scan and the summary belongs
to a scan that an earlier SYNC started, only the summary of the new scan is sent. The end of a scan also
triggers all event-driven TPDOs that contain other objects.

**Pacing.** CiA 301 defines the inhibit time as a minimum interval between frames. Under a general-purpose
operating system, threads can wake up late, so with a strict minimum interval, a scan could take longer than
the SYNC period. The stream therefore makes up for delays of up to ``catch_up_ns``, if necessary by sending
several frames at once. The mean frame rate stays within the limit set by the inhibit time (generic cell rate
algorithm, ITU-T I.371). If ``catch_up_ns`` is 0, the minimum interval is strict.

The node has no clock to measure how long it takes to read the resistances after a SYNC. The stream therefore
requests a timer event immediately after the first chunk and paces the second chunk from the time of that
event.

**Synchronous window (0x1007).** Chunks and summaries in synchronous TPDOs are discarded if they are still
unsent when the window closes. Event-driven TPDOs are not affected.

**Queue.** While a scan is being sent, one other scan can wait. Chunks of two scans are never interleaved. If
the node leaves OPERATIONAL, all scans are dropped without a summary. If the chunk TPDO is disabled,
the summary states that chunks are missing.

**Lost frames.** If a chunk or a summary cannot be sent, receivers no longer know the codes of unsent chunks,
so the next scan must be a full scan. This does not apply to chunks that are discarded at the end of the
synchronous window: in a full scan, even more chunks would be discarded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from skinnode.canopen import indices as od
from skinnode.errors import BusError
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.pdo.tpdo import Tpdo, TpdoEngine
from skinnode.protocol.summary import SummaryFlag, pack_checked_summary, pack_summary, pack_summary_record

_HELD_UP: Final = 0.1
"""Fraction of the sending time that delays must exceed for a skipped scan to be blamed on a slow computer or
bus. Delays due to normal scheduling jitter are shorter."""


@dataclass(frozen=True, slots=True)
class OutgoingScan:
    """Scan that is ready to be sent."""

    counter: int
    """Scan counter, u8."""
    chunks: list[bytes]
    """Payloads of the chunks to send, in order."""
    flags: int
    """Bits of :class:`~skinnode.protocol.summary.SummaryFlag`."""
    device_time_us: int
    """Time of the scan on the node's clock in µs, modulo 2³²."""
    check_of_codes: int | None = None
    """CRC over the codes that the receiver will have after this scan; None for a summary without a check."""
    turns: frozenset[int] | None = None
    """Numbers of the synchronous TPDOs that were due at the SYNC that started the scan; None if no SYNC
    started it."""


class ScanStream:
    """Sends the scans of a patch.

    Args:
        store: Object dictionary.
        tpdos: TPDO engine of the node.
        chunk: Initial contents of the chunk record (0x2010).
        catch_up_ns: Maximum delay, in ns, that the stream makes up by sending later chunks sooner.
        on_lost: Callback for a scan of which a chunk or the summary could not be sent.
    """

    def __init__(
        self,
        store: ObjectStore,
        tpdos: TpdoEngine,
        chunk: bytes,
        catch_up_ns: int,
        on_lost: Callable[[], None],
    ) -> None:
        self._tpdos, self._catch_up_ns, self._on_lost = tpdos, catch_up_ns, on_lost
        self._whole_record = [(od.CHUNK, sub) for sub in range(1, store.integer(od.CHUNK, 0) + 1)]
        self._scan: OutgoingScan | None = None
        self._ended: OutgoingScan | None = None
        self._next_scan: OutgoingScan | None = None
        self._carrier: Tpdo | None = None  # TPDO of the current scan's chunks
        self._unsent: deque[bytes] = deque()
        self._verbatim = False  # whether the carrier's mapping is exactly the chunk record
        self._chunks_sent = 0
        self._cut_off = False  # whether the synchronous window has closed before the last chunk
        self._busy_ns = 0  # time at which the stream last started sending after being idle
        self._just_begun = False
        self._paced_ns = 0  # sum of all inhibit times since _busy_ns
        self.chunk = chunk
        """Contents of the chunk record (0x2010): the last chunk sent."""
        self.summary = bytes(12)
        """Contents of the summary record (0x2011): the summary of the last scan."""
        self.scans_sent = 0
        """Number of scans sent completely."""
        tpdos.claim(od.CHUNK, self)
        tpdos.claim(od.SUMMARY, self)

    @property
    def full(self) -> bool:
        """Whether a scan is being sent and another scan is already waiting."""
        return self._next_scan is not None

    def is_held_up(self, t_ns: int) -> bool:
        """Return whether the stream is sending more slowly than the inhibit time allows.

        This happens if the thread gets too little processor time or frames cannot be sent.
        """
        busy_ns = t_ns - self._busy_ns
        lost_ns = busy_ns - self._paced_ns
        return self._scan is not None and lost_ns > max(self._catch_up_ns, _HELD_UP * busy_ns)

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which :meth:`on_timer` must be called next."""
        if self._scan is None:
            return NO_DEADLINE_NS
        return 0 if self._carrier is None or self._just_begun else self._carrier.ready_ns

    # --- methods called by the TPDO engine

    def sends(self, tpdo: Tpdo) -> bool:
        """Return whether ``tpdo`` carries the chunks of the current scan."""
        return tpdo is self._carrier

    def on_reload(self, tpdo: Tpdo) -> None:
        """Drop the remaining chunks of the current scan if their TPDO was disabled or remapped."""
        if tpdo is not self._carrier:
            return
        if tpdo.parameters.enabled and tpdo.first_index == od.CHUNK:
            self._verbatim = self._carries_record(tpdo)
        else:
            self._unsent.clear()
            self._carrier = None

    # --- events

    def stop(self) -> None:
        """Drop all scans without a summary when the node leaves OPERATIONAL."""
        self._unsent.clear()
        self._scan = self._next_scan = self._carrier = None

    def on_sync(self, turns: frozenset[int], t_ns: int, *, starts_scan: bool) -> None:
        """Send the waiting summaries that are due at a SYNC.

        If the SYNC starts a scan, only the summary of a scan that was not started by a SYNC is sent. If that
        scan is still being sent, its summary follows its chunks.

        Args:
            turns: Numbers of the synchronous TPDOs that are due.
            t_ns: Current time, in ns.
            starts_scan: Whether the SYNC starts a scan.
        """
        if starts_scan:
            if self._scan is not None and self._scan.turns is None:
                self._scan = replace(self._scan, turns=turns)
            if self._ended is None or self._ended.turns is not None:
                return
        for tpdo in self._tpdos.owned(od.SUMMARY):
            if tpdo.waiting and tpdo.number in turns:
                self._tpdos.transmit(tpdo, t_ns)

    def offer(self, scan: OutgoingScan, t_ns: int) -> None:
        """Send a scan, immediately or after the current scan. :attr:`full` must be false.

        Args:
            scan: Scan to send.
            t_ns: Current time, in ns.
        """
        if self._scan is None:
            self._busy_ns, self._paced_ns = t_ns, 0
            self._begin(scan, t_ns)
            self._send_due(t_ns)
            self._just_begun = True
        else:
            self._next_scan = scan

    def on_timer(self, t_ns: int) -> None:
        """Send the chunks and summaries due at ``t_ns``."""
        carrier = self._carrier
        if self._just_begun and carrier is not None:
            earliest_ns = t_ns - self._catch_up_ns + carrier.parameters.inhibit_ns
            carrier.ready_ns = max(carrier.ready_ns, earliest_ns)
        self._just_begun = False
        self._send_due(t_ns)

    def _send_due(self, t_ns: int) -> None:
        while self._scan is not None and self._stream(t_ns):
            ended, self._scan, self._carrier = self._scan, None, None
            following, self._next_scan = self._next_scan, None
            try:
                self._end(ended, t_ns)
            except BusError:
                self._on_lost()
                raise
            finally:  # start the next scan even if the summary cannot be sent
                if following is not None:
                    self._begin(following, t_ns)

    def _begin(self, scan: OutgoingScan, t_ns: int) -> None:
        self._scan, self._carrier, self._chunks_sent, self._cut_off = scan, None, 0, False
        for tpdo in self._tpdos.owned(od.CHUNK):
            if tpdo.parameters.event_driven or tpdo.number in (scan.turns or ()):
                self._carrier = tpdo
                self._verbatim = bool(scan.chunks) and self._carries_record(tpdo)
                tpdo.waiting = False
                self._unsent.extend(scan.chunks)
                tpdo.ready_ns = max(tpdo.ready_ns, t_ns)  # prevents a burst of chunks after a pause
                return

    def _carries_record(self, tpdo: Tpdo) -> bool:
        return [(each.index, each.subindex) for each in tpdo.parameters.mapping] == self._whole_record

    def _stream(self, t_ns: int) -> bool:
        """Send the chunks that are due. Return whether all chunks have been sent or discarded."""
        unsent, carrier = self._unsent, self._carrier
        if carrier is None:
            return True
        tpdos, inhibit_ns = self._tpdos, carrier.parameters.inhibit_ns
        earliest_ns = t_ns - self._catch_up_ns
        while unsent and carrier.ready_ns <= t_ns:
            if carrier.parameters.synchronous and not tpdos.window.lets_out(carrier.number, t_ns):
                unsent.clear()
                self._cut_off = True
                break
            self.chunk = unsent.popleft()
            carrier.ready_ns = max(carrier.ready_ns, earliest_ns) + inhibit_ns
            self._paced_ns += inhibit_ns
            tpdos.emit(carrier, self.chunk if self._verbatim else tpdos.payload(carrier))
            self._chunks_sent += 1  # counted only now, because sending the chunk may have failed
        return not unsent

    def _end(self, scan: OutgoingScan, t_ns: int) -> None:
        flags = scan.flags
        if self._chunks_sent != len(scan.chunks):
            flags |= SummaryFlag.OVERRUN
            if not self._cut_off:
                self._on_lost()
        said = scan.counter, flags, self._chunks_sent, scan.device_time_us
        payload = (
            pack_summary(*said)
            if scan.check_of_codes is None
            else pack_checked_summary(*said, scan.check_of_codes)
        )
        self.summary = pack_summary_record(payload, scan.device_time_us)
        self.scans_sent += 1
        self._ended = scan
        for tpdo in self._tpdos.owned(od.SUMMARY):
            if tpdo.parameters.event_driven:
                self._tpdos.request(tpdo, t_ns)
            elif tpdo.number in (scan.turns or ()):
                self._tpdos.transmit(tpdo, t_ns)
            else:
                tpdo.waiting = True
        self._tpdos.trigger(t_ns)
