"""Classes for a scan that a host has received, and for the counters of a scan assembler."""

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
    """(U, K) mask: True where the code is known and is a measurement, not a reserved code."""
    counter: int
    """Scan counter as sent on the bus."""
    scan: int
    """Unwrapped scan counter, which starts at the first scan counter received and never decreases."""
    complete: bool
    """Whether the codes are certain to equal the codes that the node packed. A scan is complete if the node
    sent all required chunks, if all of them arrived and, in a checked stream, if the check passed."""
    chunks_expected: int
    """Number of chunks sent, according to the summary; without a summary, the number of chunks in a full
    scan."""
    chunks_received: int
    """Number of chunks received for this scan."""
    device_time_us: int | None
    """Time of the scan on the node's clock, µs, which wraps at 2³²; None if the summary was lost.

    A checked summary carries this time in steps of 64 µs and without the upper 10 bits, which the host
    restores (:mod:`skinnode.protocol.device_time`)."""
    flags: int
    """Summary flags (:class:`~skinnode.protocol.summary.SummaryFlag`); 0 if the summary was lost."""
    t_first_ns: int
    """Time at which the first frame of the scan was received, ns."""
    t_last_ns: int
    """Time at which the last frame of the scan was received, ns."""

    @property
    def phase(self) -> int:
        """Conversion phase, 1 to 3; 0 if the patch does not supply it or the summary was lost."""
        return conversion_phase(self.flags)

    @property
    def empty(self) -> bool:
        """Whether the node sent chunks of this scan but none of them arrived."""
        return self.chunks_received == 0 < self.chunks_expected


@dataclass(frozen=True, slots=True)
class AssemblerStats:
    """Counters of a scan assembler. Each frame counts in exactly one of the fields marked *."""

    scans_complete: int
    """Scans published as complete."""
    scans_torn: int
    """Scans published with chunks missing."""
    scans_unchecked: int
    """Scans of a checked stream that were published with all their chunks, but not as complete. Either the
    summary was lost, or some codes of chunks that were not sent are unknown."""
    scans_missed: int
    """Scans of which no frame was received; their number follows from gaps in the scan counter."""
    scans_discarded: int
    """Scans that a reset discarded before they were published."""
    scans_mixed: int
    """Scans discarded because they seem to contain frames of two scans with the same counter."""
    scans_corrupt: int
    """Scans discarded because their check failed: the codes received differ from the codes that the node
    packed."""
    scans_joined: int
    """Scans that were already being sent when reception began; such a scan is incomplete and is not
    published."""
    chunks_accepted: int
    """* Chunks assigned to a scan."""
    summaries_accepted: int
    """* Summaries assigned to a scan."""
    chunks_lost: int
    """Chunks missing when their scan was published. Chunks of missed scans are not counted. While only
    changed chunks are sent, chunks of scans without a summary are not counted either."""
    summaries_lost: int
    """Summaries missing when their scan was published."""
    duplicates: int
    """* Frames that repeat an earlier frame of the same scan with the same content."""
    conflicts: int
    """* Frames that repeat an earlier frame of the same scan with different content; the scan is
    discarded."""
    late: int
    """* Frames that arrived after their scan had been closed, or after a newer scan had started."""
    bad_length: int
    """* Frames with the wrong length for a chunk or a summary."""
    bad_index: int
    """* Chunks with an index that the patch does not have, and summaries with too large a number of
    chunks."""
    bad_counter: int
    """* Frames whose scan counter is outside the range of the SYNC counter."""
    bad_form: int
    """* Summaries in a checked stream that lack a check."""
    resyncs: int
    """Number of times that the scan counter was out of sequence when a stream resumed after a silence."""
