"""Assembles the frames of one patch into scans. Not thread-safe.

**Grouping.** A frame belongs to the open scan if it carries the scan's counter and arrives within the
*timeout* after the scan's first frame. The timeout is three periods, or less if the counter range is short.
The first frame of a newer scan permanently closes the open scan. Because counters repeat, a frame that is a
full counter cycle late could be mistaken for a frame of a later scan. This is impossible if every frame
arrives less than counter range × period − timeout after its SYNC. With the usual counter range of 240, this
limit is 237 periods.

**Two scans with the same counter.** This happens if a node fails to increment the counter or two nodes share
a node-ID. The assembler detects this if two different frames arrive for the same chunk or summary. It cannot
tell which scan the other frames belong to, so it discards all of them. It also discards an incomplete scan
whose chunks arrived more than two periods apart, because they may belong to two scans. If each chunk arrived
from at most one of the two scans, only the scan check can detect the mixture.

**Scan check.** A summary with :attr:`~skinnode.protocol.summary.SummaryFlag.CHECKED` carries a CRC over all
codes of the patch, including those of unsent chunks (:mod:`skinnode.protocol.scan_check`). A failed check
does not reveal which chunk is wrong, so the assembler discards the scan and all codes stored for unsent
chunks. A stream is *checked* once a check has passed, or after :meth:`ScanAssembler.reset` with
``checked=True``. In a checked stream, a scan is complete only if its check passed, and a summary without a
check is rejected. If all chunks of a scan arrived but the check is impossible, the scan is published as
*unchecked*. The check is impossible if the summary was lost or the codes of unsent chunks are unknown.
Patches of revision 1.0 send no checks, so their scans are complete once all chunks have arrived.

**Order.** A frame starts a newer scan if its counter is ahead of the last scan's counter by at most half the
counter range. Frames with other counters are late and are dropped. After one timeout without frames, a frame
with any counter is accepted, because the node or the SYNC producer may have restarted.

**Unsent chunks.** If the node sends only changed chunks, the other chunks keep their last codes
(:mod:`skinnode.protocol.partial_scan`). After a lost or incomplete scan, or a pause longer than the timeout,
the codes of unsent chunks are unknown until the node sends those chunks again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from skinnode.canopen.indices import chunk_cob_id, summary_cob_id
from skinnode.errors import CodecError, ConfigError
from skinnode.protocol.chunk import chunk_indexer
from skinnode.protocol.device_time import DeviceTimeTracker
from skinnode.protocol.partial_scan import HeldChunks
from skinnode.protocol.payload import PDO_BYTES
from skinnode.protocol.profile import DEFAULT_PERIOD_MS, PatchProfile
from skinnode.protocol.scan import AssemblerStats, Scan
from skinnode.protocol.scan_check import scan_check
from skinnode.protocol.summary import HEAD_BYTES, Summary, SummaryFlag, unpack_summary
from skinnode.text.words import counted

_CHUNK_INDICES: Final = 256
_NOT_EXPECTED: Final = b""
"""Placeholder payload for chunk indices beyond the patch's last chunk. An invalid index thus looks like a
repeated chunk, so the range is checked only for repeated chunks."""
_NONE_OPEN: Final = -1  # scan counters are never negative
_NEVER: Final = -1
# Plain integers, because testing an enum flag takes as long as processing a chunk.
_CHANGED_ONLY, _OVERRUN = int(SummaryFlag.CHANGED_ONLY), int(SummaryFlag.OVERRUN)
_BASELINE_CHANGED: Final = int(SummaryFlag.BASELINE_CHANGED)


class ScanAssembler:
    """Assembles the scans of one patch. Each call returns at most one scan; scans are returned in order.

    Call :meth:`poll` after each batch of frames, and at the time given by :meth:`next_deadline_ns`. ``poll``
    returns scans whose missing frames have timed out. If a frame closes two scans, the call that processes
    the frame returns the first scan and ``poll`` returns the second.

    Args:
        profile: Dimensions of the patch.
        counter_overflow: Synchronous counter overflow value (0x1019) if scans carry the SYNC counter; 0 if
            the patch counts its own scans from 0 to 255.
        period_ns: Scan period, in ns. The timeout is a multiple of this period.
        grace_ns: Maximum time (ns) to wait for the remaining frames once the summary or all chunks of a full
            scan have arrived.
        node_id: Node-ID for the COB-IDs in the errors passed to ``on_reject``.
        on_reject: Callback that receives a CodecError for each frame with a wrong length, and for each
            summary that lacks a required check.
        under_way: Whether the node may already be sending scans; see :meth:`reset`.

    Raises:
        ConfigError: If ``counter_overflow`` is neither 0 nor 2 to 240, or a time is not positive.
    """

    def __init__(  # noqa: PLR0913 - keywords with defaults, each given alone by some caller
        self,
        profile: PatchProfile,
        *,
        counter_overflow: int = 0,
        period_ns: int = DEFAULT_PERIOD_MS * 1_000_000,
        grace_ns: int = 5_000_000,
        node_id: int = 0,
        on_reject: Callable[[CodecError], None] | None = None,
        under_way: bool = False,
    ) -> None:
        if counter_overflow != 0 and not 2 <= counter_overflow <= 240:
            raise ConfigError("counter_overflow", counter_overflow, "0 or 2 to 240")
        for name, time_ns in (("period_ns", period_ns), ("grace_ns", grace_ns)):
            if time_ns <= 0:
                raise ConfigError(name, time_ns, "more than 0")
        self._profile = profile
        self._n = profile.n_chunks
        self._chunk_bytes = profile.chunk_bytes
        self._index_of = chunk_indexer(profile)
        self._lowest, self._range = (1, counter_overflow) if counter_overflow else (0, 256)
        periods = min(3, max(1, (self._range - 1) // 2))
        self._timeout_ns = period_ns * periods
        self._longest_ns = period_ns * (2 if periods == 3 else periods)
        self._grace_ns = grace_ns
        self._node_id = node_id
        self._on_reject = on_reject
        self.on_discarded: Callable[[], None] | None = None
        """Callback for a discarded scan that may have announced a new baseline; None for no callback."""

        # State of the open scan, or of the last scan if none is open.
        self._counter = _NONE_OPEN
        self._last_counter = _NEVER
        self._scan = _NEVER
        self._frames: list[bytes | None] = self._no_frames()
        self._mixed = False
        self._may_join, self._joined_late = under_way, False
        self._received = 0
        self._sent = _NEVER
        self._summary: Summary | None = None
        self._head = b""  # bytes of the summary covered by the scan check
        self._checked = False
        self._device_time = DeviceTimeTracker()
        self._expires_ns = self._t_first_ns = self._t_last_ns = 0
        self._t_chunk_ns = self._t_summary_ns = 0  # arrival times: last chunk, summary

        self._held = HeldChunks(profile)
        self._follows = False  # whether the open scan follows the last scan without a gap
        self._changed_only = False

        self._complete = self._torn = self._missed = self._discarded = self._mixed_scans = self._resyncs = 0
        self._joined = self._unchecked = self._corrupt = 0
        self._chunks = self._summaries = self._chunks_lost = self._summaries_lost = 0
        self._duplicates = self._conflicts = self._late = 0
        self._bad_length = self._bad_index = self._bad_counter = self._bad_form = 0

    # --- frames in

    def on_chunk(self, data: bytes, t_ns: int) -> Scan | None:
        """Process a chunk.

        Args:
            data: Payload of TPDO1. The assembler keeps a reference to this object.
            t_ns: Arrival time, in ns.

        Returns:
            The scan that this chunk closed, or None.
        """
        if len(data) != self._chunk_bytes:
            self._reject_length(chunk_cob_id(self._node_id), data, self._chunk_bytes, "chunk")
            return None
        if data[1] != self._counter or t_ns > self._expires_ns:
            return self._on_chunk_of_another_scan(data, t_ns)
        index = self._index_of(data)
        if self._frames[index] is not None:
            self._on_repeated_chunk(index, data)
            return None
        self._frames[index] = data
        self._t_last_ns = t_ns
        self._received += 1
        if self._received == self._sent:
            return self._close()
        return None

    def on_summary(self, data: bytes, t_ns: int) -> Scan | None:
        """Process a summary.

        Args:
            data: Payload of TPDO2.
            t_ns: Arrival time, in ns.

        Returns:
            The scan that this summary closed, or None.
        """
        if len(data) != PDO_BYTES:
            self._reject_length(summary_cob_id(self._node_id), data, PDO_BYTES, "scan summary")
            return None
        summary = unpack_summary(data)
        if summary.check is None and self._checked:
            self._bad_form += 1
            self._reject(summary_cob_id(self._node_id), data, "a scan summary with a check (flag 0x20)")
            return None
        if summary.chunks > self._n:
            self._bad_index += 1
            return None
        closed: Scan | None = None
        if summary.scan == self._counter and t_ns <= self._expires_ns:
            if self._summary is not None:
                self._count_repeat(same=self._summary == summary)
                return None
        elif not self._is_news(summary.scan, t_ns, known=self._summary == summary):
            return None
        else:
            closed = self._close() if self._counter != _NONE_OPEN else None
            self._open(summary.scan, t_ns, from_its_begin=False)
        self._summary, self._head = summary, data[:HEAD_BYTES]
        self._sent = summary.chunks
        self._t_chunk_ns, self._t_summary_ns, self._t_last_ns = self._t_last_ns, t_ns, t_ns
        if closed is None and self._received >= self._sent:
            return self._close()
        return closed

    def poll(self, t_ns: int) -> Scan | None:
        """If the missing frames of the open scan have timed out, close the scan and return it.

        Args:
            t_ns: Current time, in ns.
        """
        deadline = self.next_deadline_ns()
        return self._close() if deadline is not None and t_ns >= deadline else None

    def next_deadline_ns(self) -> int | None:
        """Return the earliest time (ns) at which :meth:`poll` closes the open scan; None if no scan is open.

        This time can change whenever a frame arrives.
        """
        if self._counter == _NONE_OPEN:
            return None
        if self._received >= self._sent != _NEVER:
            return self._t_last_ns
        if self._sent != _NEVER or self._received == self._n:
            return min(self._t_last_ns + self._grace_ns, self._expires_ns)
        return self._expires_ns

    def reset(self, *, under_way: bool = False, checked: bool = False) -> None:
        """Discard the open scan, the stored codes and the scan counter, for example after a boot-up message.

        Args:
            under_way: Whether the node may already be sending scans. If so, the first scan is discarded if
                its beginning was missed, and its missing chunks are not counted as lost.
            checked: Whether every summary must contain a check. If false, checks become mandatory as soon as
                one has passed.
        """
        if self._counter != _NONE_OPEN:
            self._discarded += 1
            self._book()
        self._counter, self._last_counter = _NONE_OPEN, _NEVER
        self._changed_only = False
        self._may_join = under_way
        self._checked = checked
        self._device_time.reset()

    def expect_check(self) -> None:
        """Require a check in every summary from now on."""
        self._checked = True

    @property
    def conflicts(self) -> int:
        """Number of frames that contradict another frame of the same scan."""
        return self._conflicts

    @property
    def stats(self) -> AssemblerStats:
        """Snapshot of the counters."""
        is_open = self._counter != _NONE_OPEN
        return AssemblerStats(
            scans_complete=self._complete,
            scans_torn=self._torn,
            scans_unchecked=self._unchecked,
            scans_missed=self._missed,
            scans_discarded=self._discarded,
            scans_mixed=self._mixed_scans,
            scans_corrupt=self._corrupt,
            scans_joined=self._joined,
            chunks_accepted=self._chunks + is_open * self._received,
            summaries_accepted=self._summaries + (is_open and self._summary is not None),
            chunks_lost=self._chunks_lost,
            summaries_lost=self._summaries_lost,
            duplicates=self._duplicates,
            conflicts=self._conflicts,
            late=self._late,
            bad_length=self._bad_length,
            bad_index=self._bad_index,
            bad_counter=self._bad_counter,
            bad_form=self._bad_form,
            resyncs=self._resyncs,
        )

    # --- frames that start a scan, repeat an earlier frame, or are rejected

    def _on_chunk_of_another_scan(self, data: bytes, t_ns: int) -> Scan | None:
        index = self._index_of(data)
        if index >= self._n:
            self._bad_index += 1
            return None
        if not self._is_news(data[1], t_ns, known=self._frames[index] == data):
            return None
        closed = self._close() if self._counter != _NONE_OPEN else None
        self._open(data[1], t_ns, from_its_begin=index == 0)
        self._frames[index] = data
        self._received = 1
        return closed

    def _on_repeated_chunk(self, index: int, data: bytes) -> None:
        if index >= self._n:
            self._bad_index += 1
            return
        self._count_repeat(same=self._frames[index] == data)

    def _count_repeat(self, *, same: bool) -> None:
        if same:
            self._duplicates += 1
        else:
            self._conflicts += 1
            self._mixed = True

    def _reject_length(self, cob_id: int, data: bytes, length: int, what: str) -> None:
        self._bad_length += 1
        self._reject(cob_id, data, f"{counted(length, 'byte')} ({what})")

    def _reject(self, cob_id: int, data: bytes, allowed: str) -> None:
        if self._on_reject is not None:
            self._on_reject(CodecError(cob_id, data, allowed))

    def _is_news(self, counter: int, t_ns: int, *, known: bool) -> bool:
        """Return whether a frame starts a new scan. If not, count it as late, duplicate or invalid.

        ``known`` is true if the last scan contains an identical frame.
        """
        if not self._lowest <= counter < self._lowest + self._range:
            self._bad_counter += 1
            return False
        if self._last_counter == _NEVER:
            return True
        ahead = (counter - self._last_counter) % self._range
        if 0 < ahead <= self._range // 2:
            return True
        if ahead == 0 and t_ns > self._expires_ns:
            return True
        if ahead != 0 and t_ns > self._t_last_ns + self._timeout_ns:
            return True
        if ahead == 0 and known:
            self._duplicates += 1
        else:
            self._late += 1
        return False

    # --- opening and closing a scan

    def _no_frames(self) -> list[bytes | None]:
        return [None] * self._n + [_NOT_EXPECTED] * max(1, _CHUNK_INDICES - self._n)

    def _open(self, counter: int, t_ns: int, *, from_its_begin: bool) -> None:
        self._follows = False
        self._joined_late, self._may_join = self._may_join and not from_its_begin, False
        if self._last_counter == _NEVER:  # first scan, or first scan after a reset
            self._scan = counter if self._scan == _NEVER else self._scan + self._steps_to(counter, self._scan)
        else:
            ahead = self._steps_to(counter, self._last_counter)
            self._scan += ahead
            if ahead <= self._range // 2:
                self._missed += ahead - 1
                self._follows = ahead == 1 and t_ns <= self._t_last_ns + self._timeout_ns
            else:
                self._resyncs += 1
        self._counter = self._last_counter = counter
        self._frames = self._no_frames()
        self._mixed = False
        self._received = 0
        self._sent = _NEVER
        self._summary = None
        self._t_first_ns = self._t_last_ns = t_ns
        self._expires_ns = t_ns + self._timeout_ns

    def _steps_to(self, counter: int, last: int) -> int:
        """Return how many scans ``counter`` is ahead of ``last``, from 1 to the counter range."""
        return (counter - last) % self._range or self._range

    def _book(self) -> None:
        """Add the open scan's frames to the statistics."""
        self._chunks += self._received
        self._summaries += self._summary is not None

    def _close(self) -> Scan | None:
        """Close the open scan and return it, or return None if it must be discarded."""
        self._book()
        self._counter = _NONE_OPEN
        summary = self._summary
        whole = summary is not None and self._received >= summary.chunks
        summary_is_last = summary is not None and self._t_last_ns == self._t_summary_ns
        t_chunk_ns = self._t_chunk_ns if summary_is_last else self._t_last_ns
        if self._mixed or (not whole and t_chunk_ns - self._t_first_ns > self._longest_ns):
            self._mixed_scans += 1
            self._discard()
            return None
        expected, arrived, checked = self._n, self._received == self._n, self._checked
        device_time_us, flags = None, 0
        if summary is not None:
            expected, flags, checked = summary.chunks, summary.flags, summary.check is not None
            if not arrived:
                arrived = self._received == expected and flags & (_CHANGED_ONLY | _OVERRUN) == _CHANGED_ONLY
        if self._joined_late and not arrived:
            self._joined += 1
            self._discard(doubt=summary is None or flags & _BASELINE_CHANGED != 0)
            return None
        carry = arrived and self._follows
        if self._received or not carry:
            self._held.update(self._frames[: self._n], carry=carry)
        codes, valid, check = self._held.decode()
        verified = False
        if arrived and summary is not None and summary.check is not None and check is not None:
            verified = scan_check(check, self._head) == summary.check
            if not verified:
                self._corrupt += 1
                self._discard()
                return None
            self._checked = True
        complete = arrived and (verified or not checked)
        if summary is None:
            self._summaries_lost += 1
        else:
            self._changed_only = flags & _CHANGED_ONLY != 0
            device_time_us = self._device_time_us(summary)
        if summary is not None or not self._changed_only:
            self._chunks_lost += max(0, expected - self._received)
        self._complete += complete
        self._unchecked += arrived and not complete
        self._torn += not arrived
        return Scan(
            codes=codes,
            valid=valid,
            counter=self._last_counter,
            scan=self._scan,
            complete=complete,
            chunks_expected=expected,
            chunks_received=self._received,
            device_time_us=device_time_us,
            flags=flags,
            t_first_ns=self._t_first_ns,
            t_last_ns=self._t_last_ns,
        )

    def _discard(self, *, doubt: bool = True) -> None:
        """Discard all stored codes after a scan has been discarded.

        ``doubt`` is true if the scan may have announced a new baseline.
        """
        self._held.forget()
        if doubt and self.on_discarded is not None:
            self.on_discarded()

    def _device_time_us(self, summary: Summary) -> int:
        if summary.check is None:
            return summary.device_time_us
        return self._device_time.restore_us(summary.device_time_us, self._t_summary_ns)
