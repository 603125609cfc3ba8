"""Scan as received by the host, and the counters of a scan stream."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.codes import Codes
from skinnode.protocol.summary import conversion_phase


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Scan of a patch. Times are in ns on the receiving host's monotonic clock."""

    codes: Codes
    """(U, K) codes; :data:`~skinnode.protocol.codes.MISSING` where the code is unknown."""
    valid: NDArray[np.bool_]
    """(U, K) mask, True where the code is known and is a measurement."""
    counter: int
    """Scan counter as sent."""
    scan: int
    """Unwrapped scan counter, which starts at the first counter received and only increases."""
    complete: bool
    """Whether the codes equal the codes that the node packed: the node sent all required chunks, all of them
    arrived and, in a checked stream, the check passed."""
    chunks_expected: int
    """Number of chunks that the summary announces; without a summary, the number in a full scan."""
    chunks_received: int
    """Number of chunks that arrived."""
    device_time_us: int | None
    """Device time of the scan, µs, which wraps at 2³²; None if the summary was lost.

    A checked summary carries this time in steps of 64 µs, and the host derives the upper 10 bits, initially
    from its own clock."""
    flags: int
    """Summary flags (:class:`~skinnode.protocol.summary.SummaryFlag`); 0 if the summary was lost."""
    t_first_ns: int
    """Time at which the first frame was received."""
    t_last_ns: int
    """Time at which the last frame was received."""

    @property
    def phase(self) -> int:
        """Conversion phase, 1 to 3; 0 if the patch does not supply it or the summary was lost."""
        return conversion_phase(self.flags)

    @property
    def empty(self) -> bool:
        """Whether the node sent chunks but none arrived."""
        return self.chunks_received == 0 < self.chunks_expected


@dataclass(frozen=True, slots=True)
class AssemblerStats:
    """Assembler counters since construction. Each frame is counted in exactly one field marked with *."""

    scans_complete: int
    """Scans published as complete."""
    scans_torn: int
    """Scans published with chunks missing."""
    scans_unchecked: int
    """Scans of a checked stream that contain all sent chunks but were not published as complete, because the
    summary was lost or the codes of chunks that were not sent again are unknown."""
    scans_missed: int
    """Scans of which no frame was received, counted from gaps in the counters."""
    scans_discarded: int
    """Scans that were open at a reset and never published."""
    scans_mixed: int
    """Scans discarded because frames of two scans seem to share a counter."""
    scans_corrupt: int
    """Scans discarded because their check failed, so the codes differ from the codes that the node packed."""
    scans_joined: int
    """Scans that were in progress when reception began, and were thus received in part and never
    published."""
    chunks_accepted: int
    """* Chunks assigned to a scan."""
    summaries_accepted: int
    """* Summaries assigned to a scan."""
    chunks_lost: int
    """Chunks missing when their scan was published. The chunks of missed scans are not counted. Nor, while
    only changed chunks are sent, are the chunks of scans without a summary."""
    summaries_lost: int
    """Summaries missing when their scan was published."""
    duplicates: int
    """* Frames with the same scan counter, index and content as an earlier frame."""
    conflicts: int
    """* Frames of the open scan that repeat an index with different content; the scan is discarded."""
    late: int
    """* Frames that belong to a scan already published without them, or to an older scan."""
    bad_length: int
    """* Frames whose length is not valid for a chunk or summary."""
    bad_index: int
    """* Frames with a chunk index or number of chunks that the patch does not have."""
    bad_counter: int
    """* Frames with a scan counter outside the range of the SYNC counter."""
    bad_form: int
    """* Summaries without a check in a checked stream."""
    resyncs: int
    """Number of times that the counter was out of sequence when the stream resumed after a silence."""
