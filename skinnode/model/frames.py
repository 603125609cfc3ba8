"""What flows through the host, as frozen records: a scan's resistances in, a displacement field out."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.model.status import Status

Z_95_TWO_SIDED: Final = 1.959964
"""Normal deviate within which 95 % of a normal distribution lie: 97.5 % lie below."""


@dataclass(frozen=True, slots=True)
class ScanStamp:
    """Which scan of which patch, and when. Times are of the host's monotonic clock, ns."""

    patch: str
    scan: int
    """Scan number since the stream started, unwrapped."""
    counter: int
    """Scan number as on the wire, u8; the SYNC counter where there is one."""
    device_time_us: int
    """Time of the node's own clock at the scan's SYNC, µs, 0 to 2³² − 1, wraps; 0 if the summary was lost. In
    steps of 64 µs; the host derives the upper 10 bits, at the first scan from its own clock. The node's own
    32 bits, in steps of 1 µs, can be read from 0x2011:4. Patches of revision 1.0 send those with each
    scan."""
    t_sync_ns: int
    """When the SYNC of this scan was sent or seen; 0 where it was not."""
    t_receive_ns: int
    """When the last frame of the scan was received."""
    t_solved_ns: int = 0
    """When the field was ready; 0 before that."""

    def solved_at(self, t_ns: int) -> ScanStamp:
        """The same, of a field that was ready at ``t_ns``."""
        return ScanStamp(
            self.patch, self.scan, self.counter, self.device_time_us, self.t_sync_ns, self.t_receive_ns, t_ns
        )


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
class Contact:
    """Something that presses on the skin. Each number with its standard deviation."""

    centroid_m: Float
    """(3,) centre of the normal load on the skin at rest, in the frame of the layout."""
    centroid_std_m: Float
    """(3,)"""
    area_m2: float
    """Area of the contact, if a smooth body presses (Hertz); of one cell where it is too small to tell."""
    area_std_m2: float
    normal_force_n: float
    """Positive when pressing."""
    normal_force_std_n: float
    shear_force_n: Float
    """(2,) along the wires and across them."""
    shear_force_std_n: Float
    """(2,)"""


@dataclass(frozen=True, slots=True, eq=False)
class FieldFrame:
    """The displacement field of a patch with its uncertainty, one status a wire."""

    displacement_m: Float
    """(U, N, 3) from the rest position."""
    displacement_std_m: Float
    """(U, N, 3) standard deviation given the noise of the resistances; inf where nothing is known. Five of
    them are a fault: where a prior has a part in it, it has the tail of what that may get wrong."""
    status: tuple[Status, ...]
    """One for each upper wire."""
    residual: Float
    """(U,) RMS of the relative residual F/b − 1 over the valid resistances of a wire."""
    stats: SolveStats
    force_n: Float | None = None
    """(U, N, 3) loads on the skin: those of the posterior, or by the paper's law k Δs where a stiffness was
    given."""
    stamp: ScanStamp | None = None
    method: str = "exact"
    """``exact``: each wire inverted; ``posterior``: the patch estimated with its elastic prior."""
    by_prior: NDArray[np.bool_] | None = None
    """(U,) wires whose own equations did not do: of an exact field those estimated with the prior, of a
    posterior those without any. ``trusted`` may rest on the prior alone there."""
    contacts: tuple[Contact, ...] = ()
    """What presses, the strongest first, where ``method`` is ``posterior``. Of an exact field always empty:
    ``auto`` gives such where noise and layout allow it, so ask for the posterior where contacts are needed
    (``solver.method`` of hand.toml, ``method`` of Tracker)."""
    gain: Float | None = None
    """(U,) estimated gain error of the resistances of each wire, where a drift is estimated."""
    noise_factor: float = 1.0
    """Estimated noise over the noise given, where it is estimated."""
    held: NDArray[np.bool_] | None = None
    """(U,) wires not solved, since the frame says within its noise that they have not moved."""
    core_std_m: Float | None = None
    """(U, N, 3) the deviation without that tail, of the bulk of the errors; None where there is no such."""

    @property
    def half_width_95_m(self) -> Float:
        """(U, N, 3) half of the width of the 95 % interval around the displacement."""
        return Z_95_TWO_SIDED * (self.displacement_std_m if self.core_std_m is None else self.core_std_m)

    @property
    def trusted(self) -> bool:
        """True when every wire converged."""
        return all(status is Status.CONVERGED for status in self.status)


_Record = TypeVar("_Record", Contact, FieldFrame)


def sealed(record: _Record, **changes: Any) -> _Record:
    """The same, but for the fields in ``changes``, with arrays that cannot be written: what many are given,
    none may change. They are views, and the solver goes on with its own."""
    twin = object.__new__(type(record))  # once a field: ``replace`` takes five times as long
    for name in _NAMES[type(record)]:
        value = changes[name] if name in changes else getattr(record, name)
        if isinstance(value, np.ndarray) and value.flags.writeable:
            value = value.view()
            value.flags.writeable = False
        object.__setattr__(twin, name, value)
    return twin


_NAMES: Final = {kind: [entry.name for entry in fields(kind)] for kind in (Contact, FieldFrame)}
