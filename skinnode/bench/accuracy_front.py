"""Compares the time and error of our solvers with those of other libraries on the same problems.

All solvers call the same compiled functions for the potential F and its Jacobian J. The samples are
noise-free, and every solver starts from rest. Only the four middle upper wires are solved, where the press is
deepest. Some runs solve only the last sample. Other runs solve a sequence of samples, each starting from the
solution of the previous sample, as in the paper (:mod:`skinnode.bench.path`). Each solver is run with several
tolerances, and each run yields one data point. Only the times for ``solve_path`` include setting up the
patch, following the path and estimating the error.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinnode.bench.case import preset
from skinnode.bench.solve import Case, Solve, peers
from skinnode.bench.truth import Press, Skin
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.solve.operators.codes import OPERATORS
from skinnode.solve.paths.path import solve_path
from skinnode.solve.paths.step_control import Adaptive, Periodic, Schedule, Uniform
from skinnode.solve.wires.problem import PatchProblem

SCENES: Final = (("staggered", 0.5, 0.3), ("staggered", 1.0, 0.3), ("aligned", 0.5, 0.1))
"""Scenes as (preset, layer height in pitches, press depth divided by the layer height). Every solver can
solve the first press from rest. The second press requires intermediate samples. The third press uses the
paper's layout."""
TOLERANCES: Final = (1e-4, 1e-7, 1e-10, 1e-13)
SAMPLES: Final = (1, 5, 10, 20)
SOLVED: Final = 0.01
"""Maximum error of a solved sample, as a fraction of the true displacement. Larger errors are not plotted."""
ROUNDING: Final = 1e-11
"""Smallest error that is distinguishable from rounding: the rounding error in F times the condition number of
J. Smaller errors are raised to this value."""
LOOSE: Final = 1e-6
"""Solver tolerance for every sample but the last, as in the paper."""
REPEATS: Final = 7
LONG_S: Final = 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """Four upper wires and the samples of a press on them."""

    name: str
    layout: PatchLayout
    samples_ohm: Float
    """(T, U, K), ohm: resistances during the press, excluding the sample at rest."""
    truth_m: Float
    """(U, N, 3), metres: true displacement at the last sample."""

    def thinned(self, samples: int) -> Float:
        """Return ``samples`` evenly spaced samples of the press, ending with its last sample."""
        step = len(self.samples_ohm) // samples
        return self.samples_ohm[step - 1 :: step]

    def error(self, displacement_m: Float) -> float:
        """Return the norm of the (U, N, 3) displacement error, relative to that of the true displacement."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.linalg.norm(displacement_m - self.truth_m) / np.linalg.norm(self.truth_m))


def scene_of(name: str, height: float, depth: float) -> Scene:
    """Create a scene in which a sphere presses on four wires to a depth of ``depth`` layer heights."""
    full = preset(name, height)
    layout = PatchLayout(full.upper_m[3:7], full.lower_m, full.resistivity_ohm_per_m)
    press = Press((18.3e-3, 17.1e-3), 10e-3, depth * full.height_m, (0.2, -0.1))
    skin = Skin(layout)
    moved = [skin.displacement_m((press,), share) for share in np.linspace(0, 1, max(SAMPLES) + 1)[1:]]
    samples = np.stack([skin.resistance_ohm(each) for each in moved])
    return Scene(f"{name} h={height:g}, {depth:.0%}", layout, samples, moved[-1])


def _timed_us(call: Callable[[], object]) -> float:
    """Time up to seven calls; return the shortest time (µs), the one least affected by other programs."""
    times: list[float] = []
    while len(times) < REPEATS and sum(times) < LONG_S:
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e6 * min(times)


def _path(scene: Scene, operator: str, schedule: Schedule, samples: int) -> tuple[float, float, bool]:
    """Time :func:`solve_path`; return the time per wire (µs), the error, and whether every wire converged."""
    frames = scene.thinned(samples)
    call = functools.partial(solve_path, scene.layout, frames, operator=operator, schedule=schedule)
    path = call()
    converged = all(status is Status.CONVERGED for status in path.status)
    return _timed_us(call) / len(frames[0]), scene.error(path.displacement_m), converged


def _bare(scene: Scene, solve: Solve, samples: int, tolerance: float) -> tuple[float, float]:
    """Time a bare operator or another library's solver; return the time per wire (µs) and the error."""
    problem = PatchProblem.of(scene.layout)
    truth = problem.rest + scene.truth_m.reshape(len(problem.rest), -1) / scene.layout.pitch_m
    frames = scene.thinned(samples) * problem.gain
    found = problem.rest.copy()

    def paths() -> None:
        for wire in range(len(found)):
            x = problem.rest[wire]
            for number, frame in enumerate(frames[:, wire], 1):
                loose = tolerance if number == len(frames) else max(tolerance, LOOSE)
                x = solve(Case(problem, wire, frame, np.ascontiguousarray(x), truth[wire]), loose)
            found[wire] = x

    with np.errstate(all="ignore"):  # an overflow shows up as a large error
        us = _timed_us(paths) / len(found)
        return us, scene.error(problem.displacement_m(found))


def pareto(rows: list[dict[str, Any]]) -> list[int]:
    """Return the indices of the solved rows on the time-error Pareto front, fastest first."""
    front: list[int] = []
    best = SOLVED
    for index in sorted(range(len(rows)), key=lambda i: (rows[i]["us"], rows[i]["error"])):
        error = max(rows[index]["error"], ROUNDING)
        if error < best:
            best = error
            front.append(index)
    return front


def run() -> list[dict[str, Any]]:
    """Measure all scenes; return one row per run: time, error and whether it is Pareto-optimal."""
    panels = []
    for setting in SCENES:
        scene = scene_of(*setting)
        rows = _rows(scene)
        front = pareto(rows)
        for index, row in enumerate(rows):
            row["front"] = index in front
        panels.append({"scene": scene.name, "rows": rows})
    return panels


def _rows(scene: Scene) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    solvers = peers(PatchProblem.of(scene.layout))
    del solvers[
        "skinnode solve_system, Python callables"
    ]  # the same operators are also timed without Python callables
    for tolerance in TOLERANCES:
        for name, solve in solvers.items():
            for samples in (1, 10):
                us, error = _bare(scene, solve, samples, tolerance)
                how = "from rest" if samples == 1 else f"along {samples} samples"
                rows.append({"who": name, "how": how, "tolerance": tolerance, "us": us, "error": error})
        for how, (schedule, samples) in _schedules(tolerance).items():
            for operator in OPERATORS:
                us, error, converged = _path(scene, operator, schedule, samples)
                row = {"who": f"solve_path {operator}", "how": how, "tolerance": tolerance, "us": us}
                rows.append(row | {"error": error, "converged": converged})
    return rows


def _schedules(tolerance: float) -> dict[str, tuple[Schedule, int]]:
    """Return a mapping from name to step control (see ``solve_path``) and number of samples."""
    loose = max(tolerance, LOOSE)
    uniform = Uniform(intermediate_tolerance=loose, final_tolerance=tolerance)
    found: dict[str, tuple[Schedule, int]] = {
        f"Uniform, {count} sample{'s' * (count > 1)}": (uniform, count) for count in SAMPLES
    }
    most = max(SAMPLES)
    found[f"Periodic, {most} samples"] = Periodic(final_tolerance=tolerance), most
    found["Adaptive, 1 sample"] = Adaptive(final_tolerance=tolerance), 1
    return found
