"""Compares the speed of our solvers with that of other libraries' solvers, one wire at a time.

All solvers use the same functions for the potential F and its Jacobian J. The benchmark solves each wire of
the reference patch for a 10 % press, starting from the solution for a 9 % press. Every solver is timed at the
loosest tolerance that yields a displacement error of at most 1e-9. A solver that never reaches this error is
listed without a time.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from skinnode.bench.timing import machine, take_turns
from skinnode.model.forward import resistance_ohm
from skinnode.model.kernels import potential, potential_jacobian
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.operators.codes import OPERATORS
from skinnode.solve.operators.system import solve_system
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.patch_solver import PatchSolver
from skinnode.solve.wires.problem import PatchProblem

ACCURACY: Final = 1e-9
"""Maximum coordinate error, relative to the wire's largest displacement."""
TOLERANCES: Final = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13, 1e-14, 1e-15)

Solve = Callable[["Case", float], Float]


class Case:
    """Test problem for one wire: residual r = a F − 1, its Jacobian, initial guess and true solution."""

    def __init__(self, problem: PatchProblem, wire: int, a: Float, start: Float, truth: Float) -> None:
        self.wire, self.a, self.start, self.truth = wire, a, start, truth
        self.size = float(np.abs(truth - problem.rest[wire]).max())
        self._lower = problem.lower
        unknowns, equations = truth.size, a.size
        self._f, self._scratch = np.empty(equations), np.empty(equations)
        self._jt = np.empty((unknowns, equations))

    def residual(self, x: Float) -> Float:
        """Return the (K,) residual r at x."""
        potential(x, self._lower, self._f)
        return np.asarray(self.a * self._f - 1.0)

    def jacobian_transposed(self, x: Float) -> Float:
        """Return the (3N, K) transposed Jacobian Jᵀ at x."""
        potential_jacobian(x, self._lower, self._scratch, self._jt)
        return np.asarray(self._jt * self.a)

    def residual_beside_jacobian(self) -> Float:
        """Return the residual that was computed together with the latest Jacobian."""
        return np.asarray(self.a * self._scratch - 1.0)

    def jacobian(self, x: Float) -> Float:
        """Return the (K, 3N) Jacobian J at x."""
        return self.jacobian_transposed(x).T

    def error(self, x: Float) -> float:
        """Return the largest coordinate error of x, relative to the largest displacement."""
        return float(np.abs(x - self.truth).max()) / self.size


def press(layout: PatchLayout, depth: float) -> Float:
    """Return the (U, N, 3) displacement (metres) of a smooth, sheared dent ``depth`` layer heights deep."""
    middle = layout.upper_m[..., :2].mean(axis=(0, 1)) + 0.3 * layout.pitch_m
    away = ((layout.upper_m[..., :2] - middle) ** 2).sum(axis=-1) / (2.0 * layout.pitch_m) ** 2
    dent = depth * layout.height_m / (1.0 + away)
    return np.stack([0.3 * dent, -0.15 * dent, -dent], axis=-1)


def peers(problem: PatchProblem) -> dict[str, Solve]:
    """Return all solvers by name, ours first; a solver maps a case and a tolerance to the solution x."""
    from scipy import optimize

    solver = PatchSolver(problem, 0)
    weight = np.ones_like(solver.a_solved)
    frame = np.ones_like(weight)
    todo = np.zeros(len(frame), np.uint8)

    def ours(code: int) -> Solve:
        def solve(case: Case, tolerance: float) -> Float:
            todo[:] = wires.LEAVE
            todo[case.wire] = wires.SOLVE
            frame[case.wire] = case.a
            solver.x[case.wire] = case.start
            solver.solve(todo, frame, weight, wires.solve_options(code, 0, tolerance, tolerance, 50))
            return np.asarray(solver.x[case.wire])

        return solve

    def python_callables(case: Case, tolerance: float) -> Float:
        return solve_system(case.residual, case.jacobian, case.start, tol_f=tolerance, tol_x=tolerance).x

    def root(method: str) -> Solve:
        def solve(case: Case, tolerance: float) -> Float:
            options = {"col_deriv": True}
            found = optimize.root(
                case.residual,
                case.start,
                jac=case.jacobian_transposed,
                method=method,
                tol=tolerance,
                options=options,
            )
            return np.asarray(found.x)

        return solve

    def least_squares(method: str) -> Solve:
        def solve(case: Case, tolerance: float) -> Float:
            tolerance = max(tolerance, 2.3e-16)
            found = optimize.least_squares(
                case.residual,
                case.start,
                jac=case.jacobian,
                method=method,
                ftol=tolerance,
                xtol=tolerance,
                gtol=tolerance,
            )
            return np.asarray(found.x)

        return solve

    solvers = {f"skinnode {name}": ours(code) for name, code in OPERATORS.items()}
    solvers["skinnode solve_system, Python callables"] = python_callables
    solvers |= {f"SciPy root {method}": root(method) for method in ("hybr", "lm")}
    solvers |= {f"SciPy least_squares {m}": least_squares(m) for m in ("trf", "dogbox", "lm")}
    if importlib.util.find_spec("pyceres") is not None:
        solvers["Ceres dogleg (pyceres)"] = ceres()
    return solvers


def ceres() -> Solve:
    """Return a solver that calls Ceres (dense QR, traditional dogleg) without log output."""
    pyceres = importlib.import_module("pyceres")
    options = pyceres.SolverOptions()
    options.trust_region_strategy_type = pyceres.TrustRegionStrategyType.DOGLEG
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.logging_type = pyceres.LoggingType.SILENT
    options.minimizer_progress_to_stdout = False
    options.num_threads = 1

    class Cost(pyceres.CostFunction):  # type: ignore[misc, name-defined]  # pyceres has no type information
        def __init__(self, case: Case) -> None:
            super().__init__()
            self._case = case
            self.set_num_residuals(case.a.size)
            self.set_parameter_block_sizes([case.start.size])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            x = np.ascontiguousarray(parameters[0])
            if jacobians is None:
                residuals[:] = self._case.residual(x)
            else:
                jacobians[0][:] = self._case.jacobian(x).ravel()
                residuals[:] = self._case.residual_beside_jacobian()
            return True

    def solve(case: Case, tolerance: float) -> Float:
        x = case.start.copy()
        options.function_tolerance = tolerance**2  # squared, because Ceres compares it with a sum of squares
        options.gradient_tolerance = tolerance
        options.parameter_tolerance = tolerance
        problem = pyceres.Problem()
        problem.add_residual_block(Cost(case), None, [x])
        summary = pyceres.SolverSummary()
        pyceres.solve(options, problem, summary)
        return x

    return solve


def _solve_all(solve: Solve, cases: list[Case], tolerance: float) -> None:
    for case in cases:
        solve(case, tolerance)


def run(rounds: int) -> dict[str, Any]:
    """Run the benchmark; return each solver's time per wire (µs), its ratio to our dogleg, and its error."""
    layout = PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
    problem = PatchProblem.of(layout)
    cases = []
    for wire in range(layout.shape[0]):
        moved, before = (layout.upper_m + press(layout, 0.1 * part) for part in (1.0, 0.9))
        a = np.ascontiguousarray((resistance_ohm(layout, moved) * problem.gain)[wire])
        ends = [np.ascontiguousarray(x[wire].ravel() / layout.pitch_m) for x in (before, moved)]
        cases.append(Case(problem, wire, a, *ends))
    rows: list[dict[str, Any]] = []
    timed: dict[str, Callable[[], object]] = {}
    for name, solve in peers(problem).items():
        for tolerance in TOLERANCES:
            error = max(case.error(solve(case, tolerance)) for case in cases)
            if error <= ACCURACY:
                break
        rows.append({"who": name, "tolerance": tolerance, "error": error, "us": None, "ratio": None})
        if error <= ACCURACY:
            timed[name] = functools.partial(_solve_all, solve, cases, tolerance)
    order = ["skinnode dogleg", *(name for name in timed if name != "skinnode dogleg")]
    times = take_turns({name: timed[name] for name in order}, rounds=rounds)
    for row in rows:
        if row["who"] in times:
            row["us"] = times[row["who"]].call_us / len(cases)
            row["ratio"] = times[row["who"]].ratio
    return {"benchmark": "solve", "machine": machine(), "accuracy": ACCURACY, "rows": rows}
