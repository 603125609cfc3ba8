"""Chunks and summaries of one patch, as they come off the bus, to scans. Plain code with one owner, no clock.

**A scan is never mixed from two.** A scan holds only frames with its own counter that arrived within the
*timeout* of its first frame, and it is closed for good when a frame of a newer scan arrives. So two scans can
only meet in one if they bear the same counter and their frames arrive within the timeout of each other: not
while counter range × period is longer than the timeout and the age of the oldest frame together, the age
counted from the SYNC of its scan to its arrival. The timeout is three periods (less where counters come round
sooner), so with the usual range of 240 scans a frame may be 237 periods old.

**Two scans under one counter**, from a node that did not count on or from two nodes with one node-ID, show
in a frame that comes twice with other content. Nobody can tell then whose the rest is: such a scan is thrown
away whole. So is a scan with frames missing whose chunks lie more than two periods apart: it began with one
that had the counter of a scan to come, and that scan's own chunk of that place comes after the timeout.
Two halves of which no frame overlaps cannot be told from one scan.

**Order of counters.** Up to half the counter range ahead is newer, the rest is late and dropped. After a
timeout without an accepted frame whatever comes is believed to be a new stream: a node or the SYNC producer
was restarted.

**Chunks that were not sent.** Where the summary says that only changed chunks were sent, the others keep
their last codes, unless a scan in between was lost, torn or overrun, or a silence was so long that one may
have been: it may have changed them unseen, so they are not valid until they are sent again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.errors import CodecError, ConfigError
from skinnode.wire.codec import (
    MISSING,
    PDO_BYTES,
    Codes,
    Summary,
    SummaryFlag,
    chunk_indexer,
    chunk_of_code,
    unpack_scan,
    unpack_summary,
)
from skinnode.wire.indices import chunk_cob_id, summary_cob_id
from skinnode.wire.profile import DEFAULT_PERIOD_MS, PatchProfile

_CHUNK_INDICES: Final = 256
_NOT_EXPECTED: Final = b""
"""Stands at the chunk numbers a patch does not have, so that the hot path needs no bounds check."""
_NONE_OPEN: Final = -1  # no counter on the wire is negative
_NEVER: Final = -1


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan of a patch. Times are of the receiving host's monotonic clock."""

    codes: Codes
    """(U, K) codes; :data:`~skinnode.wire.codec.MISSING` where none is known."""
    valid: NDArray[np.bool_]
    """(U, K) True where the code is known and a measurement."""
    counter: int
    """Scan counter as on the wire."""
    scan: int
    """The counter unwrapped: it starts at the first counter seen and only grows."""
    complete: bool
    """All chunks the node sent in this scan arrived, and it sent all it had to."""
    chunks_expected: int
    """As the summary says; without a summary, those of a full scan."""
    chunks_received: int
    device_time_us: int | None
    """Clock of the node at the scan; None where the summary was lost."""
    flags: int
    """As in the summary (:class:`~skinnode.wire.codec.SummaryFlag`); 0 where it was lost."""
    t_first_ns: int
    t_last_ns: int


@dataclass(frozen=True, slots=True)
class AssemblerStats:
    """Counters since construction. Each frame given is counted once, in one of the fields marked *."""

    scans_complete: int
    scans_torn: int
    """Published with chunks missing."""
    scans_missed: int
    """Numbers between two scans of which no frame was seen."""
    scans_discarded: int
    """Open at a reset, never published."""
    scans_mixed: int
    """Thrown away, because frames of two scans had their counter, by all that can be seen."""
    scans_joined: int
    """Under way when the stream was taken up, so only partly heard, and never published."""
    chunks_accepted: int
    """*"""
    summaries_accepted: int
    """*"""
    chunks_lost: int
    """Not there when their scan was published. Not counted: chunks of missed scans, and of scans without a
    summary while only changed chunks are sent."""
    summaries_lost: int
    """Not there when their scan was published."""
    duplicates: int
    """* Same scan, same index, same content."""
    conflicts: int
    """* Open scan, same index, other content: the scan is thrown away."""
    late: int
    """* Of a scan that was published without it, or older."""
    bad_length: int
    """* Not the length of a chunk, or of a summary."""
    bad_index: int
    """* A chunk, or a number of chunks, that the patch does not have."""
    bad_counter: int
    """* A scan counter out of the range of the SYNC counter."""
    resyncs: int
    """Times the stream was taken up anew after a silence, with a counter that does not follow."""


class ScanAssembler:
    """Frames of one patch in, scans out. Every method returns at most one scan, in ascending order.

    Call :meth:`poll` after each batch of frames and at :meth:`next_deadline_ns`: it hands out scans whose
    missing frames are not waited for any longer, and a scan that ended in the same call as the one before it.

    Args:
        profile: sizes of the patch.
        counter_overflow: as in 0x1019: scan counters run from 1 to this number, with the SYNC; 0 where they
            run freely from 0 to 255.
        period_ns: time between two scans; sets the timeout.
        grace_ns: how long frames may be late on a scan whose summary, or all chunks, are there.
        node_id: named in the errors given to ``on_reject``.
        on_reject: called with each CodecError of a frame of the wrong length.
        under_way: the node may be sending already; see :meth:`reset`.

    Raises ConfigError for a counter overflow that is not 0 or 2 to 240, or times that are not positive.
    """

    def __init__(
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
        self._steps = (1 << profile.code_bits) - 4
        self._lowest, self._range = (1, counter_overflow) if counter_overflow else (0, 256)
        periods = min(3, max(1, (self._range - 1) // 2))
        self._timeout_ns = period_ns * periods
        self._longest_ns = period_ns * (2 if periods == 3 else periods)
        self._grace_ns = grace_ns
        self._node_id = node_id
        self._on_reject = on_reject

        # the open scan, or the last one while none is open
        self._counter = _NONE_OPEN
        self._last_counter = _NEVER
        self._scan = _NEVER
        self._frames: list[bytes | None] = self._no_frames()
        self._mixed = False
        self._may_join, self._joined_late = under_way, False
        self._received = 0
        self._sent = _NEVER
        self._summary: Summary | None = None
        self._expires_ns = self._t_first_ns = self._t_last_ns = 0
        self._t_chunk_ns = self._t_summary_ns = 0  # of the frame before the summary, and of the summary

        # what is known about every chunk after the last scan, and whether the open scan follows it
        self._held: list[bytes | None] = [None] * self._n
        self._follows = False
        self._changed_only = False

        self._complete = self._torn = self._missed = self._discarded = self._thrown = self._resyncs = 0
        self._joined = 0
        self._chunks = self._summaries = self._chunks_lost = self._summaries_lost = 0
        self._duplicates = self._conflicts = self._late = 0
        self._bad_length = self._bad_index = self._bad_counter = 0

    # --- frames in

    def on_chunk(self, data: bytes, t_ns: int) -> Scan | None:
        """Take the payload of a TPDO1 received at ``t_ns``. It is kept, not copied: do not change it."""
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
        """Take the payload of a TPDO2 received at ``t_ns``."""
        if len(data) != PDO_BYTES:
            self._reject_length(summary_cob_id(self._node_id), data, PDO_BYTES, "scan summary")
            return None
        summary = unpack_summary(data)
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
        self._summary = summary
        self._sent = summary.chunks
        self._t_chunk_ns, self._t_summary_ns, self._t_last_ns = self._t_last_ns, t_ns, t_ns
        if closed is None and self._received >= self._sent:
            return self._close()
        return closed

    def poll(self, t_ns: int) -> Scan | None:
        """The open scan, if at ``t_ns`` nothing more is waited for."""
        deadline = self.next_deadline_ns()
        return self._close() if deadline is not None and t_ns >= deadline else None

    def next_deadline_ns(self) -> int | None:
        """When :meth:`poll` will have a scan if no frame comes before; None while no scan is open."""
        if self._counter == _NONE_OPEN:
            return None
        if self._received >= self._sent != _NEVER:
            return self._t_last_ns
        if self._sent != _NEVER or self._received == self._n:
            return min(self._t_last_ns + self._grace_ns, self._expires_ns)
        return self._expires_ns

    def reset(self, *, under_way: bool = False) -> None:
        """Forget the open scan, the last codes and the counter, as after a boot-up. The statistics stay.
        ``under_way``: the node may be sending already, so that a first scan which is not heard from its first
        chunk on lacks nothing that was lost."""
        if self._counter != _NONE_OPEN:
            self._discarded += 1
            self._book()
        self._counter, self._last_counter = _NONE_OPEN, _NEVER
        self._changed_only = False
        self._may_join = under_way

    @property
    def stats(self) -> AssemblerStats:
        """A snapshot of the counters."""
        is_open = self._counter != _NONE_OPEN
        return AssemblerStats(
            scans_complete=self._complete,
            scans_torn=self._torn,
            scans_missed=self._missed,
            scans_discarded=self._discarded,
            scans_mixed=self._thrown,
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
            resyncs=self._resyncs,
        )

    # --- frames that are not simply the next of the open scan

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
        if self._on_reject is not None:
            self._on_reject(CodecError(cob_id, data, f"{length} bytes ({what})"))

    def _is_news(self, counter: int, t_ns: int, *, known: bool) -> bool:
        """Whether a frame with this counter, not one of the open scan, begins a new scan; if not, count it.

        ``known``: the last scan has this very frame already.
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

    # --- the life of a scan

    def _no_frames(self) -> list[bytes | None]:
        return [None] * self._n + [_NOT_EXPECTED] * max(1, _CHUNK_INDICES - self._n)

    def _open(self, counter: int, t_ns: int, *, from_its_begin: bool) -> None:
        self._follows = False
        self._joined_late, self._may_join = self._may_join and not from_its_begin, False
        if self._last_counter == _NEVER:  # the first at all, or after a reset
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
        """Scans from ``last`` to the next with this counter, 1 … range."""
        return (counter - last) % self._range or self._range

    def _book(self) -> None:
        """Enter the frames of the open scan into the counters."""
        self._chunks += self._received
        self._summaries += self._summary is not None

    def _close(self) -> Scan | None:
        """Publish the open scan, or throw it away."""
        self._book()
        self._counter = _NONE_OPEN
        summary = self._summary
        whole = summary is not None and self._received >= summary.chunks
        summary_is_last = summary is not None and self._t_last_ns == self._t_summary_ns
        t_chunk_ns = self._t_chunk_ns if summary_is_last else self._t_last_ns
        if self._mixed or (not whole and t_chunk_ns - self._t_first_ns > self._longest_ns):
            self._thrown += 1
            self._held = [None] * self._n
            return None
        expected, complete = self._n, self._received == self._n
        if summary is not None:
            flags = summary.flags  # mostly 0; to look for a flag in it takes as long as a chunk does
            self._changed_only = flags != 0 and bool(flags & SummaryFlag.CHANGED_ONLY)
            overrun = flags != 0 and bool(flags & SummaryFlag.OVERRUN)
            expected = summary.chunks
            complete |= self._received == expected and self._changed_only and not overrun
        if self._joined_late and not complete:
            self._joined += 1
            self._held = [None] * self._n
            return None
        self._summaries_lost += summary is None
        if summary is not None or not self._changed_only:
            self._chunks_lost += max(0, expected - self._received)
        self._complete += complete
        self._torn += not complete

        self._hold(carry=complete and self._follows)
        codes, valid = self._decode()
        return Scan(
            codes=codes,
            valid=valid,
            counter=self._last_counter,
            scan=self._scan,
            complete=complete,
            chunks_expected=expected,
            chunks_received=self._received,
            device_time_us=None if summary is None else summary.device_time_us,
            flags=0 if summary is None else summary.flags,
            t_first_ns=self._t_first_ns,
            t_last_ns=self._t_last_ns,
        )

    def _hold(self, *, carry: bool) -> None:
        """Bring what is known about the chunks up to the scan that ends; ``carry``: it changed no other."""
        frames = self._frames[: self._n]
        if carry and self._received < self._n:
            frames = [old if new is None else new for new, old in zip(frames, self._held, strict=True)]
        self._held = frames

    def _decode(self) -> tuple[Codes, NDArray[np.bool_]]:
        known = [frame for frame in self._held if frame is not None]
        blank = bytes(self._chunk_bytes)
        whole = len(known) == self._n
        payload = b"".join(known if whole else [frame or blank for frame in self._held])
        codes = unpack_scan(payload, self._profile)
        if not whole:
            unknown = np.array([frame is None for frame in self._held])
            codes[unknown[chunk_of_code(self._profile)]] = MISSING
        valid = codes <= self._steps
        codes.setflags(write=False)
        valid.setflags(write=False)
        return codes, valid
