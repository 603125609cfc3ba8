"""Reads the resistances of a patch from its analogue front end, encodes them, and measures the baseline."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float, require_array
from skinnode.node.patch.chunk_selection import ChunkSelection
from skinnode.node.patch.source import ResistanceSource, conversions_of, read_source
from skinnode.node.patch.wire_faults import WireFaults, find_faults
from skinnode.protocol.codes import Codes, CodeScale, encode
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.summary import PHASES

TARE_READS: Final = 16
"""Number of readings averaged for a baseline. The noise of the baseline is then a quarter of the noise of a
single reading, and the relative noise of R/R0 is only 3 % higher than the noise of R."""


class Acquisition:
    """Baseline of a patch, and the codes of its last scan.

    Args:
        profile: Dimensions of the patch.
        source: Analogue front end of the patch.
        scale: Mapping of R/R0 to codes.
        baseline_ohm: (U, K) initial R0 in ohms; None if the patch has no baseline yet.

    Raises:
        ValueError: If the baseline has the wrong shape or a negative value.
    """

    def __init__(
        self, profile: PatchProfile, source: ResistanceSource, scale: CodeScale, baseline_ohm: Float | None
    ) -> None:
        self.profile, self._source, self.scale = profile, source, scale
        shape = profile.rows, profile.columns
        self.tared = baseline_ohm is not None
        """Whether the patch has a baseline."""
        given = (
            np.zeros(shape) if baseline_ohm is None else require_array("baseline_ohm", baseline_ohm, shape)
        )
        if (given < 0).any():
            raise ValueError(f"baseline_ohm: got {given.min()}, must not be negative")
        self.baseline_ohm: NDArray[np.float32] = given.astype(np.float32)
        """(U, K) baseline R0 in ohms with REAL32 precision, as in the object dictionary; 0 where unknown."""
        self.codes: Codes = np.full(shape, scale.open, dtype=np.uint32)
        """(U, K) codes of the last scan; before the first scan, all crossings are coded as open."""
        self.faults = WireFaults.none(profile)
        """Wire faults in the last scan."""
        self.phase = 0
        """Conversion phase of the last scan; 0 if the source does not count its conversions."""
        # conversion count of the source at the last scan
        self._conversions: int | None = None
        self.selection = ChunkSelection(profile, scale)
        """Selects the chunks to send in send mode 1 (changed chunks only)."""

    def read(self, t_ns: int) -> Float:
        """Read the source once and return (U, K) resistances in ohms.

        Raises:
            SourceFailed: If the source returns no valid reading.
        """
        return read_source(self._source, (self.profile.rows, self.profile.columns), t_ns)

    def sample(self, t_ns: int, readings: int = 1) -> None:
        """Take a scan: read the source and encode the mean of the readings.

        Args:
            t_ns: Current time, in ns.
            readings: Number of readings.

        Raises:
            SourceFailed: If the source returns no valid reading.
        """
        resistance = self._total(t_ns, readings)
        conversions = conversions_of(self._source)
        if conversions is None:
            self.phase = 0
        elif conversions != self._conversions:
            self.phase = self.phase % PHASES + 1
        self._conversions = conversions
        mean = resistance if readings == 1 else resistance / readings
        self.codes = encode(mean, self.baseline_ohm, self.scale)
        self.faults = find_faults(self.codes, self.scale)

    def _total(self, t_ns: int, readings: int) -> Float:
        """Return the (U, K) sum of several readings in ohms. ∞ − ∞ gives NaN, which is encoded as open."""
        total = self.read(t_ns)
        if readings == 1:
            return total
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(readings - 1):
                total += self.read(t_ns)
        return total

    def tare(self, t_ns: int, readings: int = TARE_READS) -> None:
        """Make the current resistances the baseline.

        Crossings without a valid resistance keep their R0.

        Args:
            t_ns: Current time, in ns.
            readings: Number of readings to average.

        Raises:
            SourceFailed: If the source returns no valid reading.
        """
        with np.errstate(over="ignore", under="ignore"):  # a resistance outside the REAL32 range is invalid
            mean = (self._total(t_ns, readings) / readings).astype(np.float32)
        measured = np.isfinite(mean) & (mean > 0)
        self.baseline_ohm = np.where(measured, mean, self.baseline_ohm)
        self.tared = True
        self.selection.forget()

    def set_baseline(self, row: int, column: int, value_ohm: float) -> None:
        """Set the R0 of one crossing in ohms. From then on, the node tares only on command."""
        self.baseline_ohm[row, column] = value_ohm
        self.tared = True
        self.selection.forget()

    def set_baselines(self, values_ohm: NDArray[np.float32]) -> None:
        """Set the (U, K) baseline R0 in ohms."""
        self.baseline_ohm = values_ohm
        self.tared = True
        self.selection.forget()
