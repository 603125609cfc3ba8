"""Selects the chunks to send in send mode 1 (0x2020:1), in which only changed chunks are sent."""

from __future__ import annotations

import numpy as np

from skinnode.protocol.chunk import chunk_of_code
from skinnode.protocol.codes import Codes, CodeScale
from skinnode.protocol.profile import PatchProfile


class ChunkSelection:
    """Selects the chunks whose codes have changed since they were last sent.

    Args:
        profile: Dimensions of the patch.
        scale: Mapping of R/R0 to codes.
    """

    def __init__(self, profile: PatchProfile, scale: CodeScale) -> None:
        self._steps, self._n_chunks = scale.steps, profile.n_chunks
        self._places = chunk_of_code(profile)
        self._since_full = 0  # number of scans since the last full scan
        self._full_scan_due = True
        self.sent: Codes = np.full((profile.rows, profile.columns), scale.open, dtype=np.uint32)
        """(U, K) codes that were last sent; before the first scan, all crossings are coded as open."""
        self._largest_sent: int = scale.open

    def forget(self) -> None:
        """Make the next scan a full scan because the receiver may not have the codes that were last sent."""
        self._full_scan_due = True

    def changed_chunks(self, codes: Codes, threshold: int, full_every: int) -> list[int] | None:
        """Select the chunks to send and record their codes as sent.

        A chunk is selected if one of its codes differs from the last code sent by more than the threshold, or
        if it differs at all and either code is reserved.

        Args:
            codes: (U, K) codes of the scan.
            threshold: Largest code change that is not sent.
            full_every: Interval between full scans, in scans; 0 for no regular full scans.

        Returns:
            Numbers of the chunks in ascending order, or None if a full scan is due.
        """
        self._since_full += 1
        if self._full_scan_due or (full_every and self._since_full >= full_every):
            self._full_scan_due, self._since_full = False, 0
            self._remember(codes)
            return None
        apart = np.abs(np.subtract(codes, self.sent, dtype=np.int64))
        largest = int(np.maximum.reduce(apart, axis=None))
        if largest <= threshold and self._largest_sent + largest <= self._steps:
            return []  # the usual case while the skin is at rest
        moved = apart > threshold
        moved |= ((codes > self._steps) | (self.sent > self._steps)) & (codes != self.sent)
        chunks = np.zeros(self._n_chunks, dtype=np.bool_)
        chunks[self._places[moved]] = True
        self._remember(np.where(chunks[self._places], codes, self.sent))
        return [int(index) for index in np.flatnonzero(chunks)]

    def _remember(self, sent: Codes) -> None:
        self.sent, self._largest_sent = sent, int(sent.max())
