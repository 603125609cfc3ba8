"""Measures the errors for a moving skin whose upper wires are sampled sequentially.

In each scene, a rigid body of the simulator is pressed into a bonded layer, held, moved along the skin, held
again and released, all at one speed. The simulated patch samples its upper wires sequentially. The true field
is the field at the moment the first upper wire is sampled. A tracker's fields are evaluated with and without
the correction that the option ``row_time_s`` applies.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinnode.bench import family_scenes
from skinnode.bench.accuracy_families import FAR
from skinnode.bench.case import preset
from skinnode.bench.family_scenes import BONDED, FAMILIES
from skinnode.bench.truth import Skin
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.solve.skew.scan_skew import ScanSkew
from skinnode.solve.tracker import Tracker
from vcan_sim.skin.imperfections import Imperfections
from vcan_sim.skin.patch import PhysicalPatch
from vcan_sim.smooth import glide

LAYOUT: Final = ("staggered", 0.5)
SIGMAS: Final = (1e-5, 1e-4, 1e-3)
METHODS: Final = ("exact", "posterior")
TIMES_S: Final = ((0.08, 1e-4), (0.08, 1e-3), (0.08, 3e-3), (0.02, 1e-4), (0.02, 1e-3))
"""Scan periods and row times, in s. Ten upper wires at a row time of 3 ms need more than 20 ms."""
SPEEDS_M_S: Final = (1e-3, 1e-2, 5e-2)
"""Mean speeds of a press or slide, in m/s."""
DEPTH: Final = 0.3
"""Depth of a press, in layer heights."""
FARTHEST: Final = 1.0
"""Maximum length of a slide, in pitches."""
SLIDE_S: Final = 0.4
"""Maximum duration of a slide, in s."""
HELD: Final = 4
"""Number of scans before, between and after the motions."""
KNOTS: Final = 9
"""Number of positions at which the contact is computed during a motion; it is interpolated in between."""
FAR_MOST: Final = 1e-3
"""Maximum fraction of coordinates beyond :data:`FAR` standard deviations."""
RATIO_MOST: Final = 1.02
"""Maximum ratio of the RMS errors with and without the correction."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Press, slide and release of a body, as a function of time."""

    upper_m: Float
    """(U, N, 3), m: electrodes at rest."""
    parts: tuple[tuple[float, float, Callable[[float], Float]], ...]
    """Start and end (s) of each motion, and displacement (m) as a function of its progress from 0 to 1."""

    def at(self, t_s: float) -> Float:
        """Return the (U, N, 3) electrode positions in metres; at rest, the array :attr:`upper_m` itself."""
        if not self.parts[0][0] < t_s < self.parts[-1][1]:
            return self.upper_m
        start, end, moved_m = [part for part in self.parts if part[0] < t_s][-1]
        return np.asarray(self.upper_m + moved_m(glide((t_s - start) / (end - start))))

    def moves(self, since_s: float, until_s: float) -> bool:
        """Return whether the body moves during an interval."""
        return any(start < until_s and since_s < end for start, end, _ in self.parts)


@functools.lru_cache(maxsize=64)
def _path(family: str, number: int, skin: Skin, ends: tuple[tuple[float, float], tuple[float, float]]) -> Any:
    """Return a function for the displacement (m) along a straight path between two depths and shifts."""
    from scipy.interpolate import PchipInterpolator

    seed = [number, FAMILIES.index(family)]
    angle = np.random.default_rng([*seed, 1]).uniform(0.0, 2.0 * np.pi)

    def moved_m(share: float, shift: float) -> Float:
        if share == 0.0:
            return np.zeros(skin.layout.upper_m.shape)
        far = shift * skin.layout.pitch_m
        return family_scenes.draw(
            family, skin, np.random.default_rng(seed), bonded=True, depth=DEPTH * share,
            shift_m=(far * math.cos(angle), far * math.sin(angle)),
        ).truth_m  # fmt: skip

    way = np.linspace(0.0, 1.0, KNOTS)
    start, end = (np.array(each) for each in ends)
    return PchipInterpolator(way, np.stack([moved_m(*(start + part * (end - start))) for part in way]))


def motion(family: str, number: int, skin: Skin, speed_m_s: float, period_s: float) -> Motion:
    """Return the motion of a scene.

    Args:
        family: One of :data:`skinnode.bench.family_scenes.BONDED`.
        number: Number of the scene.
        skin: Patch to press.
        speed_m_s: Mean speed of each part of the motion, in m/s.
        period_s: Scan period, in s.
    """
    far = min(FARTHEST, SLIDE_S * speed_m_s / skin.layout.pitch_m)
    press_s = DEPTH * skin.layout.height_m / speed_m_s
    rng = np.random.default_rng([number, FAMILIES.index(family), 3])
    parts: list[tuple[float, float, Callable[[float], Float]]] = []
    at_s = 0.0
    for ends, lasts_s in (
        (((0.0, 0.0), (1.0, 0.0)), press_s),
        (((1.0, 0.0), (1.0, far)), far * skin.layout.pitch_m / speed_m_s),
        (((1.0, far), (0.0, far)), press_s),
    ):
        start_s = at_s + (HELD + rng.uniform()) * period_s
        at_s = start_s + lasts_s
        parts.append((start_s, at_s, _path(family, number, skin, ends)))
    return Motion(skin.layout.upper_m, tuple(parts))


@dataclass
class Sum:
    """Sums over the frames of one method, with or without the correction."""

    errors: list[float] = dataclasses.field(default_factory=list)
    """Relative errors of the frames in which the body moves or has moved since the previous frame."""
    claims: list[float] = dataclasses.field(default_factory=list)
    """RMS standard deviations of these frames, relative to the RMS displacement."""
    squares_m2: list[float] = dataclasses.field(default_factory=list)
    """Mean square errors of these frames, in m²."""
    far: int = 0
    """Number of coordinates beyond :data:`FAR` standard deviations."""
    inside: int = 0
    """Number of coordinates within the 95 % interval."""
    count: int = 0
    untrusted: int = 0
    frames: int = 0
    seconds: float = 0.0
    """CPU time of the correction, in s."""

    def add(self, field: FieldFrame, truth_m: Float, moves: bool, seconds: float) -> None:
        """Add a frame."""
        error, size = np.abs(field.displacement_m - truth_m), float(np.linalg.norm(truth_m))
        if moves and size > 0.0:
            self.errors.append(float(np.linalg.norm(error)) / size)
            self.claims.append(float(np.linalg.norm(field.displacement_std_m)) / size)
            self.squares_m2.append(float(np.mean(error**2)))
        self.far += int(np.count_nonzero(error > FAR * field.displacement_std_m))
        self.inside += int(np.count_nonzero(error <= field.half_width_95_m))
        self.count += error.size
        self.untrusted += not field.trusted
        self.frames += 1
        self.seconds += seconds

    def row(self) -> dict[str, Any]:
        """Return the statistics."""
        return {
            "error": float(np.median(self.errors)) if self.errors else math.nan,
            "claim": float(np.median(self.claims)) if self.claims else math.nan,
            "rms_m": math.sqrt(np.mean(self.squares_m2)) if self.squares_m2 else math.nan,
            "far": self.far / self.count,
            "coverage": self.inside / self.count,
            "untrusted": self.untrusted / self.frames,
            "frames": self.frames,
            "ms": 1e3 * self.seconds / self.frames,
        }


def run(scenes: int, echo: Callable[[str], object] = lambda _: None) -> dict[str, Any]:
    """Solve the scenes, and evaluate the fields with and without the correction.

    Args:
        scenes: Number of scenes; the families alternate.
        echo: Function that prints a progress line.

    Returns:
        One row per method, noise level, scan period, row time and speed, and one row for all speeds combined.
    """
    skin = Skin(preset(*LAYOUT))
    solvers = {
        (method, sigma, period_s): Tracker(
            skin.layout, method=method, relative_noise=sigma, baseline_ohm=skin.rest_ohm, follow_noise=False,
            scan_period_s=period_s,
        )
        for method in METHODS
        for sigma in SIGMAS
        for period_s in dict.fromkeys(period_s for period_s, _ in TIMES_S)
    }  # fmt: skip
    sums: dict[tuple[Any, ...], Sum] = {}
    for period_s, row_s in TIMES_S:
        for number, speed in itertools.product(range(scenes), SPEEDS_M_S):
            family = BONDED[number % len(BONDED)]
            times = f"{1e3 * period_s:g} ms, rows {1e3 * row_s:g} ms"
            echo(f"{times}, {1e3 * speed:g} mm/s: {family} {number}")
            scans = _scans(motion(family, number, skin, speed, period_s), skin, period_s, row_s)
            for method, sigma in itertools.product(METHODS, SIGMAS):
                where = method, sigma, period_s, row_s
                found = [
                    [sums.setdefault((*where, of, corrected), Sum()) for corrected in (False, True)]
                    for of in (speed, None)
                ]
                noise = np.random.default_rng([number, 2])
                _solve(solvers[method, sigma, period_s], row_s, scans, sigma, noise, found)
    names = ("method", "sigma", "period_s", "row_s", "speed_m_s", "corrected")
    return {"skew": [dict(zip(names, key, strict=True)) | each.row() for key, each in sums.items()]}


@dataclass(frozen=True, eq=False)
class Scan:
    """Scan of a moving skin."""

    ohm: Float
    """(U, K), ohm: resistances, with each upper wire sampled at its own time."""
    truth_m: Float
    """(U, N, 3), m: displacement when the first upper wire is sampled."""
    moves: bool
    """Whether the body moves during this scan or has moved since the previous scan."""


def _scans(body: Motion, skin: Skin, period_s: float, row_s: float) -> list[Scan]:
    """Return the scans of a scene, without noise."""
    patch = PhysicalPatch(skin.layout, Imperfections(row_time_s=row_s))
    lasts_s = skin.layout.shape[0] * row_s
    return [
        Scan(
            patch.analogue_ohm(t_s, body.at),
            body.at(t_s) - skin.layout.upper_m,
            body.moves(t_s - period_s, t_s + lasts_s),
        )
        for t_s in np.arange(0.0, body.parts[-1][1] + HELD * period_s, period_s).tolist()
    ]


def _solve(  # noqa: PLR0913 - solver, scans and sums by name
    solver: Tracker,
    row_s: float,
    scans: list[Scan],
    sigma: float,
    noise: np.random.Generator,
    found: list[list[Sum]],
) -> None:
    """Solve the scans and add the fields, with and without the correction, to the sums.

    A tracker with the option ``row_time_s`` applies the same correction to the same fields.
    """
    solver.reset()
    skew = ScanSkew(solver.layout, row_s, solver.options.scan_period_s)
    for scan in scans:
        raw = solver.update(scan.ohm * (1.0 + sigma * noise.standard_normal(scan.ohm.shape)))
        start = time.process_time()
        corrected = skew.at_first_wire(raw, None)
        seconds = time.process_time() - start
        for without, with_it in found:
            without.add(raw, scan.truth_m, scan.moves, 0.0)
            with_it.add(corrected, scan.truth_m, scan.moves, seconds)


def requirements(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per requirement: name, value, limit as text, and whether the limit is met."""
    found = []
    for without, row in _pairs(figures["skew"]):
        if row["speed_m_s"] is not None:
            continue
        where = f"{row['method']}, {row['sigma']:.0e}, {_times(row)}"
        ratio = row["rms_m"] / without["rms_m"]
        found += [
            _must(f"coordinates beyond {FAR:g} deviations, {where}", row["far"], f"at most {FAR_MOST:.0e}",
                  row["far"] <= FAR_MOST),
            _must(f"RMS error, with / without correction, {where}", ratio, f"at most {RATIO_MOST:g}",
                  ratio <= RATIO_MOST),
        ]  # fmt: skip
    return found


def _must(what: str, value: float, limit: str, reached: bool) -> dict[str, Any]:
    return {"what": what, "value": value, "limit": limit, "reached": bool(reached), "absolute": False}


def _pairs(rows: list[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return pairs of corresponding rows: one without and one with the correction."""
    names = ("method", "sigma", "period_s", "row_s", "speed_m_s")
    corrected = {tuple(row[name] for name in names): row for row in rows if row["corrected"]}
    return [(row, corrected[tuple(row[name] for name in names)]) for row in rows if not row["corrected"]]


def _times(row: dict[str, Any]) -> str:
    return f"{1e3 * row['period_s']:g}/{1e3 * row['row_s']:g} ms"


_COLUMNS: Final = (
    ("error", "error", 8, ".1%"), ("claim", "claim", 8, ".1%"), ("rms_m", "RMS m", 9, ".1e"),
    ("far", ">5 dev.", 9, ".1e"), ("coverage", "in 95 %", 9, ".1%"), ("untrusted", "untrusted", 11, ".1%"),
    ("ms", "own ms", 8, ".3f"),
)  # fmt: skip


def print_all(figures: dict[str, Any], echo: Callable[[str], object]) -> None:
    """Print the table."""
    echo("\nscan skew: without and with correction; errors: medians of the frames in which the body moves")
    head = "".join(title.rjust(width) for _, title, width, _ in _COLUMNS)
    echo(f"  {'method, noise, period/row time, speed':46}{head}{'frames':>8}")
    for pair in _pairs(figures["skew"]):
        for row in pair:
            cells = "".join(
                ("-" if row[name] is None else format(row[name], form)).rjust(width)
                for name, _, width, form in _COLUMNS
            )
            speed = "all" if row["speed_m_s"] is None else f"{1e3 * row['speed_m_s']:g} mm/s"
            where = f"{row['method']:10}{row['sigma']:.0e} {_times(row):12}{speed:8}"
            echo(f"  {where:37}{'with' if row['corrected'] else 'without':9}{cells}{row['frames']:8}")
