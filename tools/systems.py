"""Compare ``solve_system`` with SciPy on the Moré-Garbow-Hillstrom problems: ``python -m tools.systems``.

All solvers are given the same functions, a tolerance of 1e-12 and at most 2000 evaluations. The solvers start
from the standard starting points multiplied by 1, 10 and 100. A square system with a root counts as solved if
the final point is a root; any other system, if the final point is a minimum of the residual norm. Roots and
minima are verified in 80-bit arithmetic, regardless of the status that the solver reports.

A solver makes a false claim if it reports success at a point that is neither a root nor a minimum, or if it
reports a root of a square system at a point that is only a minimum.
"""

from __future__ import annotations

import argparse
import json
import statistics
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

import skinnode as sk
from skinnode.bench.timing import machine
from tests.solve.extended_precision import Verdict, verdict
from tests.solve.more_garbow_hillstrom import FACTORS, PROBLEMS, Problem

TOLERANCE = 1e-12
MOST = 2000

Function = Callable[[Any], Any]
Solve = Callable[[Function, Function, Any], tuple[Any, bool, bool]]
"""Function that solves a system. It returns the final point, whether the solver claims success (a root or a
minimum), and whether it claims a root."""


def ours(operator: str) -> Solve:
    def solve(f: Function, j: Function, x0: Any) -> tuple[Any, bool, bool]:
        found = sk.solve_system(f, j, x0, operator, TOLERANCE, TOLERANCE, MOST)
        claimed = found.kind in (sk.PointKind.ROOT, sk.PointKind.MINIMUM)
        return found.x, claimed, found.kind is sk.PointKind.ROOT

    return solve


def root(method: str) -> Solve:
    limit = {"hybr": "maxfev", "lm": "maxiter"}[method]

    def solve(f: Function, j: Function, x0: Any) -> tuple[Any, bool, bool]:
        found = optimize.root(f, x0, jac=j, method=method, tol=TOLERANCE, options={limit: MOST})
        return found.x, found.success, f(x0).size == x0.size

    return solve


def least_squares(method: str) -> Solve:
    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), TOLERANCE)

    def solve(f: Function, j: Function, x0: Any) -> tuple[Any, bool, bool]:
        try:
            found = optimize.least_squares(f, x0, jac=j, method=method, max_nfev=MOST, **tolerances)
        except (ValueError, np.linalg.LinAlgError):  # raised on overflow
            return x0, False, False
        return found.x, found.success, False

    return solve


SOLVERS: dict[str, Solve] = {
    **{f"skinnode {name}": ours(name) for name in ("dogleg", "levenberg_marquardt", "gauss_newton")},
    **{f"SciPy root {name}": root(name) for name in ("hybr", "lm")},
    **{f"SciPy least_squares {name}": least_squares(name) for name in ("trf", "dogbox", "lm")},
}


def solved(problem: Problem, truth: Verdict) -> bool:
    """Return whether a final point with the verdict ``truth`` solves the problem."""
    if truth.root or (problem.square and problem.least == 0):
        return truth.root
    return truth.minimum and (truth.isolated or truth.norm**2 <= problem.least * (1 + 5e-6))


def outcomes(solve: Solve, square: bool) -> Iterator[dict[str, Any]]:
    """Solve all square or all tall problems from each of their starting points; yield the outcomes."""
    for problem in PROBLEMS:
        for factor in FACTORS if problem.square == square else ():
            calls = [0, 0]

            def f(x: Any, problem: Problem = problem, calls: list[int] = calls) -> Any:
                calls[0] += 1
                return problem.residual(x)

            def j(x: Any, problem: Problem = problem, calls: list[int] = calls) -> Any:
                calls[1] += 1
                return problem.jacobian(x)

            x, claimed, as_root = solve(f, j, problem.start(factor))
            truth = verdict(problem, x)
            yield {
                "factor": factor,
                "solved": solved(problem, truth),
                "claimed": claimed,
                "false": claimed and not (truth.root or (truth.minimum and not as_root)),
                "calls": calls,
            }


def measure(name: str) -> dict[str, Any]:
    """Return a solver's table row; ``tall`` is None if the solver does not support tall systems."""
    kinds = {"square": True, "tall": False}
    found = {
        kind: None if "hybr" in name and not square else list(outcomes(SOLVERS[name], square))
        for kind, square in kinds.items()
    }
    every = [each for kind in found.values() for each in kind or []]
    row: dict[str, Any] = {"who": name}
    for kind, rows in found.items():
        row[kind] = rows and [
            sum(each["solved"] for each in rows if each["factor"] == factor) for factor in FACTORS
        ]
    row["false"] = sum(each["false"] for each in every)
    row["unclaimed"] = sum(each["solved"] and not each["claimed"] for each in every)
    calls = [each["calls"] for each in every if each["solved"]]
    row["calls"] = [statistics.median_high(column) for column in zip(*calls, strict=True)]
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results to FILE")
    options = parser.parse_args()
    of = {"square": sum(each.square for each in PROBLEMS)}
    of["tall"] = len(PROBLEMS) - of["square"]
    figures: dict[str, Any] = {"benchmark": "systems", "machine": machine(), "of": of, "rows": []}
    print(f"{'solved, starting points × 1, 10, 100':34}{f'{of} each':>34}  false  unclaimed  calls of r, J")
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in SOLVERS:
            row = measure(name)
            figures["rows"].append(row)
            places = "".join(f"{row[kind]!s:>17}" for kind in of)
            print(f"{name:34}{places}{row['false']:7}{row['unclaimed']:11}  {row['calls']}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
