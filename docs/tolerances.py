"""Measure how tolerances affect the precision and the reported deviations, for docs/solver-figures.md.

Run with ``python docs/tolerances.py [SCENES]``.

Each simulated patch has random errors within one tolerance or within all tolerances. A random load, which
does not match the prior, presses the patch. The posterior then solves the press twice: once with the stated
tolerances, and once for an exact patch. Only the field at full depth is scored.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinnode.bench.accuracy_noise import Pool
from skinnode.bench.accuracy_time import Cycle
from skinnode.bench.case import preset
from skinnode.bench.cases import fingertip
from skinnode.bench.timing import take_turns
from skinnode.bench.trust_loads import LOADS, draw
from skinnode.bench.truth import Converter, Press, Skin, stream
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.model.tolerances import EXACT, ORDINARY, Tolerances
from skinnode.solve.posterior.posterior import Posterior

SIGMA: Final = 1e-5
"""Relative noise of the readings."""
DEPTH: Final = 0.3
"""Depth of the loads, as a fraction of the layer height."""
SHARES: Final = np.array([0.0, 1 / 3, 2 / 3, 1.0])
LIMIT: Final = 5.0
"""Maximum error of a coordinate, in reported standard deviations."""
SETTINGS: Final = {
    "exact": EXACT,
    "placement 0.01 pitch": Tolerances(placement=0.01),
    "placement 0.02 pitch": Tolerances(placement=0.02),
    "placement 0.05 pitch": Tolerances(placement=0.05),
    "thickness 5 %": Tolerances(thickness=0.05),
    "electrode radius 0.05 pitch": Tolerances(electrode_radius=0.05),
    "gain 2 %": Tolerances(gain=0.02),
    "ordinary": ORDINARY,
}


@dataclass
class Claims(Pool):
    """Accumulates errors and standard deviations of many patches, and the largest error in deviations."""

    worst: float = 0.0
    beyond: int = 0

    def add(self, frame: FieldFrame, truth_m: Float) -> None:
        """Add a field, given its true displacement ``truth_m`` (U, N, 3), metres."""
        super().add(frame, truth_m)
        used = np.array([status is Status.CONVERGED for status in frame.status])
        off = np.abs((frame.displacement_m - truth_m)[used]) / frame.displacement_std_m[used]
        self.worst = max(self.worst, float(off.max(initial=0.0)))
        self.beyond += int((off > LIMIT).sum())

    def row(self) -> dict[str, Any]:
        """Return the accumulated figures."""
        return super().row() | {"worst": self.worst, "beyond": self.beyond, "coordinates": self.coordinates}


def made(skin: Skin, tolerances: Tolerances, rng: np.random.Generator) -> tuple[Skin, Float]:
    """Return a skin with random manufacturing errors, and the relative errors (U, 1) of its changes in R.

    Half of the variance of the gain errors is common to all upper wires. The electrodes have the stated
    radius. On a curved surface, they are points, because :class:`Skin` does not support larger electrodes
    there.
    """
    layout = skin.layout
    wires, equations = layout.shape
    off = tolerances.placement * layout.pitch_m
    common, own = rng.standard_normal(), rng.standard_normal((wires, 1))
    true = dataclasses.replace(
        skin,
        height=1.0 + tolerances.thickness * rng.standard_normal(),
        electrode=tolerances.electrode_radius if skin.axes is None else 0.0,
        upper_shift_m=off * rng.standard_normal((wires, 3)) if off else None,
        lower_shift_m=off * rng.standard_normal((equations, 3)) if off else None,
    )
    return true, np.asarray(tolerances.gain * np.sqrt(0.5) * (common + own))


def _skins() -> dict[str, tuple[Skin, PatchLayout]]:
    """Return the patches by name, each with the flat layout for which loads are chosen."""
    flat, aligned = preset("staggered", 0.5), preset("aligned", 0.5)
    return {
        "staggered h=0.5": (Skin(flat), flat),
        "aligned h=0.5": (Skin(aligned), aligned),
        "fingertip": (fingertip(), flat),
    }


def scene(
    skin: Skin, flat: PatchLayout, tolerances: Tolerances, seed: int, depth: float = DEPTH
) -> tuple[Float, Float]:
    """Return a press on a random patch: resistances (T, U, K), ohm, and final displacement (U, N, 3), metres.

    The resistances are normalised to the patch at rest and then scaled to the layout at rest. One solver can
    therefore solve all patches of a layout.
    """
    rng = np.random.default_rng([seed, 16])
    true, gain = made(skin, tolerances, rng)
    load: Any = draw(LOADS[seed % len(LOADS)], flat, rng, depth)
    moved = np.stack([true.displacement_m((load,), share) for share in SHARES])
    rest = skin.rest_ohm
    change = np.stack([true.resistance_ohm(each) for each in moved]) / true.rest_ohm - 1.0
    frames, _, _ = Converter(sigma=SIGMA).read(rest * (1.0 + (1.0 + gain) * change), rest, rng)
    return frames, moved[-1]


def claims(scenes: int, depth: float = DEPTH) -> Iterator[dict[str, Any]]:
    """Solve presses on random patches, and yield one row per layout and setting."""
    for name, (skin, flat) in _skins().items():
        for what, tolerances in SETTINGS.items():
            pools = {"stated": Claims(), "exact": Claims()}
            options: dict[str, Any] = {"relative_noise": SIGMA, "baseline_ohm": skin.rest_ohm}
            solvers = {
                which: Posterior(skin.layout, tolerances=stated, contacts=False, **options)
                for which, stated in (("stated", tolerances), ("exact", EXACT))
            }
            for seed in range(scenes):
                frames, truth = scene(skin, flat, tolerances, seed, depth)
                for which, solver in solvers.items():
                    solver.reset()
                    for frame in frames:
                        field = solver.update(frame)
                    pools[which].add(field, truth)
            assumed_exact = pools["exact"].row()
            yield (
                {"layout": name, "made to": what, **pools["stated"].row()}
                | {f"exact_{key}": assumed_exact[key] for key in ("error", "worst", "converged")}
            )


def times(rounds: int) -> list[tuple[str, float]]:
    """Measure the time per frame of a press and its release, µs, without and with tolerances."""
    skin = Skin(preset("staggered", 0.5))
    press = Press((18.3e-3, 17.1e-3), 10e-3, DEPTH * skin.layout.height_m, (0.2, -0.1))
    rng = np.random.default_rng(5)
    taken = stream(skin, (press,), np.linspace(0.5, 1.0, 12), Converter(sigma=SIGMA), rng)
    options: dict[str, Any] = {"relative_noise": SIGMA, "baseline_ohm": skin.rest_ohm, "hold": False}
    cycles = {
        what: Cycle(Posterior(skin.layout, tolerances=each, **options), taken.frames_ohm)
        for what, each in (("exact", EXACT), ("ordinary", ORDINARY))
    }
    calls: dict[str, Callable[[], object]] = {**cycles}
    return [
        (what, timing.call_us / len(cycles[what].frames))
        for what, timing in take_turns(calls, rounds=rounds).items()
    ]


def main() -> None:
    """Print the table of errors and the times per frame."""
    scenes = int(sys.argv[1]) if len(sys.argv) > 1 else 24
    print(
        f"{scenes} patches per row, {DEPTH:.0%} presses, noise {SIGMA:.0e}; last two columns: assumed exact"
    )
    print(
        "| layout | made to | error | reported | in 95 % | worst | CONVERGED | assumed exact: error | worst |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for row in claims(scenes):
        print(
            f"| {row['layout']} | {row['made to']} | {row['error']:.1%} | {row['reported']:.1%} "
            f"| {row['coverage']:.1%} | {row['worst']:.1f} | {row['converged']:.0%} "
            f"| {row['exact_error']:.0%} | {row['exact_worst']:.0f} |",
            flush=True,
        )
    for what, us in times(31):
        print(f"time per frame of a press, all wires solved, tolerances {what}: {us:.0f} µs")


if __name__ == "__main__":
    main()
