"""Repeats the path experiments of Xu et al. and compares the results with the paper (``paper.toml``).

Each experiment solves one upper wire of 10 electrodes (30 unknowns), the wire nearest to the centre of a
press. A sphere with a radius of 6 to 12 mm presses into the rubber at a random point near the middle of the
patch. The displacement is Hertz's closed-form solution with friction. A press consists of 1000 samples; a
path of n steps uses n of them, evenly spaced.

The paper counts calls of the potential function F. The paper approximates each Jacobian by finite
differences, which takes 30 additional calls. Our code evaluates F and an analytic Jacobian J together, at
about twice the cost of F alone. One joint evaluation replaces 31 calls, so our counts are multiplied by 31
for comparison. As in the paper, the number of calls per step is averaged over all samples except the last.
The accuracy is the relative error ‖X − X*‖ / ‖X* − X(0)‖, averaged over the experiments that converged. The
first-order optimality ‖Jᵀr‖∞ refers to the dimensionless residual r = a F − 1, with lengths in pitches. The
paper's values come from MATLAB: they are larger by a factor of F² and depend on the unit of length, which the
paper does not state.

At the paper's press depth of 10 %, our Gauss-Newton solver solved every experiment on ``aligned``, for layer
heights h from 0.3 to 1 pitch and any number of steps. For a depth of 10 %, the benchmark therefore uses the
hardest of these layouts, with h = 1. The setting with h = 0.7 and a depth of 30 % was chosen because
Gauss-Newton fails as often there as in the paper: in 6 of 10 experiments with 5 steps, in 2 with 10 steps,
and in none with 20 or more.
"""

from __future__ import annotations

import statistics
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

import numpy as np

from skinnode.bench.timing import machine, take_turns
from skinnode.bench.truth import Press
from skinnode.model.forward import jacobian, potential_per_m, resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.solve.paths.path import PathResult, solve_path
from skinnode.solve.paths.step_control import Adaptive, Periodic, Schedule, Uniform, shortest_cycle

SETTINGS: Final = (("staggered", 0.5, 0.1), ("aligned", 1.0, 0.1), ("aligned", 0.7, 0.3))
"""Settings as (preset, height in pitches, press depth divided by the height)."""
PITCH_M: Final = 4e-3
SAMPLES: Final = 1000
SEED: Final = 2018
STEPS: Final = (5, 10, 20, 50, 100)
EVEN_MORE: Final = (200, 500, 1000)
FIGURE8: Final = (5, 10, 20, 50)
FIGURE9: Final = (10, 20, 50, 100)
FIGURE10: Final = (1e-3, 1e-4, 1e-5, 1e-6)
RELAXED: Final = 1e-4
LABELS: Final = {
    "levenberg_marquardt": "Levenberg-Marquardt",
    "gauss_newton": "Gauss-Newton",
    "dogleg": "dogleg",
}
"""Display names of the operators, in the order of the paper's tables."""
UNKNOWNS: Final = 30
DIFFERENCES: Final = UNKNOWNS + 1
"""Number of calls of F per evaluation of F and its forward-difference Jacobian."""
WRONG: Final = 1e-4
"""Relative error above which a CONVERGED wire counts as wrong. Correct solutions have errors below 1e-8."""


def printed() -> dict[str, Any]:
    """Return the values published in the paper."""
    text = resources.files("skinnode.bench").joinpath("paper.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


@dataclass(frozen=True, eq=False)
class Experiment:
    """A press, and one wire's resistances during the press."""

    layout: PatchLayout
    """Layout of the single wire."""
    samples_ohm: Float
    """(SAMPLES, 1, K), ohm: resistances of the wire."""
    truth_m: Float
    """(1, N, 3), metres: true displacement at the last sample."""
    patch: PatchLayout
    press: Press

    def solve(self, schedule: Schedule, operator: str = "dogleg", samples: int = SAMPLES) -> PathResult:
        """Solve the path with ``samples`` evenly spaced samples."""
        chosen = self.samples_ohm[SAMPLES // samples - 1 :: SAMPLES // samples]
        with np.errstate(all="ignore"):
            return solve_path(self.layout, chosen, operator=operator, schedule=schedule)

    def error(self, path: PathResult) -> float:
        """Return the relative error ‖X − X*‖ / ‖X* − X(0)‖ of a path's result."""
        with np.errstate(all="ignore"):
            wrong = np.linalg.norm(path.displacement_m - self.truth_m)
        return float(wrong / np.linalg.norm(self.truth_m))


def preset(name: str, height: float) -> PatchLayout:
    """Return the reference patch with a preset layout and a layer height of ``height`` pitches."""
    return PatchLayout.preset(name, pitch_m=PITCH_M, height_m=height * PITCH_M)


def experiments(layout: PatchLayout, depth: float, count: int) -> list[Experiment]:
    """Generate ``count`` experiments with random presses, each ``depth`` layer heights deep."""
    rng = np.random.default_rng(SEED)
    span = layout.upper_m[..., :2].max(axis=(0, 1))
    made = []
    for _ in range(count):
        centre = span * rng.uniform(0.2, 0.8, 2)
        radius = rng.uniform(6e-3, 12e-3)
        friction = rng.uniform(-0.5, 0.5, 2)
        press = Press(
            (float(centre[0]), float(centre[1])),
            float(radius),
            depth * layout.height_m,
            (float(friction[0]), float(friction[1])),
        )
        wire = int(np.argmin(np.abs(layout.upper_m[:, 0, 1] - centre[1])))
        one = PatchLayout(layout.upper_m[[wire]], layout.lower_m, layout.resistivity_ohm_per_m)
        points = one.upper_m[0, :, :2]
        moved = [press.displacement_m(points, k / SAMPLES)[None] for k in range(1, SAMPLES + 1)]
        samples = np.array([resistance_ohm(one, one.upper_m + u) for u in moved])
        made.append(Experiment(one, samples, moved[-1], layout, press))
    return made


def run(count: int) -> dict[str, Any]:
    """Run the path benchmark with ``count`` experiments per setting, and return all results."""
    settings = []
    for name, height, depth in SETTINGS:
        layout = preset(name, height)
        settings.append(
            {"layout": name, "height": height, "depth": depth, **_setting(experiments(layout, depth, count))}
        )
    return {
        "benchmark": "path",
        "machine": machine(),
        "experiments": count,
        "paper": printed(),
        "settings": settings,
        "ten_steps": _ten_steps(),
        "surface": _surface(),
    }


def _setting(made: list[Experiment]) -> dict[str, Any]:
    first = made[0]
    first.solve(Uniform())  # load the kernels before timing
    operators, ours = (
        {operator: [_row(made, Uniform(plain=plain), operator, n) for n in STEPS] for operator in LABELS}
        for plain in (True, False)
    )
    density = potential_per_m(first.layout, first.layout.upper_m) * PITCH_M
    return {
        "operators": operators,
        "operators_ours": ours,
        "dogleg": [*operators["dogleg"], *(_row(made, Uniform(plain=True), "dogleg", n) for n in EVEN_MORE)],
        "ours": [*ours["dogleg"], *(_row(made, Uniform(), "dogleg", n) for n in EVEN_MORE)],
        "adaptive": _row(made, Adaptive(), "dogleg", 1),
        "periodic": [_row(made, Periodic(), "dogleg", n) for n in (20, 50, 100)],
        "figure8": {str(n): _calls(made, n) for n in FIGURE8},
        "figure9": {str(n): _optimality(first, n, RELAXED) for n in FIGURE9},
        "figure10": {f"{t:.0e}": _optimality(first, 50, t) for t in FIGURE10},
        "cycles": {f"{t:.0e}": {str(n): _cycle(made, n, t) for n in (20, 50, 100)} for t in FIGURE10},
        "figure11": {str(n): _iterations(made, n) for n in (20, 50, 100)},
        "figure12": {"uniform": _last_step(first, False), "periodic": _last_step(first, True)},
        "unscaled": float(np.median(density) ** 2),
    }


def _row(made: list[Experiment], schedule: Schedule, operator: str, samples: int) -> dict[str, Any]:
    """Run all experiments with the given step-size controller; return their mean cost and accuracy."""
    paths, times = [], []
    for one in made:
        start = time.perf_counter()
        paths.append(one.solve(schedule, operator, samples))
        times.append(time.perf_counter() - start)
    errors = [one.error(path) for one, path in zip(made, paths, strict=True)]
    good = [path.status == (Status.CONVERGED,) for path in paths]
    before = [path.evaluations[_path_rows(path)][:-1] for path in paths]
    reached = [error for error, converged in zip(errors, good, strict=True) if converged]
    cycles = [path.cycle for path in paths if path.cycle is not None]
    return {
        "steps": samples,
        "calls_per_step": _mean([float(each.mean()) for each in before if each.size]),
        "evaluations": _mean([path.stats.evaluations for path in paths]),
        "iterations": _mean([float(path.steps[_path_rows(path)].sum()) for path in paths]),
        "search_iterations": _mean([float(path.steps[: path.searched].sum()) for path in paths]),
        "cycle": statistics.median(cycles) if cycles else None,
        "tol_x": _mean(
            [
                correction(one.layout, path.upper_m, one.samples_ohm[-1])
                for one, path, converged in zip(made, paths, good, strict=True)
                if converged
            ]
        ),
        "final_optimality": _mean([_final(path) for path in paths]),
        "runtime_ms": 1e3 * statistics.median(times),
        "accuracy_percent": 100 * statistics.mean(reached) if reached else None,
        "worst_percent": 100 * max(reached) if reached else None,
        "failed": good.count(False),
        "wrong": sum(error > WRONG for error in reached),
    }


def _mean(values: Sequence[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return statistics.mean(finite) if finite else None


def _path_rows(path: PathResult) -> slice:
    """Return the rows for the path itself, excluding the cycle search, second attempts and checks."""
    at = path.position[path.searched :, 0]
    return slice(path.searched, path.searched + int(np.argmax(at == np.nanmax(at))) + 1)


def _final(path: PathResult) -> float:
    return float(path.optimality[_path_rows(path)][-1, 0])


def _calls(made: list[Experiment], samples: int) -> list[float]:
    """Return the mean number of calls for each step except the last (figure 8)."""
    paths = [one.solve(Uniform(plain=True), samples=samples) for one in made]
    return [float(each) for each in np.mean([path.evaluations[: samples - 1, 0] for path in paths], axis=0)]


def _optimality(one: Experiment, samples: int, tolerance: float) -> list[float]:
    """Return the first-order optimality after each step except the last (figures 9 and 10)."""
    path = one.solve(Uniform(plain=True, intermediate_tolerance=tolerance), samples=samples)
    return [float(each) for each in path.optimality[: samples - 1, 0]]


def _cycle(made: list[Experiment], samples: int, tolerance: float) -> float | None:
    """Return the median cycle length over the experiments; None if no cycle was found."""
    cycles = []
    for one in made:
        path = one.solve(Uniform(plain=True, intermediate_tolerance=tolerance), samples=samples)
        found = shortest_cycle(path.steps[: samples - 1] > 0)
        if found is not None:
            cycles.append(found)
    return float(statistics.median(cycles)) if cycles else None


def _iterations(made: list[Experiment], samples: int) -> dict[str, Any]:
    """Return the operator steps per path, and per sample of the first experiment (figure 11)."""
    uniform = [one.solve(Uniform(plain=True), samples=samples) for one in made]
    periodic = [one.solve(Periodic(plain=True), samples=samples) for one in made]
    return {
        "uniform": _mean([float(path.steps[_path_rows(path)].sum()) for path in uniform]),
        "periodic": _mean([float(path.steps[_path_rows(path)].sum()) for path in periodic]),
        "search": _mean([float(path.steps[: path.searched].sum()) for path in periodic]),
        "uniform_each": uniform[0].steps[:samples, 0].tolist(),
        "periodic_at": (1 + periodic[0].position[_path_rows(periodic[0]), 0]).tolist(),
        "periodic_each": periodic[0].steps[_path_rows(periodic[0]), 0].tolist(),
    }


def _last_step(one: Experiment, periodic: bool) -> list[float]:
    """Return the optimality at the start of the last step and after each of its iterations (figure 12)."""
    cycle = one.solve(Periodic(plain=True), samples=50).cycle if periodic else None

    def schedule(most: int) -> Schedule:
        if periodic:
            return Periodic(cycle=cycle or 1, plain=True, final_steps=most)
        return Uniform(plain=True, final_steps=most)

    whole = one.solve(schedule(1000), samples=50)
    on_path = _path_rows(whole)
    before = int(whole.position[on_path][-2, 0])
    chosen = one.samples_ohm[SAMPLES // 50 - 1 :: SAMPLES // 50]
    start = solve_path(one.layout, chosen[: before + 1], schedule=Uniform(plain=True))
    iterations = range(1, int(whole.steps[on_path][-1, 0]) + 1)
    after = [_final(one.solve(schedule(most), samples=50)) for most in iterations]
    return [optimality(one.layout, start.upper_m, chosen[-1]), *after]


def optimality(layout: PatchLayout, upper_m: Float, frame_ohm: Float) -> float:
    """Return ‖Jᵀr‖∞ of r = a F − 1 with lengths in pitches, computed with the reference model."""
    r, slopes = _linear(layout, upper_m, frame_ohm)
    return float(np.abs(r @ slopes).max())


def correction(layout: PatchLayout, upper_m: Float, frame_ohm: Float) -> float:
    """Return the largest absolute component of the next Newton step, in pitches."""
    r, slopes = _linear(layout, upper_m, frame_ohm)
    return float(np.abs(np.linalg.solve(slopes, r)).max())


def _linear(layout: PatchLayout, upper_m: Float, frame_ohm: Float) -> tuple[Float, Float]:
    """Return the (K,) residual r of the first wire, and its (K, 3N) Jacobian J."""
    a = frame_ohm[0] / layout.resistivity_ohm_per_m
    r = a * potential_per_m(layout, upper_m)[0] - 1.0
    return r, jacobian(layout, upper_m)[0].reshape(len(a), -1) * a[:, None] * layout.pitch_m


def _ten_steps() -> list[dict[str, Any]]:
    """Measure the time and error of a ten-step path on the ``staggered`` layout.

    The first rows are for one wire with each operator; the next row is for our default step control. The last
    row is the time per wire when the whole patch of ten wires is solved.
    """
    layout = preset(*SETTINGS[0][:2])
    one = experiments(layout, SETTINGS[0][2], 1)[0]
    points = layout.upper_m[..., :2].reshape(-1, 2)
    moved = [one.press.displacement_m(points, k / 10).reshape(layout.upper_m.shape) for k in range(1, 11)]
    patch = [resistance_ohm(layout, layout.upper_m + u) for u in moved]
    chosen = one.samples_ohm[SAMPLES // 10 - 1 :: SAMPLES // 10]
    plain = Uniform(plain=True)

    def alone(operator: str, schedule: Schedule) -> Callable[[], PathResult]:
        return lambda: solve_path(one.layout, chosen, operator=operator, schedule=schedule)

    calls = {f"alone, {LABELS[operator]}": alone(operator, plain) for operator in LABELS}
    calls["alone, ours"] = alone("dogleg", Uniform())
    calls["in a patch of ten, dogleg"] = lambda: solve_path(layout, patch, schedule=plain)
    times = take_turns(calls, rounds=11)
    rows = []
    for what, call in calls.items():
        path = call()
        truth = one.truth_m if len(path.status) == 1 else moved[-1]
        rows.append(
            {
                "what": what,
                "ms": times[what].call_us / 1e3 / len(path.status),
                "error": float(np.linalg.norm(path.displacement_m - truth) / np.linalg.norm(truth)),
            }
        )
    return rows


def _surface() -> dict[str, Any]:
    """Return the z-displacements of the whole patch in the hardest setting, in µm (figure 13).

    The patch is solved in 5 and in 20 steps, as in the paper, and with our adaptive step control.
    """
    name, height, depth = SETTINGS[-1]
    layout = preset(name, height)
    press = experiments(layout, depth, 1)[0].press
    points = layout.upper_m[..., :2].reshape(-1, 2)

    def displaced(share: float) -> Float:
        return press.displacement_m(points, share).reshape(layout.upper_m.shape)

    fine = [resistance_ohm(layout, layout.upper_m + displaced(k / 20)) for k in range(1, 21)]
    truth = displaced(1.0)
    found: dict[str, Any] = {"truth_um": (1e6 * truth[..., 2]).tolist(), "paths": []}
    for title, operator, schedule, samples in (
        ("5 steps, Gauss-Newton as in the paper", "gauss_newton", Uniform(steps=5, plain=True), fine),
        ("20 steps, the same", "gauss_newton", Uniform(plain=True), fine),
        ("the last sample alone, Adaptive", "dogleg", Adaptive(), fine[-1:]),
    ):
        start = time.perf_counter()
        with np.errstate(all="ignore"):
            path = solve_path(layout, samples, operator=operator, schedule=schedule)
        spent = time.perf_counter() - start
        found["paths"].append(
            {
                "title": title,
                "depth_um": (1e6 * path.displacement_m[..., 2]).tolist(),
                "error_um": 1e6 * float(np.abs(path.displacement_m - truth).max()),
                "converged": [status is Status.CONVERGED for status in path.status],
                "ms_a_wire": 1e3 * spent / layout.shape[0],
            }
        )
    return found


# -- print ---------------------------------------------------------------------------------------------

Say = Callable[[str], None]


def print_all(figures: dict[str, Any], say: Say) -> None:
    """Print the tables and the figure data, with the paper's values for comparison."""
    paper, count = figures["paper"], figures["experiments"]
    say(f"Means of {count} experiments; one wire, {UNKNOWNS} unknowns; tolerances 1e-6 and 1e-12.")
    say("As in the paper: Uniform(plain=True). Ours: Uniform(), with extrapolation and a second attempt.")
    say("Tol_X: largest component of the next correction, in pitches. Times: median for one wire.")
    say("Ten-step path of one wire (paper: 2.03 s)")
    for row in figures["ten_steps"]:
        say(f"  {row['what']:32}{row['ms']:6.2f} ms, error {100 * row['error']:.0e} %")
    for setting in figures["settings"]:
        say(f"\n== {setting['layout']}, h = {setting['height']:g} pitches, press {setting['depth']:.0%} of h")
        _print_operators(setting, paper, count, say)
        _print_dogleg(setting, paper, count, say)
        _print_figures(setting, paper, say)
    wrong = sum(row["wrong"] for setting in figures["settings"] for row in _rows(setting))
    say(f"\nWires CONVERGED but wrong, over all settings and schedules: {wrong}")
    surface = figures["surface"]
    say("figure 13, surface in the last setting: maximum coordinate error, number of unconverged wires")
    for path in surface["paths"]:
        say(f"  {path['title']:44}{path['error_um']:10.2e} µm  {path['converged'].count(False)} of 10")


def _rows(setting: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        *(row for key in ("operators", "operators_ours") for rows in setting[key].values() for row in rows),
        *setting["dogleg"][len(STEPS) :],
        *setting["ours"][len(STEPS) :],
        *setting["periodic"],
        setting["adaptive"],
    ]


def _accuracy(row: dict[str, Any], count: int) -> str:
    """Format the mean error of the converged experiments and the number of failed experiments."""
    if row["failed"] == count:
        return f"failed {count}/{count}"
    text = f"{row['accuracy_percent']:.0e} %"
    if row["failed"]:
        text += f", {row['failed']}/{count} failed"
    if row["wrong"]:
        text += f", {row['wrong']} WRONG"
    return text


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _print_operators(setting: dict[str, Any], paper: dict[str, Any], count: int, say: Say) -> None:
    calls, errors = paper["table2_function_calls_per_step"], paper["table3_accuracy_percent"]
    say(f"\n{'tables 2 and 3':20}{'':>6}{'calls per step':>26}{'':>26}accuracy")
    say(
        f"{'':20}{'steps':>6}{'F with J':>9}{'×31':>8}{'paper':>8}{'ours':>7}{'×31':>7}"
        f"  {'as in the paper':<23}{'paper':>8}  ours"
    )
    better = 0
    for operator, label in LABELS.items():
        for i, (row, own) in enumerate(
            zip(setting["operators"][operator], setting["operators_ours"][operator], strict=True)
        ):
            theirs = errors[operator][i]
            better += bool(not own["failed"] and not own["accuracy_percent"] >= theirs)
            say(
                f"{label if i == 0 else '':20}{row['steps']:6}{row['calls_per_step']:9.2f}"
                f"{DIFFERENCES * row['calls_per_step']:8.1f}{calls[operator][i]:8.1f}"
                f"{own['calls_per_step']:7.2f}{DIFFERENCES * own['calls_per_step']:7.1f}"
                f"  {_accuracy(row, count):<23}{'failed' if np.isnan(theirs) else f'{theirs:g} %':>8}"
                f"  {_accuracy(own, count)}"
            )
    say(
        f"table cells in which our solver never failed and was more accurate than the paper: {better} of "
        f"{len(LABELS) * len(STEPS)}"
    )


def _print_dogleg(setting: dict[str, Any], paper: dict[str, Any], count: int, say: Say) -> None:
    table = paper["table4_dogleg"]
    say(f"\n{'table 4':22}{'':>6}{'calls per step':>29}{'Tol_X':>20}{'time per path':>22}{'accuracy':>17}")
    say(
        f"{'':22}{'steps':>6}{'F with J':>10}{'×31':>10}{'paper':>9}{'here':>10}{'paper':>10}"
        f"{'here':>12}{'paper':>10}  {'here':<24}{'paper':>8}"
    )
    for key, label in (("dogleg", "dogleg as in the paper"), ("ours", "ours, Uniform()")):
        for i, row in enumerate(setting[key]):
            own = row["calls_per_step"]
            say(
                f"{label if i == 0 else '':22}{row['steps']:6}{own:10.2f}{DIFFERENCES * own:10.1f}"
                f"{table['function_calls_per_step'][i]:9.1f}"
                f"{_figure(row['tol_x'], '.0e'):>10}{table['tol_x'][i]:10.2e}"
                f"{row['runtime_ms']:9.2f} ms{table['runtime_s'][i]:8.2f} s  {_accuracy(row, count):<24}"
                f"{table['accuracy_percent'][i]:6g} %"
            )
    row = setting["adaptive"]
    say(
        f"{'Adaptive, last sample':22}{1:6}{row['evaluations']:10.2f}"
        f"{DIFFERENCES * row['evaluations']:10.1f}{'-':>9}"
        f"{_figure(row['tol_x'], '.0e'):>10}{'-':>10}{row['runtime_ms']:9.2f} ms{'-':>10}"
        f"  {_accuracy(row, count)}"
    )


def _print_figures(setting: dict[str, Any], paper: dict[str, Any], say: Say) -> None:
    say("\nfigure 8, calls at each step (F with J)")
    for n, calls in setting["figure8"].items():
        shown = calls if len(calls) <= 19 else calls[:19]
        dots = "" if len(calls) <= 19 else " …"
        say(f"  {n:>3} steps  " + " ".join(f"{each:.1f}" for each in shown) + dots)
    say("figures 9 and 10, first-order optimality: cycle length T in samples, by tolerance")
    say(f"  {'tolerance':>10}" + "".join(f"{n + ' samples':>13}" for n in ("20", "50", "100")))
    for tolerance, cycles in setting["cycles"].items():
        say(f"  {tolerance:>10}" + "".join(f"{_figure(cycles[n], 'g'):>13}" for n in ("20", "50", "100")))
    section = paper["section5"]
    say(
        f"  paper's T (tolerance 1e-4, 50 samples): {section['cycle_at_50_steps_tol_1e-4']}. The paper's "
        f"optimality refers to F; with lengths in pitches, it is {setting['unscaled']:.0f} times ours."
    )
    totals, printed_totals = setting["figure11"], paper["figure11_iterations"]
    say("figure 11, iterations per path")
    for label, n, key, theirs in (
        ("uniform, 20 samples", "20", "uniform", printed_totals["uniform_20_steps"]),
        ("uniform, 100 samples", "100", "uniform", printed_totals["uniform_100_steps"]),
        ("periodic, 100 samples", "100", "periodic", printed_totals["periodic_100_steps"]),
    ):
        search = f", plus {totals[n]['search']:.0f} to find the cycle" if key == "periodic" else ""
        say(f"  {label:24}{totals[n][key]:7.1f}   paper {theirs}{search}")
    for row in setting["periodic"]:
        say(
            f"  ours, Periodic(), {row['steps']} samples: T = {_figure(row['cycle'], 'g')}, "
            f"{row['iterations']:.1f} iterations, {_figure(row['accuracy_percent'], '.0e')} %, "
            f"{row['failed']} failed"
        )
    say("figure 12, optimality during the last of 50 steps")
    for label, theirs in (
        ("uniform", section["final_first_order_optimality_uniform_50"]),
        ("periodic", section["final_first_order_optimality_periodic_50"]),
    ):
        trace = " ".join(f"{each:.0e}" for each in setting["figure12"][label])
        say(f"  {label:10}{trace}   final value in the paper: {theirs:.2e}")
