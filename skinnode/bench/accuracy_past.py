"""Measures the benefit of earlier frames for the posterior, and their cost when the skin moves.

Each scene is one stream that contains all phases in :data:`PHASES`. The posterior solves the stream with and
without earlier frames (option ``past``), from the same readings. The truth comes from the families of
``skinnode bench accuracy --only families``: half of the rigid bodies press on the simulator's bonded layer.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinnode.bench import family_scenes
from skinnode.bench.accuracy_families import FAR, MOVED
from skinnode.bench.case import preset
from skinnode.bench.family_scenes import FAMILIES
from skinnode.bench.truth import Skin
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.solve.options import PASTS
from skinnode.solve.posterior.posterior import Posterior

LAYOUT: Final = ("staggered", 0.5)
SIGMAS: Final = (1e-4, 3e-4, 1e-3)
DEPTH: Final = (0.1, 0.3)
"""Minimum and maximum depth of a scene, in layer heights."""
COVERAGE_LEAST: Final = 0.92
FAR_MOST: Final = 1e-3
"""Maximum fraction of coordinates beyond :data:`FAR` standard deviations."""


@dataclass(frozen=True)
class Phase:
    """Part of a stream, during which the body moves from its last position to a new one."""

    name: str
    frames: int
    share: float
    """Depth at the end of the phase, divided by the full depth."""
    shift: float = 0.0
    """Distance from the initial position by the end of the phase, in pitches."""
    slowing: bool = False
    """Whether the motion slows down exponentially, as in creep; otherwise, its speed is constant."""


PHASES: Final = (
    Phase("rest", 2, 0.0),
    Phase("onset", 1, 0.85),
    Phase("hold", 26, 0.85),
    Phase("hold, frame 28", 1, 0.85),
    Phase("release", 1, 0.0),
    Phase("after release", 3, 0.0),
    Phase("slow press", 15, 0.85),
    Phase("slide", 12, 0.85, 1.0),
    Phase("creep", 12, 1.0, 1.0, slowing=True),
    Phase("slow release", 15, 0.3, 1.0),
    Phase("release", 1, 0.0, 1.0),
    Phase("after release", 2, 0.0, 1.0),
)
UNTOUCHED: Final = ("rest", "release", "after release")
"""Phases in which nothing touches the patch."""
STEPS: Final = 2
"""Number of parts into which a motion is divided. The displacement is computed at the end of each part and
interpolated linearly in between."""
CREEP: Final = 3.0
"""Duration of a phase that slows down, in time constants."""


@dataclass
class Sum:
    """Sums over the frames of a phase."""

    errors: list[float] = dataclasses.field(default_factory=list)
    """Relative errors of the frames with a touch."""
    inside: Float = dataclasses.field(default_factory=lambda: np.zeros(2))
    """Numbers of moved and resting coordinates within the 95 % interval."""
    count: Float = dataclasses.field(default_factory=lambda: np.zeros(2))
    """Numbers of moved and resting coordinates with a finite standard deviation."""
    far: int = 0
    """Number of coordinates beyond :data:`FAR` standard deviations."""
    worst: float = 0.0
    """Largest error, in standard deviations."""
    contacts: int = 0
    """Number of frames with contacts."""
    untrusted: int = 0
    frames: int = 0
    seconds: float = 0.0

    def add(self, field: FieldFrame, truth_m: Float, seconds: float) -> None:
        """Add a frame."""
        error, top = np.abs(field.displacement_m - truth_m), float(np.abs(truth_m).max())
        moved = np.abs(truth_m) >= MOVED * top if top > 0.0 else np.zeros(truth_m.shape, bool)
        known = np.isfinite(field.displacement_std_m)
        inside = known & (error <= field.half_width_95_m)
        deviations = error / field.displacement_std_m
        if top > 0.0:
            self.errors.append(float(np.linalg.norm(error) / np.linalg.norm(truth_m)))
        self.inside += [np.count_nonzero(inside & moved), np.count_nonzero(inside & ~moved)]
        self.count += [np.count_nonzero(known & moved), np.count_nonzero(known & ~moved)]
        self.far += int(np.count_nonzero(deviations > FAR))
        self.worst = max(self.worst, float(deviations.max()))
        self.contacts += bool(field.contacts)
        self.untrusted += not field.trusted
        self.frames += 1
        self.seconds += seconds

    def row(self) -> dict[str, Any]:
        """Return the statistics."""
        with np.errstate(invalid="ignore"):
            coverage, both = self.inside / self.count, self.inside.sum() / self.count.sum()
        return {
            "error": float(np.median(self.errors)) if self.errors else math.nan,
            "coverage": float(both),
            "coverage_moved": float(coverage[0]),
            "coverage_rest": float(coverage[1]),
            "far": self.far / max(float(self.count.sum()), 1.0),
            "worst": self.worst,
            "contacts": self.contacts / self.frames,
            "untrusted": self.untrusted / self.frames,
            "frames": self.frames,
            "ms": 1e3 * self.seconds / self.frames,
        }


def truth(
    family: str, skin: Skin, number: int, phases: tuple[Phase, ...] = PHASES
) -> list[tuple[str, Float]]:
    """Return the phase and the (U, N, 3) true displacement, in metres, for each frame of a scene.

    Args:
        family: One of :data:`FAMILIES`.
        skin: Patch to press.
        number: Number of the scene. In odd-numbered scenes, rigid bodies press on a bonded layer.
        phases: Parts of the stream.
    """
    seed = [number, FAMILIES.index(family)]
    rng = np.random.default_rng([*seed, 1])
    depth, angle = rng.uniform(*DEPTH), rng.uniform(0.0, 2.0 * np.pi)
    known: dict[tuple[float, float], Float] = {}

    def at(share: float, shift: float) -> Float:
        if share == 0.0:
            return np.zeros(skin.layout.upper_m.shape)
        found = known.get((share, shift))
        if found is None:
            far = shift * skin.layout.pitch_m
            found = known[share, shift] = family_scenes.draw(
                family, skin, np.random.default_rng(seed), bonded=number % 2 == 1, depth=depth * share,
                shift_m=(far * math.cos(angle), far * math.sin(angle)),
            ).truth_m  # fmt: skip
        return found

    frames, share, shift = [], 0.0, 0.0
    for phase in phases:
        way = np.linspace(0.0, 1.0, STEPS + 1)
        still = phase.frames == 1 or (phase.share, phase.shift) == (share, shift)
        knots = [
            at(phase.share, phase.shift)
            if still
            else at(share + part * (phase.share - share), shift + part * (phase.shift - shift))
            for part in way
        ]
        for frame in range(phase.frames):
            part = (frame + 1) / phase.frames
            if phase.slowing:
                part = math.expm1(-CREEP * part) / math.expm1(-CREEP)
            left = min(int(part * STEPS), STEPS - 1)
            between = part * STEPS - left
            frames.append((phase.name, knots[left] + between * (knots[left + 1] - knots[left])))
        share, shift = phase.share, phase.shift
    return frames


def run(scenes: int, prior: str = "cells", echo: Callable[[str], object] = lambda _: None) -> dict[str, Any]:
    """Solve the streams with and without earlier frames.

    Args:
        scenes: Number of scenes per family; each is solved at every noise level.
        prior: Load prior, one of :data:`skinnode.solve.options.PRIORS`.
        echo: Function that prints a progress line.

    Returns:
        One row per noise level, option and phase, and one row per noise level and option over all phases.
    """
    skin = Skin(preset(*LAYOUT))
    solvers = {
        (sigma, past): Posterior(
            skin.layout, relative_noise=sigma, baseline_ohm=skin.rest_ohm, follow_noise=False, prior=prior,
            past=past,
        )
        for sigma in SIGMAS
        for past in PASTS
    }  # fmt: skip
    names = [*dict.fromkeys(phase.name for phase in PHASES), "all"]
    sums = {(*case, name): Sum() for case in solvers for name in names}
    for number in range(scenes):
        for family in FAMILIES:
            echo(f"scene {number + 1} of {scenes}: {family}")
            frames = truth(family, skin, number)
            true_ohm = [skin.resistance_ohm(moved) for _, moved in frames]
            for (sigma, past), solver in solvers.items():
                rng = np.random.default_rng([number, FAMILIES.index(family), 2])
                solver.reset()
                for (name, moved), ohm in zip(frames, true_ohm, strict=True):
                    reading = ohm * (1.0 + sigma * rng.standard_normal(ohm.shape))
                    start = time.process_time()
                    field = solver.update(reading)
                    seconds = time.process_time() - start
                    for of in (name, "all"):
                        sums[sigma, past, of].add(field, moved, seconds)
    rows = [
        {"sigma": sigma, "past": past, "phase": name} | each.row()
        for (sigma, past, name), each in sums.items()
    ]
    return {"prior": prior, "past": rows}


def requirements(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per requirement: name, value, limit as text, and whether the limit is met."""
    rows = {(row["sigma"], row["past"], row["phase"]): row for row in figures["past"]}
    found = []
    for sigma in SIGMAS:
        own, without = rows[sigma, "auto", "all"], rows[sigma, "off", "all"]
        release = rows[sigma, "auto", "release"]["worst"]
        limit = max(FAR_MOST, without["far"])
        held = rows[sigma, "auto", "hold, frame 28"]["error"] / rows[sigma, "off", "hold, frame 28"]["error"]
        found += [
            _must(f"coverage, {sigma:.0e}", own["coverage"], f"at least {COVERAGE_LEAST:g}",
                  own["coverage"] >= COVERAGE_LEAST),
            _must(f"coordinates beyond {FAR:g} deviations, {sigma:.0e}", own["far"], f"at most {limit:.1e}",
                  own["far"] <= limit),
            _must(f"worst error in the frame of a release, {sigma:.0e}", release, f"at most {FAR:g}",
                  release <= FAR),
            _must(f"held error, with / without earlier frames, {sigma:.0e}", held, "at most 1",
                  held <= 1.0),
        ]  # fmt: skip
    return found


def _must(what: str, value: float, limit: str, reached: bool) -> dict[str, Any]:
    return {"what": what, "value": value, "limit": limit, "reached": bool(reached), "absolute": False}


_COLUMNS: Final = (
    ("error", "error", 8, ".1%"), ("coverage", "in 95 %", 9, ".1%"), ("coverage_moved", "moved", 8, ".1%"),
    ("coverage_rest", "rest", 8, ".1%"), ("far", ">5 dev.", 9, ".1e"), ("worst", "worst", 7, ".1f"),
    ("contacts", "contacts", 10, ".0%"), ("untrusted", "untrusted", 11, ".1%"), ("frames", "frames", 8, "d"),
    ("ms", "ms", 7, ".2f"),
)  # fmt: skip


def print_all(figures: dict[str, Any], echo: Callable[[str], object]) -> None:
    """Print the table."""
    echo(f"\nstreams with (auto) and without (off) earlier frames, prior {figures['prior']}, median errors")
    head = "".join(title.rjust(width) for _, title, width, _ in _COLUMNS)
    echo(f"  {'noise, past, phase':34}{head}")
    for row in figures["past"]:
        cells = "".join(
            ("-" if row[name] is None else format(row[name], form)).rjust(width)
            for name, _, width, form in _COLUMNS
        )
        where = f"{row['sigma']:.0e} {row['past']:5}{row['phase']}"
        echo(f"  {where:34}{cells}")
