"""A scan as the host receives it, and the counters of a stream of scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.codes import Codes


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan of a patch. Times are ns of the receiving host's monotonic clock."""

    codes: Codes
    """(U, K) codes; :data:`~skinnode.protocol.codes.MISSING` where the code is unknown."""
    valid: NDArray[np.bool_]
    """(U, K) mask: True where the code is known and is a measurement."""
    counter: int
    """Scan counter as sent."""
    scan: int
    """Scan counter, unwrapped: starts at the first counter received and only grows."""
    complete: bool
    """Whether the codes are those that the node packed: the node sent all chunks that it had to, all of them
    arrived and, in a checked stream, the check passed."""
    chunks_expected: int
    """Number of chunks that the summary announces; without a summary, that of a full scan."""
    chunks_received: int
    """Number of chunks that arrived."""
    device_time_us: int | None
    """Clock of the node at the scan, µs, 0 to 2³² − 1, wraps; None if the summary was lost.

    A checked summary carries it in steps of 64 µs, and the host derives the upper 10 bits, at first from its
    own clock."""
    flags: int
    """Flags of the summary (:class:`~skinnode.protocol.summary.SummaryFlag`); 0 if it was lost."""
    t_first_ns: int
    """Time at which the first frame was received."""
    t_last_ns: int
    """Time at which the last frame was received."""

    @property
    def empty(self) -> bool:
        """Whether none of the chunks that the node sent arrived."""
        return self.chunks_received == 0 < self.chunks_expected


@dataclass(frozen=True, slots=True)
class AssemblerStats:
    """Counters since construction. Each frame counts once, in one of the fields marked with *."""

    scans_complete: int
    """Scans published as complete."""
    scans_torn: int
    """Scans published with chunks missing."""
    scans_unchecked: int
    """Scans published with all chunks that were sent, but not as complete: in a checked stream the summary
    was lost, or the codes of chunks that were not sent again are unknown."""
    scans_missed: int
    """Scans without a single received frame, counted by the gaps between counters."""
    scans_discarded: int
    """Scans open at a reset, never published."""
    scans_mixed: int
    """Scans discarded because frames of two scans seem to share their counter."""
    scans_corrupt: int
    """Scans discarded because their check failed: codes differ from those that the node packed."""
    scans_joined: int
    """Scans in progress when reception began, so only partly received and never published."""
    chunks_accepted: int
    """* Chunks that a scan took."""
    summaries_accepted: int
    """* Summaries that a scan took."""
    chunks_lost: int
    """Chunks missing when their scan was published. Not counted: chunks of missed scans, and of scans without
    a summary while only changed chunks are sent."""
    summaries_lost: int
    """Summaries missing when their scan was published."""
    duplicates: int
    """* Frames received before: same scan, index and content."""
    conflicts: int
    """* Frames of the open scan that repeat an index with other content: the scan is discarded."""
    late: int
    """* Frames of a scan that was published without them, or of an older one."""
    bad_length: int
    """* Frames with a length that no chunk or summary has."""
    bad_index: int
    """* Frames that name a chunk, or a number of chunks, that the patch does not have."""
    bad_counter: int
    """* Frames with a scan counter outside the range of the SYNC counter."""
    bad_form: int
    """* Summaries without a check in a checked stream."""
    resyncs: int
    """Times that the stream went on, after a silence, with a counter that does not follow."""
