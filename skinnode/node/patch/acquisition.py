"""Acquisition of codes from the analogue port: sampling, tare, and selection of the chunks to send."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float, require_array
from skinnode.node.patch.source import ResistanceSource, conversions_of, read_source
from skinnode.node.patch.wire_faults import WireFaults, find_faults
from skinnode.protocol.chunk import chunk_of_code
from skinnode.protocol.codes import Codes, CodeScale, encode
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.summary import PHASES

TARE_READS: Final = 16
"""Number of readings averaged for a baseline; its noise, a quarter of that of one reading, adds 3 % to the
noise of R/R0."""


class Acquisition:
    """Acquisition stage that reads a source and keeps the last codes and the baseline.

    Args:
        profile: sizes of the patch.
        source: analogue port of the patch.
        scale: the mapping of R/R0 to codes.
        baseline_ohm: (U, K) initial R0, ohm; None if there is no baseline yet.

    Raises:
        ValueError: if the baseline has the wrong shape or a negative value.
    """

    def __init__(
        self, profile: PatchProfile, source: ResistanceSource, scale: CodeScale, baseline_ohm: Float | None
    ) -> None:
        self.profile, self._source, self.scale = profile, source, scale
        shape = profile.rows, profile.columns
        self.tared = baseline_ohm is not None
        """Whether there is a baseline."""
        given = (
            np.zeros(shape) if baseline_ohm is None else require_array("baseline_ohm", baseline_ohm, shape)
        )
        if (given < 0).any():
            raise ValueError(f"baseline_ohm: got {given.min()}, must not be negative")
        self.baseline_ohm: NDArray[np.float32] = given.astype(np.float32)
        """(U, K) R0 as stored in the object dictionary, ohm; 0 where there is no R0."""
        self.codes: Codes = np.full(shape, scale.open, dtype=np.uint32)
        """(U, K) codes of the last scan; all open before the first scan."""
        self.faults = WireFaults.none(profile)
        """Wire faults of the last scan."""
        self.phase = 0
        """Conversion phase of the last scan; 0 if the source does not count its conversions."""
        self._conversions: int | None = None  # of the source, at the last scan
        self._sent: Codes | None = None  # codes last sent, which the host holds; None if unknown
        self._since_full = 0

    def read(self, t_ns: int) -> Float:
        """Return (U, K) resistances at ``t_ns``, ohm.

        Raises:
            SourceFailed: if the source returns no valid reading.
        """
        return read_source(self._source, (self.profile.rows, self.profile.columns), t_ns)

    def sample(self, t_ns: int, readings: int = 1) -> None:
        """Take a scan by encoding the mean of one or more readings.

        Args:
            t_ns: current time, ns.
            readings: number of readings.

        Raises:
            SourceFailed: if the source returns no valid reading.
        """
        resistance = self._total(t_ns, readings)
        conversions = conversions_of(self._source)
        if conversions is None:
            self.phase = 0
        elif conversions != self._conversions:
            self.phase = self.phase % PHASES + 1
        self._conversions = conversions
        self.codes = encode(resistance / readings, self.baseline_ohm, self.scale)
        self.faults = find_faults(self.codes, self.scale)

    def _total(self, t_ns: int, readings: int) -> Float:
        """Return the sum of the readings; NaN, which counts as open, where infinities cancel."""
        total = self.read(t_ns)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(readings - 1):
                total += self.read(t_ns)
        return total

    def tare(self, t_ns: int, readings: int = TARE_READS) -> None:
        """Make the current resistances the baseline. Crossings without a valid resistance keep their R0.

        Args:
            t_ns: current time, ns.
            readings: number of readings averaged.

        Raises:
            SourceFailed: if the source returns no valid reading.
        """
        with np.errstate(
            over="ignore", under="ignore"
        ):  # values that REAL32 cannot hold are not valid resistances
            mean = (self._total(t_ns, readings) / readings).astype(np.float32)
        measured = np.isfinite(mean) & (mean > 0)
        self.baseline_ohm = np.where(measured, mean, self.baseline_ohm)
        self.tared = True
        self.forget_sent()

    def set_baseline(self, row: int, column: int, value_ohm: float) -> None:
        """Set one R0, ohm; the client must then set all others too, as the node no longer tares by itself."""
        self.baseline_ohm[row, column] = value_ohm
        self.tared = True
        self.forget_sent()

    def set_baselines(self, values_ohm: NDArray[np.float32]) -> None:
        """Set the whole baseline, (U, K) ohm."""
        self.baseline_ohm = values_ohm
        self.tared = True
        self.forget_sent()

    @property
    def sent(self) -> Codes:
        """(U, K) codes last sent in each chunk, when :meth:`changed_chunks` selects the chunks."""
        return self.codes if self._sent is None else self._sent

    def forget_sent(self) -> None:
        """Make the next scan a full scan, because the receiver might not hold the codes sent earlier."""
        self._sent = None

    def changed_chunks(self, threshold: int, full_every: int) -> list[int] | None:
        """Return the indices of the chunks to send, and record them as sent.

        A chunk is selected if, since it was last sent, one of its codes has changed by more than the
        threshold, or has changed to or from a reserved code.

        Args:
            threshold: largest code change that does not cause a chunk to be sent.
            full_every: number of scans from one full scan to the next; 0 for no full scans.

        Returns:
            Indices in ascending order; None if a full scan is due.
        """
        self._since_full += 1
        if self._sent is None or (full_every and self._since_full >= full_every):
            self._since_full = 0
            self._sent = self.codes
            return None
        steps = self.scale.steps
        moved = np.abs(self.codes.astype(np.int64) - self._sent) > threshold
        moved |= ((self.codes > steps) | (self._sent > steps)) & (self.codes != self._sent)
        places = chunk_of_code(self.profile)
        chunks = np.zeros(self.profile.n_chunks, dtype=np.bool_)
        chunks[places[moved]] = True
        self._sent = np.where(chunks[places], self.codes, self._sent)
        return [int(index) for index in np.flatnonzero(chunks)]
