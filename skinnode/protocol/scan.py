"""Received scans, and the counters of a scan assembler."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.codes import Codes
from skinnode.protocol.summary import conversion_phase


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Scan of a patch, as received by a host. Arrival times are on the host's monotonic clock."""

    codes: Codes
    """(U, K) codes; :data:`~skinnode.protocol.codes.MISSING` where the code is unknown."""
    valid: NDArray[np.bool_]
    """(U, K) mask of the measurements; False for reserved and unknown codes."""
    counter: int
    """Scan counter, as sent on the bus."""
    scan: int
    """Scan counter without wrap-around. It starts at the first counter value received and keeps
    increasing."""
    complete: bool
    """Whether the codes are known to match the codes that the node packed: all chunks arrived or are known to
    be unchanged, and, in a checked stream, the check passed."""
    chunks_expected: int
    """Number of chunks sent, according to the summary; the number of chunks in a full scan if the summary was
    lost."""
    chunks_received: int
    """Number of chunks received."""
    device_time_us: int | None
    """Time of the scan on the node's clock in µs, modulo 2³²; None if the summary was lost.

    A summary with a check carries the device time in steps of 64 µs, without its upper 10 bits, which the
    host restores (:mod:`skinnode.protocol.device_time`)."""
    flags: int
    """Summary flags (:class:`~skinnode.protocol.summary.SummaryFlag`); 0 if the summary was lost."""
    t_first_ns: int
    """Arrival time (ns) of the first frame of the scan."""
    t_last_ns: int
    """Arrival time (ns) of the last frame of the scan."""

    @property
    def phase(self) -> int:
        """Conversion phase, 1 to 3; 0 if the summary was lost or the patch does not count its conversions."""
        return conversion_phase(self.flags)

    @property
    def empty(self) -> bool:
        """Whether the node sent chunks but all of them were lost."""
        return self.chunks_received == 0 < self.chunks_expected


@dataclass(frozen=True, slots=True)
class AssemblerStats:
    """Counters of a scan assembler. Every frame is counted in exactly one of the fields marked with *."""

    scans_complete: int
    """Scans published as complete."""
    scans_torn: int
    """Scans published with missing chunks."""
    scans_unchecked: int
    """Scans published as incomplete although all their chunks arrived, because the check was impossible: the
    summary was lost or the codes of unsent chunks were unknown."""
    scans_missed: int
    """Scans from which no frame arrived, inferred from gaps in the scan counter."""
    scans_discarded: int
    """Scans discarded by a reset."""
    scans_mixed: int
    """Scans discarded because they seem to contain frames of two scans with the same counter."""
    scans_corrupt: int
    """Scans discarded because the check failed: at least one code differs from the node's code."""
    scans_joined: int
    """Incomplete scans discarded because reception began after the node had started sending them."""
    chunks_accepted: int
    """* Chunks assigned to a scan."""
    summaries_accepted: int
    """* Summaries assigned to a scan."""
    chunks_lost: int
    """Chunks missing from published scans. If the node sends only changed chunks, chunks of a scan without a
    summary are not counted, because the number sent is unknown."""
    summaries_lost: int
    """Summaries missing from published scans."""
    duplicates: int
    """* Frames identical to an earlier frame of the same scan."""
    conflicts: int
    """* Frames that differ from an earlier frame for the same chunk or summary of a scan. The scan is
    discarded."""
    late: int
    """* Frames that arrived after their scan had been closed or a newer scan had started."""
    bad_length: int
    """* Frames with the wrong length for a chunk or a summary."""
    bad_index: int
    """* Chunks with an invalid chunk index, and summaries that announce too many chunks."""
    bad_counter: int
    """* Frames with a scan counter outside the range of the SYNC counter."""
    bad_form: int
    """* Summaries without a check in a checked stream."""
    resyncs: int
    """Number of times that the scan counter continued out of sequence after a pause."""
