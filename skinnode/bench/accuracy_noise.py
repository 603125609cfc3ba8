"""Measures how noise, code width and layout affect the error, and checks the standard deviations.

Each scene consists of four frames, which a tracker solves in sequence from rest. Only the last frame is
scored. Errors and standard deviations are RMS values over the coordinates of all converged wires in all
scenes, divided by the RMS displacement.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from skinnode.bench import methods
from skinnode.bench.case import Case, preset
from skinnode.bench.score import bound_std_m
from skinnode.bench.truth import Converter, Press, Skin, Stream, random_press, stream
from skinnode.model.frames import Z_95_TWO_SIDED, FieldFrame
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.solve.posterior.load_prior import PRIOR_DOUBT, SMOOTH_SHARE

METHODS: Final = ("exact", "posterior")
SIGMAS: Final = (1e-6, 4e-6, 1e-5, 1e-4, 1e-3, 1e-2)
BITS: Final = (12, 14, 16, 24)
LAYOUTS: Final = tuple((kind, height) for kind in ("staggered", "aligned") for height in (0.3, 0.5, 1.0))
PRIOR_SHARES: Final = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
FEWEST: Final = 1000
"""Minimum number of coordinates needed to estimate a 99.9 % quantile."""
SHARES: Final = np.array([0.0, 1 / 3, 2 / 3, 1.0])

PROTOTYPE: Final = {
    ("staggered", 0.3): {
        "exact": {1e-5: 0.02},
        "posterior": {4e-6: 0.007, 1e-5: 0.015, 1e-4: 0.09, 1e-3: 0.30},
    },
    ("staggered", 0.5): {
        "exact": {1e-5: 0.03},
        "posterior": {4e-6: 0.009, 1e-5: 0.022, 1e-4: 0.10, 1e-3: 0.29},
    },
    ("aligned", 0.5): {"exact": {1e-5: 2.71}, "posterior": {4e-6: 0.05, 1e-5: 0.06, 1e-4: 0.20, 1e-3: 0.38}},
    ("aligned", 1.0): {"exact": {1e-5: 73.0}, "posterior": {4e-6: 0.14, 1e-5: 0.18, 1e-4: 0.24, 1e-3: 0.38}},
}
"""RMS errors of the prototype solver, as fractions of the RMS displacement, for a sheared 10 % press by one
approximately Hertzian indenter."""


@dataclass
class Pool:
    """Accumulates the errors and standard deviations of many scenes."""

    scenes: int = 0
    wires: int = 0
    converged: int = 0
    covered: int = 0
    coordinates: int = 0
    _error: float = 0.0
    _variance: float = 0.0
    _size: float = 0.0

    def add(self, frame: FieldFrame, truth_m: Float) -> None:
        """Add a scene's last frame and its (U, N, 3) true displacement ``truth_m``."""
        used = np.array([status is Status.CONVERGED for status in frame.status])
        error, std = (frame.displacement_m - truth_m)[used], frame.displacement_std_m[used]
        self.scenes += 1
        self.wires += used.size
        self.converged += int(used.sum())
        self.covered += int((np.abs(error) <= frame.half_width_95_m[used]).sum())
        self.coordinates += error.size
        self._error += float((error**2).sum())
        self._variance += float((std**2).sum())
        self._size += float((truth_m[used] ** 2).sum())

    def row(self) -> dict[str, Any]:
        """Return the statistics of all added scenes; the error is NaN if no wire converged."""
        size = self._size or math.nan
        return {
            "scenes": self.scenes,
            "converged": self.converged / self.wires,
            "error": math.sqrt(self._error / size),
            "reported": math.sqrt(self._variance / size),
            "ratio": math.sqrt(self._error / (self._variance or math.nan)),
            "coverage": self.covered / (self.coordinates or math.nan),
        }


@dataclass
class Parts:
    """Compares the posterior's errors with its variance n + b, where n is due to noise and b to the prior."""

    _error: list[Float] = field(default_factory=list)
    _noise: list[Float] = field(default_factory=list)
    _left: list[Float] = field(default_factory=list)

    def add(self, frame: FieldFrame, truth_m: Float) -> None:
        """Add a scene, unless all wires are held; ``truth_m``: (U, N, 3) true displacement, in metres."""
        if frame.core_std_m is None or (frame.held is not None and frame.held.all()):
            return
        used = np.array([status is Status.CONVERGED for status in frame.status])
        wide, core = frame.displacement_std_m[used] ** 2, frame.core_std_m[used] ** 2
        left = (wide - core) / (PRIOR_DOUBT - SMOOTH_SHARE)
        self._error.append(np.abs(frame.displacement_m - truth_m)[used].ravel())
        self._noise.append((wide - PRIOR_DOUBT * left).ravel())
        self._left.append(left.ravel())

    def rows(self) -> list[dict[str, Any]]:
        """Return a row of statistics for each interval of b / (n + b), the prior's share of the variance.

        A row contains the RMS, the quantiles and the kurtosis of error / √(n + b), the RMS that noise alone
        would cause, and the ratio of the observed to the predicted variance due to the prior.
        """
        if not self._error:
            return []
        error, noise, left = (np.concatenate(each) for each in (self._error, self._noise, self._left))
        share, z = left / (noise + left), error / np.sqrt(noise + left)
        found = []
        for low, high in itertools.pairwise(PRIOR_SHARES):
            chosen = (share >= low) & (share < high)
            if np.count_nonzero(chosen) >= FEWEST:
                square, own = z[chosen] ** 2, share[chosen]
                found.append(
                    {"from": low, "to": high, "coordinates": int(chosen.sum())}
                    | {"rms": float(np.sqrt(square.mean())), "by_noise": float(np.sqrt(1.0 - own.mean()))}
                    | {"in_errors": float((square - 1.0 + own).mean() / own.mean())}
                    | {f"q{at}": float(np.quantile(z[chosen], at / 1000)) for at in (950, 999)}
                    | {"kurtosis": float((square**2).mean() / square.mean() ** 2)}
                )
        return found


@dataclass
class Bound:
    """Accumulates the Cramér-Rao bounds of wires at their true positions, computed without a prior."""

    _variance: float = 0.0
    _size: float = 0.0

    def add(self, layout: PatchLayout, taken: Stream) -> None:
        """Add the bound for the last frame of a stream."""
        truth = taken.truth_m[-1]
        std = bound_std_m(layout, layout.upper_m + truth, taken.noise[-1])
        self._variance += float((std**2).sum())
        self._size += float((truth**2).sum())

    @property
    def share(self) -> float:
        """RMS Cramér-Rao bound divided by the RMS displacement."""
        return math.sqrt(self._variance / self._size)


@dataclass
class Forces:
    """Compares each field's contacts, forces and centroids with the true loads.

    Force errors are relative to the true normal force. Centroid errors are in metres. Scenes in which the
    solver found no contact are omitted.
    """

    found_right: int = 0
    found_none: int = 0
    scenes: int = 0
    _normal: list[tuple[float, float, float]] = field(default_factory=list)
    _shear: list[tuple[float, float, float]] = field(default_factory=list)
    _place: list[tuple[float, float]] = field(default_factory=list)

    def add(self, frame: FieldFrame, taken: Stream) -> None:
        """Add the contacts in the last frame of a stream."""
        contacts, truth = frame.contacts, taken.force_n[-1]
        self.scenes += 1
        self.found_right += len(contacts) == len(taken.presses)
        if not contacts:
            self.found_none += 1
            return
        normal = sum(contact.normal_force_n for contact in contacts)
        normal_std = math.sqrt(sum(contact.normal_force_std_n**2 for contact in contacts))
        self._normal.append((normal + truth[2], normal_std, -truth[2]))
        for axis in range(2):
            shear = sum(float(contact.shear_force_n[axis]) for contact in contacts)
            std = math.sqrt(sum(float(contact.shear_force_std_n[axis]) ** 2 for contact in contacts))
            self._shear.append((shear - truth[axis], std, -truth[2]))
        if len(contacts) == len(taken.presses) == 1:
            for axis in range(2):
                off = contacts[0].centroid_m[axis] - taken.presses[0].center_m[axis]
                self._place.append((float(off), float(contacts[0].centroid_std_m[axis])))

    def row(self) -> dict[str, Any]:
        """Return RMS errors, RMS standard deviations, and the coverage of the 95 % intervals."""
        figures: dict[str, Any] = {
            "contacts_right": self.found_right / self.scenes,
            "contacts_none": self.found_none / self.scenes,
        }
        for name, values in (("normal", self._normal), ("shear", self._shear)):
            if not values:
                continue
            error, std, size = np.array(values).T
            figures[f"{name}_error"] = float(np.sqrt(np.mean((error / size) ** 2)))
            figures[f"{name}_reported"] = float(np.sqrt(np.mean((std / size) ** 2)))
            figures[f"{name}_coverage"] = float(np.mean(np.abs(error) <= Z_95_TWO_SIDED * std))
        if self._place:
            off, std = np.array(self._place).T
            figures["centroid_error_m"] = float(np.sqrt(np.mean(off**2)))
            figures["centroid_reported_m"] = float(np.sqrt(np.mean(std**2)))
            figures["centroid_coverage"] = float(np.mean(np.abs(off) <= Z_95_TWO_SIDED * std))
        return figures


def _case(kind: str, height: float) -> Case:
    def never(rng: np.random.Generator) -> Stream:
        raise RuntimeError("this case cannot generate a stream; use only its skin")

    return Case(0, f"{kind} h={height:g}", Skin(preset(kind, height)), never)


class Follower:
    """Solves the streams of one layout with every method."""

    def __init__(self, kind: str, height: float) -> None:
        self.case = _case(kind, height)
        self._solvers = {name: methods.solver_of(self.case, name) for name in METHODS}

    def last(self, taken: Stream) -> dict[str, FieldFrame]:
        """Solve a stream with each method; return the last frame's fields, keyed by method."""
        return {
            name: methods.fields(self.case, name, solver, taken)[-1] for name, solver in self._solvers.items()
        }


def _streams(case: Case, converter: Converter, scenes: int) -> Iterable[Stream]:
    """Yield streams of random 10 % presses, which depend only on the seed and the size of the layout."""
    for seed in range(scenes):
        rng = np.random.default_rng([seed, 10])
        press = pad_press(rng, case.skin.layout, 0.1)
        yield stream(case.skin, (press,), SHARES, converter, rng)


def pad_press(rng: np.random.Generator, layout: PatchLayout, depth: float) -> Press:
    """Return a random press by a fingertip-sized body whose contact radius is 1.5 to 2.5 pitches.

    The prototype's presses had the same Cramér-Rao bounds, so the errors are comparable with
    :data:`PROTOTYPE`.
    """
    press = random_press(rng, layout, depth)
    contact = rng.uniform(1.5, 2.5) * layout.pitch_m
    return dataclasses.replace(press, radius_m=float(contact**2 / press.depth_m))


def against_noise(scenes: int) -> list[dict[str, Any]]:
    """Solve noisy 10 % presses; return one row per layout, noise level and method."""
    rows = []
    for kind, height in LAYOUTS:
        follower = Follower(kind, height)
        for sigma in SIGMAS:
            pools: dict[str, Pool] = {name: Pool() for name in METHODS}
            bound = Bound()
            for taken in _streams(follower.case, Converter(sigma=sigma), scenes):
                for name, frame in follower.last(taken).items():
                    pools[name].add(frame, taken.truth_m[-1])
                bound.add(follower.case.skin.layout, taken)
            for name, pool in pools.items():
                printed = PROTOTYPE.get((kind, height), {}).get(name, {}).get(sigma)
                rows.append(
                    {"layout": kind, "height": height, "sigma": sigma, "method": name, **pool.row()}
                    | {"bound": bound.share, "prototype": printed}
                )
    return rows


def against_codes(scenes: int) -> list[dict[str, Any]]:
    """Solve quantised, noise-free 10 % presses; return one row per layout, code width and method."""
    rows = []
    for kind in ("staggered", "aligned"):
        follower = Follower(kind, 0.5)
        for bits in BITS:
            pools = {name: Pool() for name in METHODS}
            for taken in _streams(follower.case, Converter(bits=bits), scenes):
                for name, frame in follower.last(taken).items():
                    pools[name].add(frame, taken.truth_m[-1])
            rows += [
                {"layout": kind, "height": 0.5, "bits": bits, "method": name, **pool.row()}
                for name, pool in pools.items()
            ]
    return rows


COVERAGE: Final = (
    ("staggered", 0.5, 1e-5),
    ("staggered", 0.5, 1e-3),
    ("staggered", 1.0, 1e-5),
    ("aligned", 0.5, 1e-5),
)


def _random_scene(rng: np.random.Generator, layout: PatchLayout) -> tuple[Press, ...]:
    """Return one press in each half of the patch (30 % of scenes), or a single sharp or blunt press."""
    depth = rng.uniform(0.05, 0.3, 2)
    if rng.random() >= 0.3:
        if rng.random() < 0.5:
            return (pad_press(rng, layout, depth[0]),)
        return (random_press(rng, layout, depth[0], margin=0.5),)
    middle = float(layout.upper_m[..., 0].mean())
    away = rng.uniform(2.5, 4.0, 2) * layout.pitch_m
    return tuple(
        dataclasses.replace(press, center_m=(middle + side, press.center_m[1]))
        for side, press in zip(
            (-away[0], away[1]),
            (random_press(rng, layout, each, radius=(1.0, 2.0)) for each in depth),
            strict=True,
        )
    )


def coverage(scenes: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Solve random scenes with both methods.

    Returns:
        One row per layout, noise level and method, with force errors for the ``posterior`` method; also the
        rows of :class:`Parts` for the posterior's errors in all scenes.
    """
    rows, parts = [], Parts()
    for kind, height, sigma in COVERAGE:
        follower = Follower(kind, height)
        skin = follower.case.skin
        pools, forces = {name: Pool() for name in METHODS}, Forces()
        for seed in range(scenes):
            rng = np.random.default_rng([seed, 11])
            taken = stream(skin, _random_scene(rng, skin.layout), SHARES, Converter(sigma=sigma), rng)
            for name, frame in follower.last(taken).items():
                pools[name].add(frame, taken.truth_m[-1])
                if name == "posterior":
                    forces.add(frame, taken)
                    parts.add(frame, taken.truth_m[-1])
        for name, pool in pools.items():
            row = {"layout": kind, "height": height, "sigma": sigma, "method": name, **pool.row()}
            rows.append(row | (forces.row() if name == "posterior" else {}))
    return rows, parts.rows()
