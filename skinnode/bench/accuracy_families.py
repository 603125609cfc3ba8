"""Measures the posterior's accuracy for loads that its prior does not expect, with and without discs.

Each scene is one frame, solved from rest. A coordinate counts as moved if it moves by at least a tenth of the
largest displacement in its scene; all others are at rest. "Error over claim" is the RMS error divided by the
RMS standard deviation underlying the 95 % interval (:attr:`skinnode.FieldFrame.core_std_m`). Deviations are
errors divided by :attr:`skinnode.FieldFrame.displacement_std_m`, which also accounts for rare large errors.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinnode.bench import family_scenes
from skinnode.bench.case import preset
from skinnode.bench.family_scenes import FAMILIES, Scene
from skinnode.bench.truth import Converter, Skin
from skinnode.model.frames import Z_95_TWO_SIDED, FieldFrame
from skinnode.model.status import Status
from skinnode.solve.posterior.posterior import Posterior

LAYOUTS: Final = (("staggered", 0.5), ("aligned", 0.5), ("staggered", 1.0))
SIGMAS: Final = (1e-5, 1e-4, 1e-3, 3e-3)
MOVED: Final = 0.1
"""Minimum displacement of a moved coordinate, relative to the largest displacement in its scene."""
FAR: Final = 5.0
"""Error, in standard deviations, beyond which a scene counts as wrong."""
PRIORS: Final = ("cells", "discs")
RATIOS: Final = (0.85, 1.1)
COVERAGES: Final = (0.92, 0.98)
WRONG_MOST: Final = 0.01


@dataclass(frozen=True)
class Sample:
    """Result of one scene.

    Sums and counts are pairs: one value for moved coordinates, and one for coordinates at rest.
    """

    family: str
    layout: tuple[str, float]
    sigma: float
    bonded: bool
    converged: bool
    error: float
    """Relative error of the displacement, ‖u − u*‖ / ‖u*‖."""
    square: tuple[float, float]
    """Sum of squared errors, in m²."""
    claim: tuple[float, float]
    """Sum of reported variances, in m²."""
    inside: tuple[int, int]
    """Number of coordinates within the 95 % interval."""
    count: tuple[int, int]
    """Number of coordinates."""
    worst: float
    """Largest error, in standard deviations."""
    contacts: tuple[int, int]
    """Number of contacts found, and number of loads."""
    force: tuple[float, float]
    """Error of the total normal force and its standard deviation, in newtons; NaN if unknown or if there are
    no contacts."""
    centroid: tuple[float, float]
    """Distance from contact to load and its standard deviation, in metres; NaN unless there is exactly one of
    each."""
    seconds: float
    """Processor time, in s."""


def sample(scene: Scene, field: FieldFrame, **case: Any) -> Sample:
    """Compare a field with a scene's ground truth; ``case`` contains the sample's other attributes."""
    truth = scene.truth_m
    error, claim = field.displacement_m - truth, (field.half_width_95_m / Z_95_TWO_SIDED) ** 2
    moved = np.abs(truth) >= MOVED * np.abs(truth).max()
    inside = np.abs(error) <= field.half_width_95_m
    parts = (moved, ~moved)
    force = centroid = (math.nan, math.nan)
    found = field.contacts
    if found:
        normal = sum(contact.normal_force_n for contact in found)
        std = math.sqrt(sum(contact.normal_force_std_n**2 for contact in found))
        force = (normal + float(scene.force_n[2]), std)
    if len(found) == len(scene.centers_m) == 1:
        off = found[0].centroid_m[:2] - scene.centers_m[0]
        centroid = (float(np.hypot(*off)), float(np.hypot(*found[0].centroid_std_m[:2])))
    return Sample(
        bonded=scene.bonded,
        error=float(np.linalg.norm(error) / np.linalg.norm(truth)),
        square=_pair(float((error[part] ** 2).sum()) for part in parts),
        claim=_pair(float(claim[part].sum()) for part in parts),
        inside=_pair(int(inside[part].sum()) for part in parts),
        count=_pair(int(part.sum()) for part in parts),
        worst=float((np.abs(error) / field.displacement_std_m).max()),
        contacts=(len(found), len(scene.centers_m)),
        force=force,
        centroid=centroid,
        **case,
    )


def _pair(values: Iterable[Any]) -> tuple[Any, Any]:
    first, second = values
    return first, second


def row(samples: list[Sample]) -> dict[str, Any]:
    """Return the statistics of several scenes.

    Scenes that did not converge are included only in the counts and the time.
    """
    kept = [each for each in samples if each.converged]
    square, claim, inside, count = (
        np.array([getattr(each, name) for each in kept], np.float64).reshape(-1, 2)
        for name in ("square", "claim", "inside", "count")
    )
    wrong, scenes = sum(each.worst > FAR for each in kept), len(kept)

    def over_claim(pairs: list[tuple[float, float]]) -> float:
        known = np.array([pair for pair in pairs if math.isfinite(pair[0])]).reshape(-1, 2)
        return float(np.sqrt((known[:, 0] ** 2).sum() / ((known[:, 1] ** 2).sum() or math.nan)))

    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(square.sum(axis=0) / claim.sum(axis=0))
        coverage = inside.sum(axis=0) / count.sum(axis=0)
    return {
        "scenes": len(samples),
        "converged": scenes / len(samples),
        "error": float(np.median([each.error for each in kept])) if kept else math.nan,
        "ratio": math.sqrt(square.sum() / (claim.sum() or math.nan)),
        "ratio_moved": float(ratio[0]),
        "ratio_rest": float(ratio[1]),
        "coverage": inside.sum() / (count.sum() or math.nan),
        "coverage_moved": float(coverage[0]),
        "coverage_rest": float(coverage[1]),
        "wrong": wrong / (scenes or math.nan),
        "wrong_at_95": _upper(wrong, scenes),
        "contacts_right": float(np.mean([len(set(each.contacts)) == 1 for each in kept]))
        if kept
        else math.nan,
        "force_ratio": over_claim([each.force for each in kept]),
        "centroid_ratio": over_claim([each.centroid for each in kept]),
        "ms": 1e3 * float(np.median([each.seconds for each in samples])),
    }


def _upper(wrong: int, scenes: int) -> float:
    """Return the 95 % upper confidence limit of a proportion (Clopper and Pearson, 1934)."""
    from scipy.special import betaincinv

    return 1.0 if wrong >= scenes else float(betaincinv(wrong + 1, scenes - wrong, 0.95))


def run(scenes: int, echo: Callable[[str], object] = lambda _: None) -> dict[str, Any]:
    """Solve random scenes of each family with each prior.

    Args:
        scenes: Number of scenes per family, layout and noise level.
        echo: Function that prints a progress line.

    Returns:
        One row per prior, layout, noise level and family, and one row per prior and family over all layouts
        and noise levels.
    """
    rows, families = [], []
    for prior in PRIORS:
        every: list[Sample] = []
        for layout in LAYOUTS:
            for sigma in SIGMAS:
                echo(f"{prior}: {layout[0]} h={layout[1]:g}, noise {sigma:.0e}")
                samples = _solve(prior, layout, sigma, scenes)
                every += samples
                for family in FAMILIES:
                    own = [each for each in samples if each.family == family]
                    where = {"prior": prior, "layout": layout[0], "height": layout[1], "sigma": sigma}
                    rows.append(where | {"family": family} | row(own))
        for family in FAMILIES:
            own = [each for each in every if each.family == family]
            families.append({"prior": prior, "family": family} | row(own))
        families.append({"prior": prior, "family": "all"} | row(every))
    return {"rows": rows, "families": families}


def _solve(prior: str, layout: tuple[str, float], sigma: float, scenes: int) -> list[Sample]:
    skin, converter = Skin(preset(*layout)), Converter(sigma=sigma)
    posterior = Posterior(
        skin.layout, relative_noise=sigma, baseline_ohm=skin.rest_ohm, follow_noise=False, prior=prior
    )
    samples = []
    for number in range(scenes):
        for index, family in enumerate(FAMILIES):
            rng = np.random.default_rng([number, index])
            scene = family_scenes.draw(family, skin, rng, bonded=number % 2 == 1)
            frame, _, _ = converter.read(skin.resistance_ohm(scene.truth_m), skin.rest_ohm, rng)
            posterior.reset()
            start = time.process_time()
            field = posterior.update(frame)
            seconds = time.process_time() - start
            case = {"family": family, "layout": layout, "sigma": sigma, "seconds": seconds}
            samples.append(sample(scene, field, converged=_converged(field), **case))
    return samples


def requirements(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per requirement for the prior with discs: name, value, limit and verdict."""
    found = []
    for each in figures["families"]:
        if each["prior"] != "discs":
            continue
        name = each["family"]
        for part in ("moved", "rest"):
            for what, (low, high) in (("ratio", RATIOS), ("coverage", COVERAGES)):
                value = each[f"{what}_{part}"]
                text = f"{low:g} to {high:g}"
                found.append(
                    _must(f"{what} of coordinates {part}, {name}", value, text, low <= value <= high)
                )
        value = each["wrong_at_95"]
        text = f"at most {WRONG_MOST:g}"
        found.append(_must(f"scenes beyond {FAR:g} deviations, {name}", value, text, value <= WRONG_MOST))
    return found


def _converged(field: FieldFrame) -> bool:
    return all(status is Status.CONVERGED for status in field.status)


def _must(what: str, value: float, limit: str, reached: bool) -> dict[str, Any]:
    return {"what": what, "value": value, "limit": limit, "reached": bool(reached), "absolute": False}


def print_all(figures: dict[str, Any], echo: Callable[[str], object]) -> None:
    """Print the tables for all families."""
    echo("\nloads that the prior does not expect, one frame from rest; moved: by a tenth of the peak or more")
    head = f"{'error':>8}{'err./claim':>11}{'moved':>7}{'rest':>6}{'in 95 %':>9}{'moved':>7}{'rest':>7}"
    head += f"{'>5 dev.':>9}{'contacts':>9}{'force':>7}{'centre':>7}{'ms':>6}"
    echo(f"  {'':44}{head}")
    for each in figures["rows"]:
        where = f"{each['prior']} {each['layout']} h={each['height']:g} {each['sigma']:.0e} {each['family']}"
        _print_row(where, each, echo)
    echo("  all layouts and noises")
    for each in figures["families"]:
        _print_row(f"{each['prior']} {each['family']}, {each['scenes']} scenes", each, echo)


_COLUMNS: Final = (
    ("error", 8, ".1%"), ("ratio", 11, ".2f"), ("ratio_moved", 7, ".2f"), ("ratio_rest", 6, ".2f"),
    ("coverage", 9, ".1%"), ("coverage_moved", 7, ".1%"), ("coverage_rest", 7, ".1%"), ("wrong", 9, ".1%"),
    ("contacts_right", 9, ".0%"), ("force_ratio", 7, ".2f"), ("centroid_ratio", 7, ".2f"), ("ms", 6, ".1f"),
)  # fmt: skip


def _print_row(where: str, each: dict[str, Any], echo: Callable[[str], object]) -> None:
    cells = (
        ("-" if each[name] is None else format(each[name], form)).rjust(width)
        for name, width, form in _COLUMNS
    )
    echo(f"  {where:44}{''.join(cells)}")
