"""Selection of the chunks to send, for the send mode in which only changed chunks are sent (0x2020:1)."""

from __future__ import annotations

import numpy as np

from skinnode.protocol.chunk import chunk_of_code
from skinnode.protocol.codes import Codes, CodeScale
from skinnode.protocol.profile import PatchProfile


class ChunkSelection:
    """Selector of the chunks whose codes have changed since they were last sent.

    Args:
        profile: sizes of the patch.
        scale: mapping of R/R0 to codes.
    """

    def __init__(self, profile: PatchProfile, scale: CodeScale) -> None:
        self._steps, self._n_chunks = scale.steps, profile.n_chunks
        self._places = chunk_of_code(profile)
        self._since_full = 0  # number of scans since the last full scan
        self._full_scan_due = True
        self.sent: Codes = np.full((profile.rows, profile.columns), scale.open, dtype=np.uint32)
        """(U, K) codes that each chunk contained when it was last sent; before the first scan, all codes are
        open."""

    def forget(self) -> None:
        """Make the next scan a full scan, because the receiver may not have the codes sent before."""
        self._full_scan_due = True

    def changed_chunks(self, codes: Codes, threshold: int, full_every: int) -> list[int] | None:
        """Return the indices of the chunks to send, and record them as sent.

        A chunk is selected if, since the chunk was last sent, one of its codes has changed by more than the
        threshold, or to or from a reserved code.

        Args:
            codes: (U, K) codes of the scan.
            threshold: maximum change of a code that does not cause its chunk to be sent.
            full_every: number of scans from one full scan to the next; 0 for no further full scans.

        Returns:
            Indices of the chunks in ascending order; None if a full scan is due.
        """
        self._since_full += 1
        if self._full_scan_due or (full_every and self._since_full >= full_every):
            self._full_scan_due, self._since_full = False, 0
            self.sent = codes
            return None
        moved = np.abs(codes.astype(np.int64) - self.sent) > threshold
        moved |= ((codes > self._steps) | (self.sent > self._steps)) & (codes != self.sent)
        chunks = np.zeros(self._n_chunks, dtype=np.bool_)
        chunks[self._places[moved]] = True
        self.sent = np.where(chunks[self._places], codes, self.sent)
        return [int(index) for index in np.flatnonzero(chunks)]
