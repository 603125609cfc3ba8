"""Options of the trackers, with their defaults and checks.

A constructor accepts an options object, keyword arguments with the same names, or both; keyword arguments
take precedence.
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
DRIFTS: Final = ("none", "patch", "wire")


@dataclass(frozen=True, kw_only=True, eq=False)
class EstimateOptions:
    """Options common to all trackers.

    Args:
        relative_noise: Relative standard deviation of R, a number or (U, K).
        baseline_ohm: (U, K) resistances measured at rest, ohm; if given, resistivity and gain cancel.
        rubber: Material of the skin. Forces are proportional to the rubber's modulus; the displacement does
            not depend on the modulus.
        estimate_noise: Whether to estimate, from the residuals, a factor that scales ``relative_noise``.
        follow_noise: Whether to scale ``relative_noise`` if the noise of the stream differs from it by a
            factor of more than 1.5 (:mod:`skinnode.solve.noise_estimate`). Ignored if ``estimate_noise`` is
            set.
        drift: Gain errors to estimate: ``patch`` for one gain common to all resistances, ``wire`` for one
            gain per upper wire, or ``none``.
        drift_std: Expected (prior) standard deviation of a gain error; 0.02 is 2 %.
        model_error: Standard error of the forward model (due to thickness, electrode size and conductivity
            under strain), as a fraction of each resistance's change. An error common to all resistances has
            this standard deviation; an additional, independent error of each resistance has 0.7 times this
            standard deviation.
        tolerances: Manufacturing tolerances of the patch, which increase the standard deviations; None
            (default) means an exact patch. The solver assumes that the resistances at rest were measured on
            the patch itself.
        contacts: Whether to estimate contacts and forces.
        force_calibrated: Whether ``rubber`` reproduces known forces on this patch, for instance from presses
            with a load cell. A modulus from a data sheet is not a calibration, because forces are computed
            for a half-space. A thin layer on a support can carry fifty times as much force at the same
            displacement. If ``force_calibrated`` is False, the standard deviation of each normal force covers
            this difference.
        normal_only: Whether only z is unknown, which reduces the number of unknowns to a third.
        hold: Whether to keep the last solution of a wire if its resistances changed by no more than their
            noise.
        deadline_us: Time limit of an update, µs; an update can exceed the limit by the time for one solver
            step. Wires still unsolved at the deadline have the status DEADLINE.

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

    def __post_init__(self) -> None:
        if self.drift not in DRIFTS:
            raise ValueError(f"drift: got {self.drift!r}, must be one of {', '.join(DRIFTS)}")
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
    """Options of :class:`skinnode.Posterior`: ``scale_m``, and those of :class:`EstimateOptions`.

    Args:
        scale_m: RMS normal displacement expected by the prior, metres; by default estimated from the data.

    Raises:
        ValueError: If an option is out of range.
    """

    scale_m: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scale_m is not None:
            require_positive("scale_m", self.scale_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackerOptions(EstimateOptions):
    """Options of :class:`skinnode.Tracker`: the following, and those of :class:`EstimateOptions`.

    The method ``auto`` chooses the posterior if ``drift``, ``model_error``, ``tolerances`` or
    ``estimate_noise`` is set, since only the posterior supports these options.

    Args:
        method: ``exact``, ``posterior`` or ``auto``.
        operator: ``levenberg_marquardt``, ``dogleg`` or ``gauss_newton``; exact inverse only.
        stiffness_n_per_m: Stiffness k in the paper's law F = k Δs, N/m; if given, the exact inverse computes
            ``force_n`` by this law. All other forces, including contact forces, are computed from ``rubber``.
        active_only: Whether to fix electrodes at rest unless a contact moves them; exact inverse only.
        codes: Mapping from the codes passed to :meth:`skinnode.Tracker.update_codes` to resistances.
        max_std_m: A field is precise only if no coordinate has a larger standard deviation, metres; the
            default depends on the layout and the noise (:mod:`skinnode.solve.precision`).
        max_force_std_n: A field is precise only if no normal force of a contact has a larger standard
            deviation, N. The default depends on the layout and the rubber, and applies only to calibrated
            forces.

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

    def __post_init__(self) -> None:
        if self.method not in TRACKER_METHODS:
            raise ValueError(f"method: got {self.method!r}, must be one of {', '.join(TRACKER_METHODS)}")
        for name, limit in (("max_std_m", self.max_std_m), ("max_force_std_n", self.max_force_std_n)):
            if limit is not None:
                require_positive(name, limit)
        super().__post_init__()

    def of_posterior(self) -> PosteriorOptions:
        """Return the options for the posterior of the same patch."""
        names = [field.name for field in dataclasses.fields(EstimateOptions)]
        return PosteriorOptions(**{name: getattr(self, name) for name in names})

    @property
    def nuisances(self) -> list[str]:
        """Names of the active options that only the posterior supports."""
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


_Options = TypeVar("_Options", PosteriorOptions, TrackerOptions)


def merged(kind: type[_Options], options: _Options | None, arguments: Any) -> _Options:
    """Return ``options`` (by default, ``kind``'s defaults) with the keyword arguments applied.

    Raises:
        TypeError: If an argument is not an option, or ``options`` is not of type ``kind``.
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
    """Check that an option is positive and finite.

    Raises:
        ValueError: If the value is not positive and finite.
    """
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name}: got {value}, must be positive and finite")
