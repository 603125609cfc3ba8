"""Classes for a received scan and for the counters of a scan assembler."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.codes import Codes
from skinnode.protocol.summary import conversion_phase


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Scan of a patch, as received by a host. Times are in ns on the host's monotonic clock."""

    codes: Codes
    """(U, K) codes; :data:`~skinnode.protocol.codes.MISSING` where the code is unknown."""
    valid: NDArray[np.bool_]
    """(U, K) mask of the known codes that are measurements (reserved codes are excluded)."""
    counter: int
    """Scan counter as sent on the bus."""
    scan: int
    """Unwrapped scan counter, which starts at the first scan counter received and never decreases."""
    complete: bool
    """Whether the received codes are known to equal the codes packed by the node. A scan is complete if the
    node sent all required chunks and all of these chunks arrived. In a checked stream, the check must also
    have passed."""
    chunks_expected: int
    """Number of chunks sent, according to the summary; if the summary was lost, the number of chunks in a
    full scan."""
    chunks_received: int
    """Number of chunks received for this scan."""
    device_time_us: int | None
    """Time of the scan on the node's clock in µs, modulo 2³²; None if the summary was lost.

    A checked summary carries the device time in steps of 64 µs and without the upper 10 bits, which the host
    restores (:mod:`skinnode.protocol.device_time`)."""
    flags: int
    """Summary flags (:class:`~skinnode.protocol.summary.SummaryFlag`); 0 if the summary was lost."""
    t_first_ns: int
    """Time at which the first frame of the scan was received, ns."""
    t_last_ns: int
    """Time at which the last frame of the scan was received, ns."""

    @property
    def phase(self) -> int:
        """Conversion phase, 1 to 3; 0 if the patch does not supply a phase or the summary was lost."""
        return conversion_phase(self.flags)

    @property
    def empty(self) -> bool:
        """Whether the node sent chunks of this scan, but none of these chunks arrived."""
        return self.chunks_received == 0 < self.chunks_expected


@dataclass(frozen=True, slots=True)
class AssemblerStats:
    """Counters of a scan assembler. Each frame is counted in exactly one of the fields marked with *."""

    scans_complete: int
    """Scans published as complete."""
    scans_torn: int
    """Scans published with chunks missing."""
    scans_unchecked: int
    """Scans of a checked stream that were published as incomplete although all their chunks arrived. Either
    the summary was lost, or the codes of unsent chunks were unknown."""
    scans_missed: int
    """Scans of which no frame was received, counted from gaps in the scan counter."""
    scans_discarded: int
    """Scans discarded by a reset before publication."""
    scans_mixed: int
    """Scans discarded because they appear to contain frames of two scans with the same counter."""
    scans_corrupt: int
    """Scans discarded because of a failed check: the received codes differ from the codes packed by the
    node."""
    scans_joined: int
    """Scans not published because reception began after their first chunks had been sent."""
    chunks_accepted: int
    """* Chunks assigned to a scan."""
    summaries_accepted: int
    """* Summaries assigned to a scan."""
    chunks_lost: int
    """Chunks missing when their scan was published, not including the chunks of missed scans. If only changed
    chunks are sent, chunks of scans without a summary are also excluded."""
    summaries_lost: int
    """Summaries missing when their scan was published."""
    duplicates: int
    """* Frames identical to an earlier frame of the same scan."""
    conflicts: int
    """* Frames with the same index as an earlier frame of the same scan, but different content; the scan is
    discarded."""
    late: int
    """* Frames that arrived after their scan had been closed, or after a newer scan had started."""
    bad_length: int
    """* Frames with the wrong length for a chunk or a summary."""
    bad_index: int
    """* Chunks with an index beyond the patch's last chunk, and summaries that announce more chunks than
    the patch has."""
    bad_counter: int
    """* Frames whose scan counter is outside the range of the SYNC counter."""
    bad_form: int
    """* Summaries without a check in a checked stream."""
    resyncs: int
    """Number of pauses in a stream after which the scan counter resumed out of sequence."""
