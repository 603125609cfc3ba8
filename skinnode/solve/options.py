"""Options of the trackers, with their defaults and checks in one place.

A constructor takes an options object, keyword arguments of the same names, or both; keywords win.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Final, TypedDict, TypeVar

from numpy.typing import ArrayLike

from skinnode.model.elastic import Rubber
from skinnode.solve.inputs import CodeMap

TRACKER_METHODS: Final = ("auto", "exact", "posterior")
DRIFTS: Final = ("none", "patch", "wire")


@dataclass(frozen=True, kw_only=True, eq=False)
class EstimateOptions:
    """Options that every tracker of a patch has.

    Args:
        relative_noise: A number or (U, K), standard deviation of R relative to R.
        baseline_ohm: (U, K) resistances measured at rest, ohm; the resistivity and gain then cancel.
        rubber: Material of the skin. Displacement does not depend on its modulus, forces are proportional to
            it.
        estimate_noise: Whether to set a factor on ``relative_noise`` from the data.
        drift: ``patch``: all resistances may be off by one common gain, ``wire``: by one gain for each upper
            wire, with a prior standard deviation of ``drift_std``; ``none``.
        drift_std: Prior standard deviation of a gain error, as a share.
        model_error: Share of the change of each resistance that the forward model may get wrong (thickness,
            size of the electrodes, conductivity under strain): in common, and 0.7 of it each on its own.
        normal_only: Whether only z is unknown, a third of the unknowns.
        hold: Whether to leave alone what has not changed beyond its noise.
        deadline_us: Time after which an update returns, and at most one step more, µs. What was not solved by
            then is DEADLINE.

    Raises:
        ValueError: If an option is out of its range.
    """

    relative_noise: ArrayLike = 1e-5
    baseline_ohm: ArrayLike | None = None
    rubber: Rubber | None = None
    estimate_noise: bool = False
    drift: str = "none"
    drift_std: float = 0.02
    model_error: float = 0.0
    normal_only: bool = False
    hold: bool = True
    deadline_us: float | None = None

    def __post_init__(self) -> None:
        if self.drift not in DRIFTS:
            raise ValueError(f"drift: got {self.drift!r}, must be one of {', '.join(DRIFTS)}")
        require_positive("drift_std", self.drift_std)
        if not (math.isfinite(self.model_error) and self.model_error >= 0):
            raise ValueError(f"model_error: got {self.model_error}, must be finite and at least 0")
        if self.deadline_us is not None:
            require_positive("deadline_us", self.deadline_us)

    @property
    def deadline_s(self) -> float:
        """``deadline_us`` in seconds, inf for none."""
        return math.inf if self.deadline_us is None else self.deadline_us * 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class PosteriorOptions(EstimateOptions):
    """Options of :class:`skinnode.Posterior`; those of :class:`EstimateOptions`, and two of its own.

    Args:
        scale_m: RMS normal displacement that the prior expects, metres; by default it is set from the data.
        contacts: Whether to estimate forces and contacts.

    Raises:
        ValueError: If an option is out of its range.
    """

    scale_m: float | None = None
    contacts: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scale_m is not None:
            require_positive("scale_m", self.scale_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackerOptions(EstimateOptions):
    """Options of :class:`skinnode.Tracker`; those of :class:`EstimateOptions`, and some of its own.

    ``auto`` takes the posterior if ``drift``, ``model_error`` or ``estimate_noise`` asks for what only it can
    give.

    Args:
        method: ``exact``, ``posterior`` or ``auto``.
        operator: ``levenberg_marquardt``, ``dogleg`` or ``gauss_newton``; only of the exact inverse.
        stiffness_n_per_m: k of the paper's law F = k Δs, N/m; only of the exact inverse, which gives no
            forces without it. The posterior's forces come from ``rubber``.
        active_only: Whether only the electrodes that contacts move are unknown; only of the exact inverse.
        codes: Meaning of the codes given to :meth:`skinnode.Tracker.update_codes`.

    Raises:
        ValueError: If an option is out of its range.
    """

    method: str = "auto"
    operator: str = "levenberg_marquardt"
    stiffness_n_per_m: float | None = None
    active_only: bool = False
    codes: CodeMap | None = None

    def __post_init__(self) -> None:
        if self.method not in TRACKER_METHODS:
            raise ValueError(f"method: got {self.method!r}, must be one of {', '.join(TRACKER_METHODS)}")
        super().__post_init__()

    def of_posterior(self) -> PosteriorOptions:
        """Return the options of the posterior of the same patch."""
        names = [field.name for field in dataclasses.fields(EstimateOptions)]
        return PosteriorOptions(**{name: getattr(self, name) for name in names})

    @property
    def nuisances(self) -> list[str]:
        """Names of the options asked for that only the posterior can give."""
        asked = {
            "drift": self.drift != "none",
            "model_error": self.model_error > 0,
            "estimate_noise": self.estimate_noise,
        }
        return [name for name, wanted in asked.items() if wanted]


class EstimateArguments(TypedDict, total=False):
    """Keyword arguments of every tracker, as in :class:`EstimateOptions`."""

    relative_noise: ArrayLike
    baseline_ohm: ArrayLike | None
    rubber: Rubber | None
    estimate_noise: bool
    drift: str
    drift_std: float
    model_error: float
    normal_only: bool
    hold: bool
    deadline_us: float | None


class PosteriorArguments(EstimateArguments, total=False):
    """Keyword arguments of :class:`skinnode.Posterior`, as in :class:`PosteriorOptions`."""

    scale_m: float | None
    contacts: bool


class TrackerArguments(EstimateArguments, total=False):
    """Keyword arguments of :class:`skinnode.Tracker`, as in :class:`TrackerOptions`."""

    method: str
    operator: str
    stiffness_n_per_m: float | None
    active_only: bool
    codes: CodeMap | None


_Options = TypeVar("_Options", PosteriorOptions, TrackerOptions)


def merged(kind: type[_Options], options: _Options | None, arguments: Any) -> _Options:
    """Return ``options``, or the defaults of ``kind``, with the keyword arguments in their place.

    Raises:
        TypeError: If there is no option of a name, or ``options`` is not of this kind.
        ValueError: If an option is out of its range.
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
        ValueError: If it is not.
    """
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name}: got {value}, must be positive and finite")
