"""Compares methods of solving a frame by error and CPU time, with a Pareto front for each noise level.

In each stream, a body is pressed in, held still, slid and slowly released. The truth comes from the families
of ``skinnode bench accuracy --only families``; half of the rigid bodies press on a bonded layer of the
simulator. Each method solves the same readings. Frames in which the body is held are counted separately from
those in which it moves, because a held field costs little and a held body gains most from earlier frames.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from skinnode.bench import accuracy_past
from skinnode.bench.accuracy_past import LAYOUT, Phase, Sum
from skinnode.bench.case import preset
from skinnode.bench.family_scenes import FAMILIES
from skinnode.bench.truth import Skin
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.tracker import Tracker

METHODS: Final[dict[str, dict[str, Any] | None]] = {
    "exact": None,
    "cells": {"prior": "cells", "past": "off"},
    "cells, past": {"prior": "cells", "past": "auto"},
    "discs": {"prior": "discs", "past": "off"},
    "discs, past": {"prior": "discs", "past": "auto"},
}
"""Options of the posterior for each method; None for the exact inverse."""
SIGMAS: Final = (1e-5, 1e-4, 1e-3)
PHASES: Final = (
    Phase("rest", 2, 0.0),
    Phase("onset", 1, 0.85),
    Phase("hold", 27, 0.85),
    Phase("slide", 12, 0.85, 1.0),
    Phase("slow release", 15, 0.3, 1.0),
)
MOTIONS: Final = {"held": ("hold",), "moving": ("slide", "slow release")}
"""Phases in which a body is held or moves. Frames at rest and the first frame of a touch are not counted."""
COVERAGE_LEAST: Final = 0.92


def run(scenes: int, echo: Callable[[str], object] = lambda _: None) -> dict[str, Any]:
    """Solve the streams with each method.

    Args:
        scenes: Number of scenes per family; each is solved at every noise level.
        echo: Function that prints a progress line.

    Returns:
        One row per noise level, motion, method and family, including the family ``all``.
    """
    skin = Skin(preset(*LAYOUT))
    solvers = {(sigma, method): _solver(skin, sigma, method) for sigma in SIGMAS for method in METHODS}
    sums = {
        (sigma, motion, method, family): Sum()
        for (sigma, method) in solvers
        for motion in MOTIONS
        for family in (*FAMILIES, "all")
    }
    motion_of = {phase: motion for motion, phases in MOTIONS.items() for phase in phases}
    for number in range(scenes):
        for index, family in enumerate(FAMILIES):
            echo(f"scene {number + 1} of {scenes}: {family}")
            frames = accuracy_past.truth(family, skin, number + index, PHASES)
            true_ohm = [skin.resistance_ohm(moved) for _, moved in frames]
            for (sigma, method), solver in solvers.items():
                rng = np.random.default_rng([number, index, 2])
                solver.reset()
                for (phase, moved), ohm in zip(frames, true_ohm, strict=True):
                    reading = ohm * (1.0 + sigma * rng.standard_normal(ohm.shape))
                    start = time.process_time()
                    field = solver.update(reading)
                    seconds = time.process_time() - start
                    motion = motion_of.get(phase)
                    if motion is not None:
                        for of in (family, "all"):
                            sums[sigma, motion, method, of].add(field, moved, seconds)
    rows = [
        {"sigma": sigma, "motion": motion, "method": method, "family": family} | each.row()
        for (sigma, motion, method, family), each in sums.items()
    ]
    return {"pareto": mark_front(rows)}


def _solver(skin: Skin, sigma: float, method: str) -> Tracker | Posterior:
    common: dict[str, Any] = {
        "relative_noise": sigma,
        "baseline_ohm": skin.rest_ohm,
        "follow_noise": False,
    }
    options = METHODS[method]
    if options is None:
        return Tracker(skin.layout, method="exact", detect=False, **common)
    return Posterior(skin.layout, **common, **options)


def mark_front(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with the additional value ``front``, which is true if no other method is better.

    A method is better if both its error and its CPU time are smaller for the same noise, motion and family.
    """

    def is_better(other: dict[str, Any], row: dict[str, Any]) -> bool:
        same = all(other[name] == row[name] for name in ("sigma", "motion", "family"))
        return bool(same and other["error"] < row["error"] and other["ms"] < row["ms"])

    return [row | {"front": not any(is_better(other, row) for other in rows)} for row in rows]


def sigmas(figures: dict[str, Any]) -> list[float]:
    """Return the noise levels of the results, in increasing order."""
    return sorted({row["sigma"] for row in figures["pareto"]})


def pooled(figures: dict[str, Any], sigma: float, motion: str) -> list[dict[str, Any]]:
    """Return the rows for all families combined at one noise level and motion, one row per method."""
    return [
        row
        for row in figures["pareto"]
        if row["family"] == "all" and row["sigma"] == sigma and row["motion"] == motion
    ]


def outdone(figures: dict[str, Any]) -> dict[str, list[float]]:
    """Return, for each method that is on no Pareto front at some noise level, those noise levels."""
    found: dict[str, list[float]] = {}
    for sigma in sigmas(figures):
        rows = [row for motion in MOTIONS for row in pooled(figures, sigma, motion)]
        best = {row["method"] for row in rows if row["front"]}
        for method in dict.fromkeys(row["method"] for row in rows):
            if method not in best:
                found.setdefault(method, []).append(sigma)
    return found


def requirements(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per requirement: name, value, limit as text, and whether the limit is met."""
    found = []
    for row in figures["pareto"]:
        if row["family"] == "all" and METHODS[row["method"]] is not None:
            covered = row["coverage"]
            found.append({
                "what": f"coverage, {row['method']}, {row['motion']}, {row['sigma']:.0e}",
                "value": covered,
                "limit": f"at least {COVERAGE_LEAST:g}",
                "reached": bool(covered >= COVERAGE_LEAST),
                "absolute": False,
            })  # fmt: skip
    return found


_COLUMNS: Final = (
    ("ms", "ms", 8, ".2f"), ("error", "error", 9, ".1%"), ("coverage", "in 95 %", 9, ".1%"),
    ("coverage_moved", "moved", 8, ".1%"), ("coverage_rest", "rest", 8, ".1%"), ("far", ">5 dev.", 9, ".1e"),
    ("untrusted", "untrusted", 11, ".1%"), ("frames", "frames", 8, "d"),
)  # fmt: skip


def print_all(figures: dict[str, Any], echo: Callable[[str], object]) -> None:
    """Print the table for all families combined, and list the methods that are on no Pareto front."""
    layout = f"{LAYOUT[0]} h={LAYOUT[1]:g}"
    echo(f"\nCPU time per frame and median error of each method, {layout}, all families; *: Pareto front")
    echo(f"  {'noise, motion, method':32}{''.join(title.rjust(width) for _, title, width, _ in _COLUMNS)}")
    for sigma in sigmas(figures):
        for motion in MOTIONS:
            for row in pooled(figures, sigma, motion):
                cells = "".join(
                    ("-" if _unknown(row[name]) else format(row[name], form)).rjust(width)
                    for name, _, width, form in _COLUMNS
                )
                mark = "*" if row["front"] else " "
                echo(f"{mark} {f'{sigma:.0e} {motion:7} ' + row['method']:32}{cells}")
    for method, noises in outdone(figures).items():
        levels = ", ".join(f"{sigma:.0e}" for sigma in noises)
        echo(f"  {method}: other methods have smaller errors in less time at a noise of {levels}")


def _unknown(value: float | None) -> bool:
    return value is None or math.isnan(value)
