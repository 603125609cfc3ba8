"""Options of the trackers: names, defaults and validation.

The constructor of a tracker accepts an options object, keyword arguments with the same names, or both.
Keyword arguments take precedence.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Final, TypedDict, TypeVar

from numpy.typing import ArrayLike

from skinnode.model.elastic import Rubber
from skinnode.model.tolerances import Tolerances
from skinnode.solve.inputs import CodeMap

TRACKER_METHODS: Final = ("auto", "exact", "posterior")
PRIORS: Final = ("auto", "cells", "discs")
PASTS: Final = ("off", "auto")
DRIFTS: Final = ("none", "patch", "wire")


@dataclass(frozen=True, kw_only=True, eq=False)
class EstimateOptions:
    """Options common to all trackers.

    Args:
        relative_noise: Relative standard deviation of R, scalar or (U, K).
        baseline_ohm: (U, K) resistances measured at rest, in ohms. If given, errors in resistivity and gain
            cancel.
        rubber: Material of the skin. Forces are proportional to its modulus; displacements do not depend on
            the modulus.
        estimate_noise: Whether to scale ``relative_noise`` by a factor estimated from the residuals.
        follow_noise: Whether to scale ``relative_noise`` if the noise of the stream differs from it by a
            factor of more than 1.5 (:mod:`skinnode.solve.noise_estimate`). Ignored if ``estimate_noise`` is
            set.
        drift: Gain errors to estimate: ``patch`` for one gain common to all resistances, ``wire`` for one
            gain per upper wire, or ``none``.
        drift_std: Prior standard deviation of a gain error; 0.02 is 2 %.
        model_error: Standard deviation of the forward model's error, as a fraction of the change in each
            resistance. Typical causes are thickness, electrode size and conductivity under strain. The model
            assumes an error with this standard deviation, common to all resistances, and independent errors
            with 0.7 times this standard deviation.
        tolerances: Manufacturing tolerances of the patch, which increase the standard deviations; None
            (default) for an exact patch. The resistances at rest must have been measured on the patch itself.
        contacts: Whether to estimate contacts and forces.
        force_calibrated: Whether ``rubber`` reproduces known forces on this patch, for example in presses
            with a load cell. A modulus from a data sheet is not a calibration: forces are computed for a
            half-space, and a thin layer on a support can carry fifty times as much force at the same
            displacement. If False, the standard deviation of each normal force covers this difference.
        normal_only: Whether to fix x and y at rest and solve for z only, which leaves a third of the
            unknowns.
        hold: Whether to keep the last solution of a wire while its resistances change by no more than their
            noise.
        deadline_us: Time limit for an update, in µs; an update can exceed it by the duration of one solver
            step. Wires that are unsolved at the deadline have the status DEADLINE.
        prior: Prior for the loads after the posterior has found a touch: ``cells`` for one variance per cell,
            or ``discs`` for a few soft discs, which are fitted to the frame by maximising the evidence. With
            ``discs``, errors are smaller, but with ``model_error`` the standard deviations are too small. If
            the loads are not local, ``discs`` falls back to ``cells``. ``auto`` selects ``discs`` if the
            noise of the readings is 1e-4 or more and neither ``model_error`` nor ``scale_m`` is given.
        past: ``auto`` if the posterior is to use earlier frames as well when the noise of the readings is
            1e-4 or more; ``off`` if it is to solve each frame alone. A sudden change in the loads takes
            effect in the same frame. Ignored if ``estimate_noise`` is set, and for patches with fewer than 12
            readings.

    Raises:
        ValueError: If an option is out of range.
    """

    relative_noise: ArrayLike = 1e-5
    baseline_ohm: ArrayLike | None = None
    rubber: Rubber | None = None
    estimate_noise: bool = False
    follow_noise: bool = True
    drift: str = "none"
    drift_std: float = 0.02
    model_error: float = 0.0
    tolerances: Tolerances | None = None
    contacts: bool = True
    force_calibrated: bool = False
    normal_only: bool = False
    hold: bool = True
    deadline_us: float | None = None
    prior: str = "auto"
    past: str = "auto"

    def __post_init__(self) -> None:
        if self.drift not in DRIFTS:
            raise ValueError(f"drift: got {self.drift!r}, must be one of {', '.join(DRIFTS)}")
        if self.prior not in PRIORS:
            raise ValueError(f"prior: got {self.prior!r}, must be one of {', '.join(PRIORS)}")
        if self.past not in PASTS:
            raise ValueError(f"past: got {self.past!r}, must be one of {', '.join(PASTS)}")
        require_positive("drift_std", self.drift_std)
        if not (math.isfinite(self.model_error) and self.model_error >= 0):
            raise ValueError(f"model_error: got {self.model_error}, must be finite and at least 0")
        if not (self.tolerances is None or isinstance(self.tolerances, Tolerances)):
            raise ValueError(f"tolerances: got {self.tolerances!r}, must be Tolerances or None")
        if self.deadline_us is not None:
            require_positive("deadline_us", self.deadline_us)

    @property
    def deadline_s(self) -> float:
        """Time limit ``deadline_us`` in seconds; inf if there is no deadline."""
        return math.inf if self.deadline_us is None else self.deadline_us * 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class PosteriorOptions(EstimateOptions):
    """Options of :class:`skinnode.Posterior`: ``scale_m`` and the options of :class:`EstimateOptions`.

    Args:
        scale_m: RMS normal displacement in the prior, in metres; by default, it is estimated from the data.
            Cannot be combined with the prior ``discs``.

    Raises:
        ValueError: If an option is out of range, or the prior is ``discs`` and ``scale_m`` is given.
    """

    scale_m: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scale_m is not None:
            require_positive("scale_m", self.scale_m)
            if self.prior == "discs":
                allowed = "None with prior='discs', because the discs determine the prior"
                raise ValueError(f"scale_m: got {self.scale_m}, must be {allowed}")

    @property
    def kernels(self) -> tuple[object, ...]:
        """Values of all options that determine which kernels a stream calls."""
        numbers = "relative_noise", "baseline_ohm", "rubber", "deadline_us"
        names = [field.name for field in dataclasses.fields(self) if field.name not in numbers]
        return tuple(getattr(self, name) for name in names)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackerOptions(EstimateOptions):
    """Options of :class:`skinnode.Tracker`: the options below and all options of :class:`EstimateOptions`.

    Only the posterior supports ``drift``, ``model_error``, ``tolerances`` and ``estimate_noise``. If any of
    them is set, ``auto`` selects the posterior.

    Args:
        method: ``exact``, ``posterior`` or ``auto``.
        operator: ``levenberg_marquardt``, ``dogleg`` or ``gauss_newton``; exact inverse only.
        stiffness_n_per_m: Stiffness k of the paper's force law F = k Δs, in N/m. If given, the exact inverse
            computes ``force_n`` by this law. All other forces, including contact forces, are computed from
            ``rubber``.
        active_only: Whether to fix electrodes at rest unless a contact moves them; exact inverse only.
        codes: Mapping from the codes passed to :meth:`skinnode.Tracker.update_codes` to resistances.
        max_std_m: Maximum standard deviation of a coordinate in a precise field, in metres. The default
            depends on the layout and the noise (:mod:`skinnode.solve.precision`).
        max_force_std_n: Maximum standard deviation of a contact's normal force in a precise field, in N. The
            default depends on the layout and the rubber, and applies only to calibrated forces.
        detect: Whether to detect touches before solving (:mod:`skinnode.solve.detect`). An untouched patch is
            then not solved, unless ``hold`` is off or ``estimate_noise`` is on.
        false_alarms_per_hour: Accepted number of touches per hour reported because of noise alone.
        scan_period_s: Time between successive frames, in s. The detector uses this time to model gain drift
            and to limit the number of false alarms.
        row_time_s: Time between the samples of successive upper wires in a frame, in s; 0 if all upper wires
            are sampled at once. If it is given, the displacements and loads of a moving skin are those at the
            time when the first upper wire was sampled (:mod:`skinnode.solve.skew`).

    Raises:
        ValueError: If an option is out of range.
    """

    method: str = "auto"
    operator: str = "levenberg_marquardt"
    stiffness_n_per_m: float | None = None
    active_only: bool = False
    codes: CodeMap | None = None
    max_std_m: float | None = None
    max_force_std_n: float | None = None
    detect: bool = True
    false_alarms_per_hour: float = 0.1
    scan_period_s: float = 0.08
    row_time_s: float = 0.0

    def __post_init__(self) -> None:
        if self.method not in TRACKER_METHODS:
            raise ValueError(f"method: got {self.method!r}, must be one of {', '.join(TRACKER_METHODS)}")
        for name, limit in (("max_std_m", self.max_std_m), ("max_force_std_n", self.max_force_std_n)):
            if limit is not None:
                require_positive(name, limit)
        require_positive("scan_period_s", self.scan_period_s)
        require_positive("false_alarms_per_hour", self.false_alarms_per_hour)
        if not (math.isfinite(self.row_time_s) and self.row_time_s >= 0):
            raise ValueError(f"row_time_s: got {self.row_time_s}, must be finite and at least 0")
        super().__post_init__()

    def of_posterior(self) -> PosteriorOptions:
        """Return the options for the posterior of the same patch."""
        names = [field.name for field in dataclasses.fields(EstimateOptions)]
        return PosteriorOptions(**{name: getattr(self, name) for name in names})

    @property
    def nuisances(self) -> list[str]:
        """Names of all options that are set and that only the posterior supports."""
        asked = {
            "drift": self.drift != "none",
            "model_error": self.model_error > 0,
            "tolerances": not (self.tolerances is None or self.tolerances.exact),
            "estimate_noise": self.estimate_noise,
        }
        return [name for name, wanted in asked.items() if wanted]


class EstimateArguments(TypedDict, total=False):
    """Keyword arguments of every tracker, as in :class:`EstimateOptions`."""

    relative_noise: ArrayLike
    baseline_ohm: ArrayLike | None
    rubber: Rubber | None
    estimate_noise: bool
    follow_noise: bool
    drift: str
    drift_std: float
    model_error: float
    tolerances: Tolerances | None
    contacts: bool
    force_calibrated: bool
    normal_only: bool
    hold: bool
    deadline_us: float | None
    prior: str
    past: str


class PosteriorArguments(EstimateArguments, total=False):
    """Keyword arguments of :class:`skinnode.Posterior`, as in :class:`PosteriorOptions`."""

    scale_m: float | None


class TrackerArguments(EstimateArguments, total=False):
    """Keyword arguments of :class:`skinnode.Tracker`, as in :class:`TrackerOptions`."""

    method: str
    operator: str
    stiffness_n_per_m: float | None
    active_only: bool
    codes: CodeMap | None
    max_std_m: float | None
    max_force_std_n: float | None
    detect: bool
    false_alarms_per_hour: float
    scan_period_s: float
    row_time_s: float


_Options = TypeVar("_Options", PosteriorOptions, TrackerOptions)


def merged(kind: type[_Options], options: _Options | None, arguments: Any) -> _Options:
    """Return ``options``, or the defaults of ``kind`` if it is None, updated with the keyword arguments.

    Raises:
        TypeError: If an argument is not the name of an option, or ``options`` is not of type ``kind``.
        ValueError: If an option is out of range.
    """
    known = [field.name for field in dataclasses.fields(kind)]
    for name in arguments:
        if name not in known:
            raise TypeError(f"got an unexpected keyword argument {name!r}, must be one of {', '.join(known)}")
    if options is None:
        return kind(**arguments)
    if not isinstance(options, kind):
        raise TypeError(f"options: got {type(options).__name__}, must be {kind.__name__}")
    return dataclasses.replace(options, **arguments) if arguments else options


def require_positive(name: str, value: float) -> None:
    """Raise ValueError unless the value of an option is positive and finite."""
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name}: got {value}, must be positive and finite")
