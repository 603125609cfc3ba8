"""Records that flow through the host: the resistances of a scan in, a displacement field out."""

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
    """Identity and times of a scan; a time is of the host's monotonic clock unless it says otherwise."""

    patch: str
    """Name of the patch."""
    scan: int
    """Scan number since the stream started, unwrapped."""
    counter: int
    """Scan number in the frames, u8: the SYNC counter if the SYNC has one."""
    device_time_us: int
    """Time of the node's own clock at the scan's SYNC, µs, 0 to 2³² − 1, wraps; 0 if the summary was lost. In
    steps of 64 µs; the host derives the upper 10 bits, at the first scan from its own clock. The node's own
    32 bits, in steps of 1 µs, can be read from 0x2011:4. Patches of revision 1.0 send those with each
    scan."""
    t_sync_ns: int
    """Time at which the SYNC of this scan was sent or received; 0 if unknown."""
    t_receive_ns: int
    """Time at which the last frame of the scan was received."""
    t_solved_ns: int = 0
    """Time at which the field was ready; 0 before that."""

    def solved_at(self, t_ns: int) -> ScanStamp:
        """Return the stamp of a field that was ready at ``t_ns``."""
        return ScanStamp(
            self.patch, self.scan, self.counter, self.device_time_us, self.t_sync_ns, self.t_receive_ns, t_ns
        )


@dataclass(frozen=True, slots=True, eq=False)
class ResistanceFrame:
    """One scan of a patch."""

    resistance_ohm: Float
    """(U, K) wire-to-wire resistances, ohm; NaN if not valid."""
    valid: NDArray[np.bool_]
    """(U, K) False if a chunk is missing, a wire is open or shorted, or a code is out of range."""
    stamp: ScanStamp


@dataclass(frozen=True, slots=True)
class SolveStats:
    """Cost of a solve."""

    evaluations: int
    """Evaluations of F."""
    jacobians: int
    """Evaluations of J, which gives F as well."""
    steps: int
    """Steps of the operator; of a posterior, factorisations."""
    time_s: float
    """Time, s."""


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """A contact on the skin; each number has its standard deviation."""

    centroid_m: Float
    """(3,) metres, centre of the normal load on the skin at rest, in the frame of the layout."""
    centroid_std_m: Float
    """(3,) metres."""
    area_m2: float
    """Area of the contact of a smooth body (Hertz), m²; of one cell if it is too small to tell."""
    area_std_m2: float
    normal_force_n: float
    """Normal force, N, positive when pressing."""
    normal_force_std_n: float
    shear_force_n: Float
    """(2,) N, along the wires and across them."""
    shear_force_std_n: Float
    """(2,) N."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldFrame:
    """Displacement field of a patch with its uncertainty, and one status a wire."""

    displacement_m: Float
    """(U, N, 3) metres, from the rest position."""
    displacement_std_m: Float
    """(U, N, 3) metres, standard deviation given the noise of the resistances; inf if nothing is known. An
    error of five of them is a fault: a part that comes from a prior allows for the tail of the prior's
    errors."""
    status: tuple[Status, ...]
    """(U,) statuses of the upper wires."""
    residual: Float
    """(U,) RMS of the relative residual F/b − 1 over the valid resistances of a wire."""
    stats: SolveStats
    force_n: Float | None = None
    """(U, N, 3) N, loads on the skin: those of the posterior, or by the paper's law k Δs if a stiffness was
    given."""
    stamp: ScanStamp | None = None
    """Scan that the field is of; None outside a host."""
    method: str = "exact"
    """``exact``: each wire inverted; ``posterior``: the patch estimated with its elastic prior."""
    by_prior: NDArray[np.bool_] | None = None
    """(U,) wires whose own equations were not enough: in an exact field those estimated with the prior, in a
    posterior those without any. ``trusted`` may rest on the prior alone there."""
    contacts: tuple[Contact, ...] = ()
    """Contacts, strongest first, if ``method`` is ``posterior``. An exact field has none, and ``auto`` gives
    exact fields if noise and layout allow it: ask for the posterior if contacts are needed
    (``solver.method`` of hand.toml, ``method`` of Tracker)."""
    gain: Float | None = None
    """(U,) estimated gain error of the resistances of each wire, as a share, if a drift is estimated."""
    noise_factor: float = 1.0
    """Estimated noise over the noise given; 1 if it is not estimated."""
    held: NDArray[np.bool_] | None = None
    """(U,) wires not solved, because they did not move beyond the noise of the frame."""
    core_std_m: Float | None = None
    """(U, N, 3) metres, standard deviation of the bulk of the errors, without that tail; None if it is the
    same."""

    @property
    def half_width_95_m(self) -> Float:
        """(U, N, 3) metres, half of the width of the 95 % interval around the displacement."""
        return Z_95_TWO_SIDED * (self.displacement_std_m if self.core_std_m is None else self.core_std_m)

    @property
    def trusted(self) -> bool:
        """Whether every wire converged."""
        return all(status is Status.CONVERGED for status in self.status)


_Record = TypeVar("_Record", Contact, FieldFrame)


def sealed(record: _Record, **changes: Any) -> _Record:
    """Return a copy with ``changes``, whose arrays cannot be written, because many receivers share it.

    The arrays are views; the solver goes on to write its own.
    """
    twin = object.__new__(type(record))  # once a field: ``replace`` takes five times as long
    for name in _NAMES[type(record)]:
        value = changes[name] if name in changes else getattr(record, name)
        if isinstance(value, np.ndarray) and value.flags.writeable:
            value = value.view()
            value.flags.writeable = False
        object.__setattr__(twin, name, value)
    return twin


_NAMES: Final = {kind: [entry.name for entry in fields(kind)] for kind in (Contact, FieldFrame)}
