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
Two halves without overlapping frames can be distinguished from one scan only by the check.

**The check.** A summary with :attr:`~skinnode.protocol.codec.SummaryFlag.CHECKED` carries a CRC over all
codes that the receiver must hold (:func:`~skinnode.protocol.codec.scan_check`). If it fails, the wrong
chunk cannot be identified: the whole scan is discarded, with the codes held for chunks that are not sent. A
stream is *checked* from the first check that passes, or if its owner knows that the node sends checks
(:meth:`ScanAssembler.reset`). In a checked stream no scan is complete without its check: a scan whose
summary was lost, or that lacks codes of chunks not sent again, is published as *unchecked*, and a summary
without a check is rejected. Patches of revision 1.0 send no checks; their scans are complete when all
chunks have been received.

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

from skinnode.canopen.indices import chunk_cob_id, summary_cob_id
from skinnode.errors import CodecError, ConfigError
from skinnode.protocol.codec import (
    MISSING,
    PDO_BYTES,
    TIME_WRAP_US,
    Codes,
    Summary,
    SummaryFlag,
    chunk_indexer,
    chunk_of_code,
    restore_time_us,
    scan_check,
    unpack_scan,
    unpack_scan_with_check,
    unpack_summary,
)
from skinnode.protocol.profile import DEFAULT_PERIOD_MS, PatchProfile
from skinnode.text.words import counted

_CHUNK_INDICES: Final = 256
_NOT_EXPECTED: Final = b""
"""Stands at the chunk numbers a patch does not have, so that the hot path needs no bounds check."""
_NONE_OPEN: Final = -1  # no counter on the wire is negative
_NEVER: Final = -1
_HEAD_BYTES: Final = 6
"""Number of bytes of a summary that its check covers."""
# Testing a flag in a flag takes as long as a whole chunk; testing an int in an int, a tenth of that.
_CHANGED_ONLY, _OVERRUN = int(SummaryFlag.CHANGED_ONLY), int(SummaryFlag.OVERRUN)
_BASELINE_CHANGED: Final = int(SummaryFlag.BASELINE_CHANGED)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan of a patch. Times are of the receiving host's monotonic clock."""

    codes: Codes
    """(U, K) codes; :data:`~skinnode.protocol.codec.MISSING` where none is known."""
    valid: NDArray[np.bool_]
    """(U, K) True where the code is known and a measurement."""
    counter: int
    """Scan counter as on the wire."""
    scan: int
    """The counter unwrapped: it starts at the first counter seen and only grows."""
    complete: bool
    """All chunks the node sent in this scan arrived, it sent all it had to and, in a checked stream, the
    check passed: the codes are those that the node packed."""
    chunks_expected: int
    """As the summary says; without a summary, those of a full scan."""
    chunks_received: int
    device_time_us: int | None
    """Clock of the node at the scan, µs, 0 to 2³² − 1, wraps; None if the summary was lost. From a checked
    summary it is in steps of 64 µs, and the host derives the upper 10 bits, at first from its own clock."""
    flags: int
    """As in the summary (:class:`~skinnode.protocol.codec.SummaryFlag`); 0 where it was lost."""
    t_first_ns: int
    t_last_ns: int

    @property
    def empty(self) -> bool:
        """Whether none of the chunks that the node sent arrived."""
        return self.chunks_received == 0 < self.chunks_expected


@dataclass(frozen=True, slots=True)
class AssemblerStats:
    """Counters since construction. Each frame given is counted once, in one of the fields marked *."""

    scans_complete: int
    scans_torn: int
    """Published with chunks missing."""
    scans_unchecked: int
    """Scans published with all chunks that were sent, but not complete: in a checked stream, the summary was
    lost, or codes of chunks not sent again are unknown."""
    scans_missed: int
    """Numbers between two scans of which no frame was seen."""
    scans_discarded: int
    """Open at a reset, never published."""
    scans_mixed: int
    """Thrown away, because frames of two scans had their counter, by all that can be seen."""
    scans_corrupt: int
    """Scans discarded because their check failed: codes differ from those that the node packed."""
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
    bad_form: int
    """* Summaries without a check, in a checked stream."""
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
        on_reject: called with each CodecError of a frame of the wrong length or form.
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
        self.on_thrown: Callable[[], None] | None = None
        """Called when a scan is discarded that may have been the first of a new baseline."""

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
        self._head = b""  # bytes of that summary that its check covers
        self._checked = False
        self._time_us = self._t_time_ns = 0  # the newest device time, not wrapped, and when it came; 0: none
        self._expires_ns = self._t_first_ns = self._t_last_ns = 0
        self._t_chunk_ns = self._t_summary_ns = 0  # of the frame before the summary, and of the summary

        # what is known about every chunk after the last scan, and whether the open scan follows it
        self._held: list[bytes | None] = [None] * self._n
        self._follows = False
        self._changed_only = False

        self._complete = self._torn = self._missed = self._discarded = self._thrown = self._resyncs = 0
        self._joined = self._unchecked = self._corrupt = 0
        self._chunks = self._summaries = self._chunks_lost = self._summaries_lost = 0
        self._duplicates = self._conflicts = self._late = 0
        self._bad_length = self._bad_index = self._bad_counter = self._bad_form = 0

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
        self._summary, self._head = summary, data[:_HEAD_BYTES]
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

    def reset(self, *, under_way: bool = False, checked: bool = False) -> None:
        """Forget the open scan, the last codes and the counter, as after a boot-up. The statistics stay.
        ``under_way``: the node may be sending already, so that a first scan which is not heard from its first
        chunk on lacks nothing that was lost. ``checked``: the node is known to send a check with every
        summary; otherwise that is learned from the first check that passes."""
        if self._counter != _NONE_OPEN:
            self._discarded += 1
            self._book()
        self._counter, self._last_counter = _NONE_OPEN, _NEVER
        self._changed_only = False
        self._may_join = under_way
        self._checked = checked
        self._time_us = self._t_time_ns = 0

    def expect_check(self) -> None:
        """Require a check with every summary from now on."""
        self._checked = True

    @property
    def stats(self) -> AssemblerStats:
        """A snapshot of the counters."""
        is_open = self._counter != _NONE_OPEN
        return AssemblerStats(
            scans_complete=self._complete,
            scans_torn=self._torn,
            scans_unchecked=self._unchecked,
            scans_missed=self._missed,
            scans_discarded=self._discarded,
            scans_mixed=self._thrown,
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
        self._reject(cob_id, data, f"{counted(length, 'byte')} ({what})")

    def _reject(self, cob_id: int, data: bytes, allowed: str) -> None:
        if self._on_reject is not None:
            self._on_reject(CodecError(cob_id, data, allowed))

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
            self._throw_away()
            return None
        expected, arrived, checked = self._n, self._received == self._n, self._checked
        device_time_us, flags = None, 0
        if summary is not None:
            expected, flags, checked = summary.chunks, summary.flags, summary.check is not None
            if not arrived:
                arrived = self._received == expected and flags & (_CHANGED_ONLY | _OVERRUN) == _CHANGED_ONLY
        if self._joined_late and not arrived:
            self._joined += 1
            self._throw_away(doubt=summary is None or flags & _BASELINE_CHANGED != 0)
            return None
        self._hold(carry=arrived and self._follows)
        codes, valid, check = self._decode()
        verified = False
        if arrived and summary is not None and summary.check is not None and check is not None:
            verified = scan_check(check, self._head) == summary.check
            if not verified:
                self._corrupt += 1
                self._throw_away()
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

    def _throw_away(self, *, doubt: bool = True) -> None:
        """Discard a scan and let no later scan inherit codes. ``doubt``: the scan may have been the first of
        a new baseline."""
        self._held = [None] * self._n
        if doubt and self.on_thrown is not None:
            self.on_thrown()

    def _device_time_us(self, summary: Summary) -> int:
        """Return the 32 bits of a device time of which a checked summary carries 16: the value nearest to the
        last device time plus the time elapsed on the host's clock. The upper bits of the first are taken from
        the host's clock, up to three seconds after the scan."""
        if summary.check is None:
            return summary.device_time_us
        expected_us = self._time_us + (self._t_summary_ns - self._t_time_ns) // 1000
        if not self._t_time_ns:
            expected_us -= TIME_WRAP_US // 4
        self._time_us = restore_time_us(summary.device_time_us, expected_us)
        self._t_time_ns = self._t_summary_ns
        return self._time_us & 0xFFFF_FFFF

    def _hold(self, *, carry: bool) -> None:
        """Bring what is known about the chunks up to the scan that ends; ``carry``: it changed no other."""
        frames = self._frames[: self._n]
        if carry and self._received < self._n:
            frames = [old if new is None else new for new, old in zip(frames, self._held, strict=True)]
        self._held = frames

    def _decode(self) -> tuple[Codes, NDArray[np.bool_], int | None]:
        """Return the codes, a mask of those that are measurements, and the check over the codes; the check is
        None if not all codes are known."""
        known = [frame for frame in self._held if frame is not None]
        blank = bytes(self._chunk_bytes)
        check: int | None = None
        if len(known) == self._n:
            codes, check = unpack_scan_with_check(b"".join(known), self._profile)
        else:
            codes = unpack_scan(b"".join([frame or blank for frame in self._held]), self._profile)
            unknown = np.array([frame is None for frame in self._held])
            codes[unknown[chunk_of_code(self._profile)]] = MISSING
        valid = codes <= self._steps
        codes.setflags(write=False)
        valid.setflags(write=False)
        return codes, valid, check
