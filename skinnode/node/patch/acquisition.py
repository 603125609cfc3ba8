"""From the analogue port to codes: sampling, tare, wire faults, and which chunks of a scan are to be sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float, require_array
from skinnode.node.patch.source import ResistanceSource, read_source
from skinnode.protocol.chunk import chunk_of_code
from skinnode.protocol.codes import Codes, CodeScale, encode
from skinnode.protocol.profile import PatchProfile

TARE_READS: Final = 16
"""Readings averaged into a baseline: its noise, a quarter of a reading's, then adds 3 % to that of R/R0."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class WireFaults:
    """Wires without a single usable crossing. Masks over upper wires (U,) and lower wires (K,)."""

    upper_open: Mask
    upper_short: Mask
    lower_open: Mask
    lower_short: Mask

    @classmethod
    def none(cls, profile: PatchProfile) -> WireFaults:
        """All wires are well."""
        rows, columns = np.zeros(profile.rows, dtype=np.bool_), np.zeros(profile.columns, dtype=np.bool_)
        return cls(rows, rows, columns, columns)

    @property
    def masks(self) -> tuple[Mask, Mask, Mask, Mask]:
        """Upper open, upper shorted, lower open, lower shorted."""
        return self.upper_open, self.upper_short, self.lower_open, self.lower_short

    @property
    def any(self) -> bool:
        """Whether any wire is at fault."""
        return any(mask.any() for mask in self.masks)


class Acquisition:
    """Reads a source and keeps the last codes and the baseline."""

    def __init__(
        self, profile: PatchProfile, source: ResistanceSource, scale: CodeScale, baseline_ohm: Float | None
    ) -> None:
        self._profile, self._source, self.scale = profile, source, scale
        shape = profile.rows, profile.columns
        self.tared = baseline_ohm is not None
        """Whether there is a baseline at all; set by :meth:`tare` and by a baseline given."""
        given = (
            np.zeros(shape) if baseline_ohm is None else require_array("baseline_ohm", baseline_ohm, shape)
        )
        if (given < 0).any():
            raise ValueError(f"baseline_ohm: got {given.min()}, must not be negative")
        self.baseline_ohm: NDArray[np.float32] = given.astype(np.float32)
        """R0 as the object dictionary keeps it: REAL32; 0 where there is none."""
        self.codes: Codes = np.full(shape, scale.open, dtype=np.uint32)
        """(U, K) of the last scan; none has a resistance before the first one."""
        self.faults = WireFaults.none(profile)
        self._sent: Codes | None = None  # what the host has, chunk by chunk; None: nothing it could rely on
        self._since_full = 0

    def read(self, t_ns: int) -> Float:
        """(U, K) resistances in ohm. Raises SourceFailed, as all do that read."""
        return read_source(self._source, (self._profile.rows, self._profile.columns), t_ns)

    def sample(self, t_ns: int, readings: int = 1) -> None:
        """Take a scan: the mean of ``readings`` readings, as codes."""
        resistance = self._total(t_ns, readings)
        self.codes = encode(resistance / readings, self.baseline_ohm, self.scale)
        self.faults = find_faults(self.codes, self.scale)

    def _total(self, t_ns: int, readings: int) -> Float:
        """Sum of so many readings; no number, which counts as open, where they are infinite both ways."""
        total = self.read(t_ns)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(readings - 1):
                total += self.read(t_ns)
        return total

    def tare(self, t_ns: int, readings: int = TARE_READS) -> None:
        """Make the present resistances the baseline. Pairs without a resistance keep the one they have."""
        with np.errstate(over="ignore", under="ignore"):  # what REAL32 cannot hold is no resistance either
            mean = (self._total(t_ns, readings) / readings).astype(np.float32)
        measured = np.isfinite(mean) & (mean > 0)
        self.baseline_ohm = np.where(measured, mean, self.baseline_ohm)
        self.tared = True
        self.forget_sent()

    def set_baseline(self, row: int, column: int, value_ohm: float) -> None:
        """Set one R0. Whoever does so sees to the others: the node will not tare by itself."""
        self.baseline_ohm[row, column] = value_ohm
        self.tared = True
        self.forget_sent()

    def set_baselines(self, values_ohm: NDArray[np.float32]) -> None:
        """Set every R0 to that of ``values_ohm``, (U, K)."""
        self.baseline_ohm = values_ohm
        self.tared = True
        self.forget_sent()

    @property
    def sent(self) -> Codes:
        """(U, K) codes: the last codes sent of every chunk, if :meth:`changed_chunks` selects the chunks."""
        return self.codes if self._sent is None else self._sent

    def forget_sent(self) -> None:
        """Make the next scan a full one: nobody is known to have what was sent before."""
        self._sent = None

    def changed_chunks(self, threshold: int, full_every: int) -> list[int] | None:
        """Indices of the chunks with a code that moved by more than ``threshold`` since it was sent, or
        became or ceased to be a reserved one; None when a full scan is due, every ``full_every`` scans (0:
        never).

        The caller sends them all, so they count as sent.
        """
        self._since_full += 1
        if self._sent is None or (full_every and self._since_full >= full_every):
            self._since_full = 0
            self._sent = self.codes
            return None
        steps = self.scale.steps
        moved = np.abs(self.codes.astype(np.int64) - self._sent) > threshold
        moved |= ((self.codes > steps) | (self._sent > steps)) & (self.codes != self._sent)
        places = chunk_of_code(self._profile)
        chunks = np.zeros(self._profile.n_chunks, dtype=np.bool_)
        chunks[places[moved]] = True
        self._sent = np.where(chunks[places], self.codes, self._sent)
        return [int(index) for index in np.flatnonzero(chunks)]


def find_faults(codes: Codes, scale: CodeScale) -> WireFaults:
    """Wires all of whose crossings are open, or all shorted."""
    is_open, is_short = codes == scale.open, codes == scale.short
    return WireFaults(is_open.all(axis=1), is_short.all(axis=1), is_open.all(axis=0), is_short.all(axis=0))
