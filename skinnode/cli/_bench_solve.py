"""One wire to 1e-9 from the frame before: this project, SciPy and Ceres on the same compiled F and J."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import scipy.optimize

from skinnode.cli._bench import Clock, Result, Row, press_m
from skinnode.model.forward import resistance_ohm
from skinnode.model.kernels import potential, potential_jacobian
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.solve import wires
from skinnode.solve.operators import OPERATORS
from skinnode.solve.problem import PatchProblem

TARGET = 1e-9
"""Error to reach, relative to the displacement."""
TOLERANCE = 1e-10
"""Given to every solver as its tolerance of x, f and gradient, whichever it has."""
_DEPTHS = (0.09, 0.10)
_CENTRES = ((0.018, 0.017), (0.011, 0.024), (0.027, 0.009))


@dataclass(frozen=True, eq=False)
class Case:
    """One wire: find x from ``start``; lengths in pitches."""

    problem: PatchProblem
    wire: int
    start: Float
    a: Float
    """(K,) R / ρ at the solution."""
    solution: Float

    def error(self, x: Float) -> float:
        moved = self.solution - self.problem.rest[self.wire]
        return float(np.linalg.norm(x - self.solution) / np.linalg.norm(moved))


@dataclass(frozen=True, slots=True)
class Outcome:
    x: Float
    evaluations: int
    status: str


Solve = Callable[[], Outcome]


class Functions:
    """Residual a F − 1 and its Jacobian for solvers that call Python, around the compiled kernels."""

    def __init__(self, case: Case) -> None:
        self._lower, self._a = case.problem.lower, case.a
        self._f, self._jt = np.empty(case.a.size), np.empty((case.start.size, case.a.size))

    def residual(self, x: Float) -> Float:
        potential(x, self._lower, self._f)
        return self._a * self._f - 1.0

    def jacobian(self, x: Float) -> Float:
        """(m, n)"""
        return self.transposed(x).T

    def transposed(self, x: Float) -> Float:
        """(n, m)"""
        potential_jacobian(x, self._lower, self._f, self._jt)
        return self._jt * self._a


def cases() -> list[Case]:
    """Wires of the reference patch under presses of 10 % with shear, from the solution at 9 %."""
    layout = PatchLayout.preset("staggered")
    problem = PatchProblem.of(layout)
    found = []
    for centre in _CENTRES:
        before, after = (press_m(layout, depth, centre) for depth in _DEPTHS)
        a = resistance_ohm(layout, layout.upper_m + after) * problem.gain
        starts, ends = (problem.rest + m.reshape(len(a), -1) / layout.pitch_m for m in (before, after))
        found += [Case(problem, u, starts[u], a[u], ends[u]) for u in (1, 4, 7)]
    return found


def measure(clock: Clock) -> Result:
    """Rows in order of time; ratios against our fastest operator in the same run."""
    wanted: dict[str, Callable[[Case], Solve]] = {
        **{f"skinnode {name}": _ours(code) for name, code in OPERATORS.items()},
        "scipy root hybr": _root("hybr"),
        "scipy root lm": _root("lm"),
        "scipy least_squares trf": _least_squares("trf"),
        "scipy least_squares dogbox": _least_squares("dogbox"),
        "scipy least_squares lm": _least_squares("lm"),
    }
    ceres = find_spec("pyceres") is not None
    if ceres:
        wanted["ceres dogleg"] = _ceres
    problems = cases()
    figures = {
        name: _measure_one(clock, [prepare(case) for case in problems], problems)
        for name, prepare in wanted.items()
    }
    ours_us = min(time for name, (time, *_) in figures.items() if name.startswith("skinnode"))
    rows = tuple(
        Row(name, time, time / ours_us, error, evaluations, status)
        for name, (time, error, evaluations, status) in sorted(figures.items(), key=lambda item: item[1][0])
    )
    reached = {row.what: row for row in rows if row.error <= TARGET}
    scipy_row = min((r for n, r in reached.items() if n.startswith("scipy")), key=lambda r: r.time_us)
    verdicts = [
        f"{scipy_row.ratio:.1f} times faster than SciPy's fastest to 1e-9, {scipy_row.what} (set: 2.5)"
    ]
    if "ceres dogleg" in figures:
        verdicts.append(f"{figures['ceres dogleg'][0] / ours_us:.1f} times faster than Ceres (set: 4)")
    else:
        verdicts.append("Ceres not measured: pip install 'skinnode[bench]'")
    note = (
        f"{len(problems)} wires, from a 9 to a 10 % press; time a wire, error the largest, evaluations of F"
    )
    return Result("solve", note, rows, tuple(verdicts))


def _measure_one(clock: Clock, calls: list[Solve], problems: list[Case]) -> tuple[float, float, float, str]:
    outcomes = [call() for call in calls]
    time_us = float(np.mean([clock.microseconds(call) for call in calls]))
    error = max(case.error(outcome.x) for case, outcome in zip(problems, outcomes, strict=True))
    statuses = sorted({outcome.status for outcome in outcomes})
    return time_us, error, float(np.mean([o.evaluations for o in outcomes])), ", ".join(statuses)


def _ours(operator: int) -> Callable[[Case], Solve]:
    def prepare(case: Case) -> Solve:
        solver = wires.Solver(case.problem, operator)
        todo = np.zeros(len(case.problem.rest), np.uint8)
        todo[case.wire] = wires.SOLVE
        a = np.tile(case.a, (len(todo), 1))
        weight = np.ones_like(a)

        def solve() -> Outcome:
            solver.x[case.wire] = case.start
            solver.solve(todo, a, weight, 0, TOLERANCE, TOLERANCE, 100)
            report = solver.report[case.wire]
            return Outcome(
                solver.x[case.wire].copy(), report[wires.EVALUATIONS], Status(report[wires.STATUS]).name
            )

        return solve

    return prepare


def _root(method: str) -> Callable[[Case], Solve]:
    options = {"xtol": TOLERANCE, "col_deriv": 1, **({"ftol": TOLERANCE} if method == "lm" else {})}

    def prepare(case: Case) -> Solve:
        functions = Functions(case)

        def solve() -> Outcome:
            found = scipy.optimize.root(
                functions.residual, case.start, method=method, jac=functions.transposed, options=options
            )
            return Outcome(found.x, found.nfev, "success" if found.success else "failure")

        return solve

    return prepare


def _least_squares(method: str) -> Callable[[Case], Solve]:
    def prepare(case: Case) -> Solve:
        functions = Functions(case)

        def solve() -> Outcome:
            found = scipy.optimize.least_squares(
                functions.residual,
                case.start,
                jac=functions.jacobian,
                method=method,
                xtol=TOLERANCE,
                ftol=TOLERANCE,
                gtol=TOLERANCE,
            )
            return Outcome(found.x, found.nfev, "success" if found.success else "failure")

        return solve

    return prepare


def _ceres(case: Case) -> Solve:
    import pyceres

    functions, unknowns = Functions(case), case.start.size
    counted = [0]

    class Cost(pyceres.CostFunction):  # type: ignore[misc]  # the library has no type hints
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(case.a.size)
            self.set_parameter_block_sizes([unknowns])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            counted[0] += 1
            x = np.array(parameters[0])
            residuals[:] = functions.residual(x)
            if jacobians is not None:
                jacobians[0][:] = functions.jacobian(x).ravel()
            return True

    cost = Cost()
    options = pyceres.SolverOptions()
    options.trust_region_strategy_type = pyceres.TrustRegionStrategyType.DOGLEG
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.function_tolerance = options.gradient_tolerance = options.parameter_tolerance = TOLERANCE
    options.max_num_iterations = 100
    options.num_threads = 1
    options.logging_type = pyceres.LoggingType.SILENT
    options.minimizer_progress_to_stdout = False

    def solve() -> Outcome:
        x = case.start.copy()
        counted[0] = 0
        problem = pyceres.Problem()
        problem.add_residual_block(cost, None, [x])
        summary = pyceres.SolverSummary()
        pyceres.solve(options, problem, summary)
        done = summary.termination_type == pyceres.TerminationType.CONVERGENCE
        return Outcome(x, counted[0], "success" if done else "failure")

    return solve
