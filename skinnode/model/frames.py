"""What flows through the host, as frozen records: a scan's resistances in, a displacement field out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.model.status import Status


@dataclass(frozen=True, slots=True)
class ScanStamp:
    """Which scan of which patch, and when. Times are of the host's monotonic clock, ns."""

    patch: str
    scan: int
    """Scan number since the stream started, unwrapped."""
    counter: int
    """Scan number as on the wire, u8; the SYNC counter where there is one."""
    device_time_us: int
    """Time of the node's own clock at the scan's SYNC, u32, wraps."""
    t_sync_ns: int
    """When the SYNC of this scan was sent or seen; 0 where it was not."""
    t_receive_ns: int
    """When the last frame of the scan was received."""
    t_solved_ns: int = 0
    """When the field was ready; 0 before that."""


@dataclass(frozen=True, slots=True, eq=False)
class ResistanceFrame:
    """One scan of a patch."""

    resistance_ohm: Float
    """(U, K) wire-to-wire resistances; NaN where not valid."""
    valid: NDArray[np.bool_]
    """(U, K) False where a chunk is missing, a wire is open or shorted, or a code is out of range."""
    stamp: ScanStamp


@dataclass(frozen=True, slots=True)
class SolveStats:
    """What a solve cost. ``evaluations`` counts F, ``jacobians`` counts J (which yields F as well)."""

    evaluations: int
    jacobians: int
    steps: int
    time_s: float


@dataclass(frozen=True, slots=True, eq=False)
class FieldFrame:
    """The displacement field of a patch with its uncertainty, one status a wire."""

    displacement_m: Float
    """(U, N, 3) from the rest position."""
    displacement_std_m: Float
    """(U, N, 3) standard deviation given the noise of the resistances; inf where nothing is known."""
    status: tuple[Status, ...]
    """One for each upper wire."""
    residual: Float
    """(U,) RMS of the relative residual F/b − 1 over the valid resistances of a wire."""
    stats: SolveStats
    force_n: Float | None = None
    """(U, N, 3) by the paper's law k Δs, where a stiffness was given."""
    stamp: ScanStamp | None = None

    @property
    def trusted(self) -> bool:
        """True when every wire converged."""
        return all(status is Status.CONVERGED for status in self.status)
