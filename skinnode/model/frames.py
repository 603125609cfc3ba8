"""Data classes for the resistances of a scan and the displacement field computed from them."""

from __future__ import annotations

import copyreg
import operator
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from skinnode.model.data_fault import DataFault
from skinnode.model.layout import Float
from skinnode.model.status import Status

Z_95_TWO_SIDED: Final = 1.959964
"""Half-width of the interval that contains 95 % of a normal distribution, in standard deviations."""


@dataclass(frozen=True, slots=True)
class ScanStamp:
    """Number and times of a scan. Times with the suffix ``_ns`` are on the host's monotonic clock."""

    patch: str
    """Name of the patch."""
    scan: int
    """Number of the scan, counted from the start of the run without wrap-around."""
    counter: int
    """Scan number in the CAN frames, u8; equal to the SYNC counter if SYNC frames contain a counter."""
    device_time_us: int
    """Time of the scan's SYNC on the node's own clock, in µs modulo 2³²; 0 if the summary was lost.

    The resolution is 64 µs. The summary contains only the lower 22 bits of the time; the host adds the upper
    10 bits. Object 0x2011:4 contains the node's time with a resolution of 1 µs.
    """
    t_sync_ns: int
    """Time at which the SYNC of this scan was sent or received; 0 if unknown. The field applies to this time,
    apart from the constant delay until the node samples the first upper wire."""
    t_receive_ns: int
    """Time at which the last frame of the scan was received."""
    t_solved_ns: int = 0
    """Time at which the displacement field was ready; 0 if it is not ready yet."""
    run: int = 0
    """Number of times that a remote hand's daemon has restarted since the program connected; 0 in a host.
    Scan numbers restart in each run.
    """

    def solved_at(self, t_ns: int) -> ScanStamp:
        """Return a copy of the stamp with ``t_solved_ns`` set to ``t_ns``."""
        return ScanStamp(
            self.patch,
            self.scan,
            self.counter,
            self.device_time_us,
            self.t_sync_ns,
            self.t_receive_ns,
            t_ns,
            self.run,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ResistanceFrame:
    """One scan of a patch."""

    resistance_ohm: Float
    """(U, K) wire-to-wire resistances, in ohms; NaN where invalid."""
    valid: NDArray[np.bool_]
    """(U, K) mask of the valid resistances; False if a chunk is missing, a wire is open or shorted, or a code
    is out of range.
    """
    stamp: ScanStamp


@dataclass(frozen=True, slots=True)
class SolveStats:
    """Cost of a solve: numbers of evaluations and steps, and elapsed time."""

    evaluations: int
    """Number of evaluations of the forward model F."""
    jacobians: int
    """Number of evaluations of the Jacobian J, each of which also evaluates F."""
    steps: int
    """Number of solver iterations; for the posterior method, number of matrix factorisations."""
    time_s: float
    """Elapsed time, in seconds."""


_FLAT: Final = np.eye(3)
_FLAT.setflags(write=False)


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Contact between a body and the skin, including the standard deviation of each value."""

    centroid_m: Float
    """(3,) centre of the normal load on the undeformed skin, in layout coordinates (metres)."""
    centroid_std_m: Float
    """(3,) standard deviation of the centre, in metres."""
    area_m2: float
    """Contact area, in m², estimated for a smooth body (Hertz). If the contact is too small to be resolved,
    this is the area of one electrode cell.
    """
    area_std_m2: float
    normal_force_n: float
    """Normal force, in N; positive if the body presses on the skin."""
    normal_force_std_n: float
    shear_force_n: Float
    """(2,) shear force along and across the upper wires, in N."""
    shear_force_std_n: Float
    """(2,) standard deviation of the shear force, in N."""
    force_calibrated: bool = False
    """Whether the forces are based on a calibration of this patch (``force_calibrated`` in Tracker or in
    ``[patches.calibration]``).

    Without a calibration, the standard deviation of the normal force also covers the error of the half-space
    model: for a bonded layer as thick as the clearance, the error is below five standard deviations. The
    standard deviation of the shear force does not cover the model's error.
    """
    axes: Float = field(default_factory=lambda: _FLAT)
    """(3, 3) axes at the centre of the contact, as rows, in layout coordinates. The rows are unit vectors
    along the upper wires, across them, and out of the skin. On a flat patch, they are the x, y and z axes.
    """


@dataclass(frozen=True, slots=True, eq=False)
class FieldFrame:
    """Displacement field of a patch, including its uncertainty and the status of each wire."""

    displacement_m: Float
    """(U, N, 3) displacement from the rest position, in metres.

    It applies to the time of the scan, at which all upper wires were sampled. If they are sampled one after
    the other and the row time is configured (``row_time_us``), this is the time at which the first upper wire
    was sampled; without a configured row time, the displacement of each wire applies to that wire's own
    sampling time.
    """
    displacement_std_m: Float
    """(U, N, 3) standard deviation due to noise in the resistances, in metres; inf where the displacement is
    unknown. Where the prior contributes to the displacement, the standard deviation is enlarged to cover rare
    large errors of the prior. An error above five standard deviations therefore indicates a fault.
    """
    status: tuple[Status, ...]
    """Status of each upper wire."""
    residual: Float
    """(U,) RMS of the relative residuals of each wire's valid resistances."""
    stats: SolveStats
    force_n: Float | None = None
    """(U, N, 3) load on the skin at each electrode, in N; None if ``contacts`` was switched off. Loads are
    computed with the half-space model, or as F = k Δs if the method is ``exact`` and a stiffness k was
    specified.
    """
    stamp: ScanStamp | None = None
    """Number and times of the scan from which the field was computed; None if no host was involved."""
    method: str = "exact"
    """``exact`` if each wire was solved separately; ``posterior`` if the patch was estimated as a whole."""
    by_prior: NDArray[np.bool_] | None = None
    """(U,) mask of the wires that were estimated with the prior because their own resistances were
    insufficient. With the ``posterior`` method, these are the wires without any usable resistance. The
    displacement of such a wire may be based on the prior alone, even if the wire is trusted.
    """
    contacts: tuple[Contact, ...] = ()
    """Contacts, strongest first; empty if nothing touches the skin, if no wire could be solved, or if
    ``contacts`` was switched off. Detection uses hysteresis from scan to scan, so that noise does not split
    or remove a contact. If a field of the exact method is incomplete because of its deadline, it has the
    contacts and forces of the previous field, for at most three successive fields.
    """
    gain: Float | None = None
    """(U,) estimated relative gain error of each wire's resistances; None if gains are not estimated."""
    noise_factor: float = 1.0
    """Ratio of the estimated noise to the configured noise; exactly 1 as long as the data are consistent with
    the configured noise. If the resistances were computed from codes, the ratio excludes quantization
    noise.
    """
    held: NDArray[np.bool_] | None = None
    """(U,) mask of the wires that were not solved again, because their resistances changed by no more than
    the noise.
    """
    core_std_m: Float | None = None
    """(U, N, 3) standard deviation without the enlargement for rare large errors of the prior, in metres;
    None if equal to ``displacement_std_m``.
    """

    distrust: str | None = None
    """Reason why the field is not trusted; empty if the field is trusted, None if it was not tested."""
    wires_trusted: NDArray[np.bool_] | None = None
    """(U,) mask of the wires that converged and have enough usable readings; None if the readings were not
    tested.
    """
    precise: bool = True
    """Whether the standard deviations are within the limits ``max_std_m`` and ``max_force_std_n``."""
    data_share: Float | None = None
    """(U, N, 3) fraction of each displacement that is determined by the data of this scan rather than by the
    prior: 1 minus the ratio of the posterior variance to the prior variance. None if all fractions are 1.
    """
    touched: bool | None = None
    """Whether the detector reports a touch; None if the detector is switched off, or if fewer than half of
    the readings are usable. A touch continues without interruption until the mean of four scans agrees with
    the rest state. Noise alone causes at most ``false_alarms_per_hour`` reports per hour.
    """
    touch_odds: float | None = None
    """Odds of touch versus no touch, given the readings of this scan and the odds after the previous scan;
    inf if too large for a float, None without detection. The odds are the likelihood ratio of the readings
    times the prior odds. Without a touch, the readings differ from rest by noise and gain drift. With a
    touch, independent loads on all cells also displace the skin; all octaves of depth, from a depth hidden by
    noise to 16 % of the layer height (RMS), are equally likely. The prior is a two-state Markov chain, with
    one touch per minute that lasts one second on average. ``touched`` does not depend on the odds, but on the
    permitted number of false alarms.
    """
    faults: tuple[DataFault, ...] = ()
    """Readings that failed a test and were not used to compute the field."""

    @property
    def half_width_95_m(self) -> Float:
        """(U, N, 3) half-width of the 95 % interval around the displacement, in metres."""
        return Z_95_TWO_SIDED * (self.displacement_std_m if self.core_std_m is None else self.core_std_m)

    @property
    def trusted(self) -> bool:
        """Whether the field passed all tests; if not, ``distrust`` contains the reason.

        A field that was not tested is trusted if every wire has the status CONVERGED.
        """
        if self.distrust is None:
            return all(status is Status.CONVERGED for status in self.status)
        return not self.distrust


_Record = TypeVar("_Record", Contact, FieldFrame)


def sealed(record: _Record, **changes: Any) -> _Record:
    """Return a copy of a record with ``changes`` applied and all arrays made read-only.

    The copy's arrays are views; the original arrays remain writable. Several readers can share the copy.
    """
    twin = _copy(record, changes)
    slots = _SLOTS[type(record)]
    for name, value in zip(slots, _VALUES[type(record)](twin), strict=True):
        if isinstance(value, np.ndarray) and value.flags.writeable:
            value = value.view()
            value.flags.writeable = False
            slots[name](twin, value)
    return twin


def amended(field: FieldFrame, **changes: Any) -> FieldFrame:
    """Return a copy of a field with ``changes`` applied; eight times as fast as ``dataclasses.replace``."""
    return _copy(field, changes)


def _copy(record: _Record, changes: dict[str, Any]) -> _Record:
    kind = type(record)
    twin, slots = object.__new__(kind), _SLOTS[kind]
    for store, value in zip(slots.values(), _VALUES[kind](record), strict=True):
        store(twin, value)
    for name, value in changes.items():
        slots[name](twin, value)
    return twin


_SLOTS: Final[dict[type, dict[str, Callable[[Any, Any], None]]]] = {
    kind: {entry.name: getattr(kind, entry.name).__set__ for entry in fields(kind)}
    for kind in (Contact, FieldFrame)
}
_VALUES: Final = {kind: operator.attrgetter(*names) for kind, names in _SLOTS.items()}
_PICKLED: Final = {
    kind: operator.attrgetter(*(entry.name for entry in fields(kind)))
    for kind in (ScanStamp, SolveStats, Contact, FieldFrame)
}


def _reduced(record: Any) -> tuple[type, tuple[Any, ...]]:
    """Return what pickle stores; the default for frozen data classes takes half as long again."""
    kind = type(record)
    return kind, _PICKLED[kind](record)


for _kind in _PICKLED:
    copyreg.pickle(_kind, _reduced)
