"""Measures how accurate and how fast the solvers are, and how well their uncertainty is calibrated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from skinnode.bench import accuracy_families as families
from skinnode.bench import accuracy_front as front
from skinnode.bench import accuracy_noise as noise
from skinnode.bench import accuracy_pareto as pareto
from skinnode.bench import accuracy_past as past
from skinnode.bench import accuracy_skew as skew
from skinnode.bench import accuracy_time as times
from skinnode.bench.solve import ACCURACY
from skinnode.bench.timing import machine
from skinnode.text.json_values import plain

RATIO_LIMIT: Final = 1.15
COVERAGE_LIMITS: Final = (0.90, 0.98)
ERROR_LIMITS: Final = {"staggered": 0.03, "aligned": 0.10}
"""Maximum error of the posterior for each layout, as a fraction of the RMS displacement, for a 10 % press at
h = 0.5 with a relative noise of 1e-5."""
SCENES_A_CELL: Final = 25
"""Ratio of scenes per row of the coverage table to scenes per cell of the noise and code tables. A cell needs
at least three scenes; each contributes 300 coordinates to its RMS error."""


def run(scenes: int, rounds: int) -> dict[str, Any]:
    """Run the accuracy benchmark and return its results.

    Args:
        scenes: Number of random scenes for each row of the coverage table.
        rounds: Number of timing rounds for each solver.
    """
    few = max(3, scenes // SCENES_A_CELL)
    coverage, parts = noise.coverage(scenes)
    figures: dict[str, Any] = {
        "benchmark": "accuracy",
        "machine": machine(),
        "scenes": scenes,
        "front": front.run(),
        "noise": noise.against_noise(few),
        "codes": noise.against_codes(few),
        "coverage": coverage,
        "parts": parts,
        "time": times.run(rounds),
    }
    figures["must"] = requirements(figures)
    found: dict[str, Any] = plain(figures)
    return found


def _report(
    scenes: int, rows: dict[str, Any], requirements_of: Callable[[dict[str, Any]], list[dict[str, Any]]]
) -> dict[str, Any]:
    """Return the report of one part: its rows and requirements."""
    figures = {"benchmark": "accuracy", "machine": machine(), "scenes": scenes} | rows
    report: dict[str, Any] = plain(figures | {"must": requirements_of(figures)})
    return report


def run_families(scenes: int, echo: Callable[[str], object]) -> dict[str, Any]:
    """Run only the load families that the prior does not expect, and return the results.

    Args:
        scenes: Number of scenes per family, layout and noise level.
        echo: Function that prints a progress line.
    """
    return _report(scenes, families.run(scenes, echo), families.requirements)


def run_past(scenes: int, prior: str, echo: Callable[[str], object]) -> dict[str, Any]:
    """Run only the comparison of streams solved with and without earlier frames; return the results.

    Args:
        scenes: Number of scenes per family.
        prior: Load prior.
        echo: Function that prints a progress line.
    """
    return _report(scenes, past.run(scenes, prior, echo), past.requirements)


def run_pareto(scenes: int, echo: Callable[[str], object]) -> dict[str, Any]:
    """Run only the comparison of the methods by error and CPU time, and return the results.

    Args:
        scenes: Number of scenes of each family.
        echo: Function that prints a progress line.
    """
    return _report(scenes, pareto.run(scenes, echo), pareto.requirements)


def run_skew(scenes: int, echo: Callable[[str], object]) -> dict[str, Any]:
    """Run only the scenes with sequentially sampled upper wires, and return the results.

    Args:
        scenes: Number of scenes for each scan period, row time, speed, noise and method.
        echo: Function that prints a progress line.
    """
    return _report(scenes, skew.run(scenes, echo), skew.requirements)


def requirements(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per requirement: name, measured value, limit as text, and whether the limit is met.

    Limits on execution times are marked ``absolute``. Execution times depend on the machine, so exceeding
    such a limit does not make the benchmark fail.
    """
    found = []
    for row in figures["noise"]:
        if row["method"] == "posterior" and row["height"] == 0.5 and row["sigma"] == 1e-5:
            limit = ERROR_LIMITS[row["layout"]]
            what = f"error, 10% press, noise 1e-5, {row['layout']} h=0.5"
            found.append(_must(what, row["error"], f"at most {limit:.0%}", row["error"] <= limit))
    low, high = COVERAGE_LIMITS
    for row in figures["coverage"]:
        if row["method"] == "posterior":
            where = f"{row['layout']} h={row['height']:g}, noise {row['sigma']:.0e}"
            ratio, covered = row["ratio"], row["coverage"]
            found.append(
                _must(f"error / own bound, {where}", ratio, f"at most {RATIO_LIMIT}", ratio <= RATIO_LIMIT)
            )
            inside = low <= covered <= high
            found.append(_must(f"coverage, {where}", covered, f"{low:.0%} to {high:.0%}", inside))
    for row in figures["time"]:
        limit = row["limit_us"]
        found.append(
            _must(
                f"ms a frame, {row['what']}", row["us"] / 1e3, f"at most {limit / 1e3:g}", row["us"] <= limit
            )
            | {"absolute": True}
        )
    return found


def _must(what: str, value: float, limit: str, reached: bool) -> dict[str, Any]:
    return {"what": what, "value": value, "limit": limit, "reached": bool(reached), "absolute": False}


def print_all(figures: dict[str, Any], echo: Callable[[str], object]) -> None:
    """Print the tables."""
    parts = (("families", families), ("past", past), ("skew", skew), ("pareto", pareto))
    for name, part in parts:
        if name in figures:
            part.print_all(figures, echo)
            _print_must(figures, echo)
            return
    _print_front(figures["front"], echo)
    _print_noise(figures["noise"], echo)
    _print_codes(figures["codes"], echo)
    _print_coverage(figures["coverage"], echo)
    _print_parts(figures["parts"], echo)
    _print_must(figures, echo)


def _print_must(figures: dict[str, Any], echo: Callable[[str], object]) -> None:
    echo("\nrequirements")
    for row in figures["must"]:
        value = "-" if row["value"] is None else f"{row['value']:.3g}"
        echo(f"  {row['what']:58}{value:>8}  {row['limit']:18}{'met' if row['reached'] else 'NOT MET'}")


def _text(value: float | None) -> str:
    """Format a fraction as a percentage, or None as a dash."""
    return "-" if value is None else f"{100.0 * value:.3g}%"


def _print_front(panels: list[dict[str, Any]], echo: Callable[[str], object]) -> None:
    echo(
        f"\nfour wires, no noise: each solver's fastest result (error up to {ACCURACY:.0e}); *: Pareto front"
    )
    for panel in panels:
        echo(f"  {panel['scene']:32}{'':22}{'tolerance':>10}{'µs per wire':>11}{'error':>10}")
        for row in best_of_each(panel["rows"]):
            solved = row["error"] is not None and row["error"] <= front.SOLVED
            error = f"{row['error']:10.0e}" if solved else "fails".rjust(10)
            flagged = "  flagged" if row.get("converged") is False else ""
            echo(
                f"  {'*' if row['front'] else ' '} {row['who']:32}{row['how']:20}{row['tolerance']:10.0e}"
                f"{row['us']:11.0f}{error}{flagged}"
            )


def best_of_each(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return, for each solver, the fastest row that meets ACCURACY, or the most accurate row if none does."""

    def rank(row: dict[str, Any]) -> tuple[bool, float]:
        error = float("inf") if row["error"] is None else row["error"]
        return (True, error) if error > ACCURACY else (False, row["us"])

    best: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row["who"] not in best or rank(row) < rank(best[row["who"]]):
            best[row["who"]] = row
    return sorted(best.values(), key=rank)


def _print_noise(rows: list[dict[str, Any]], echo: Callable[[str], object]) -> None:
    echo("\n10% press: error (reported std. dev.), relative to the displacement; conv.: fraction CONVERGED")
    echo(
        f"  {'layout':16}{'noise':>7}{'exact':>20}{'conv.':>7}{'posterior':>20}{'conv.':>7}"
        f"{'bound, no prior':>17}{'prototype: exact, posterior':>30}"
    )
    for exact, posterior in _pairs(rows):
        echo(
            f"  {exact['layout'] + ' h=' + format(exact['height'], 'g'):16}{exact['sigma']:7.0e}"
            f"{_cell(exact):>20}{exact['converged']:7.0%}{_cell(posterior):>20}{posterior['converged']:7.0%}"
            f"{_text(exact['bound']):>17}{_text(exact['prototype']):>18}{_text(posterior['prototype']):>12}"
        )


def _print_codes(rows: list[dict[str, Any]], echo: Callable[[str], object]) -> None:
    echo("\n10% press, with codes of R/R0 from 0.25 to 1.25")
    echo(f"  {'layout':16}{'bits':>7}{'exact':>20}{'conv.':>7}{'posterior':>20}{'conv.':>7}")
    for exact, posterior in _pairs(rows):
        echo(
            f"  {exact['layout'] + ' h=' + format(exact['height'], 'g'):16}{exact['bits']:7}"
            f"{_cell(exact):>20}{exact['converged']:7.0%}{_cell(posterior):>20}{posterior['converged']:7.0%}"
        )


def _pairs(rows: list[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    exact = [row for row in rows if row["method"] == "exact"]
    return list(zip(exact, (row for row in rows if row["method"] == "posterior"), strict=True))


def _cell(row: dict[str, Any]) -> str:
    return "-" if row["error"] is None else f"{_text(row['error'])} ({_text(row['reported'])})"


def _print_coverage(rows: list[dict[str, Any]], echo: Callable[[str], object]) -> None:
    echo("\nrandom scenes: one or two sharp or blunt bodies press 5 to 30% deep at random positions")
    echo(
        f"  {'layout':16}{'noise':>7} {'method':10}{'scenes':>7}{'conv.':>7}{'error':>10}{'reported':>10}"
        f"{'ratio':>7}{'in 95 %':>9}"
    )
    for row in rows:
        ratio, covered = (
            "-" if row[key] is None else format(row[key], form)
            for key, form in (("ratio", ".2f"), ("coverage", ".1%"))
        )
        echo(
            f"  {row['layout'] + ' h=' + format(row['height'], 'g'):16}{row['sigma']:7.0e} {row['method']:10}"
            f"{row['scenes']:7}{row['converged']:7.0%}{_text(row['error']):>10}{_text(row['reported']):>10}"
            f"{ratio:>7}{covered:>9}"
        )
    echo("  forces and contacts of the posterior: RMS error (reported RMS), coverage of the 95 % interval")
    for row in rows:
        if row["method"] == "posterior":
            where = f"{row['layout']} h={row['height']:g}"
            place = ""
            if "centroid_error_m" in row:
                error, std = 1e3 * row["centroid_error_m"], 1e3 * row["centroid_reported_m"]
                place = f"  centroid {error:.2f} ({std:.2f}) mm {row['centroid_coverage']:.0%}"
            parts = "".join(
                f"  {name} {_text(row[f'{name}_error'])} ({_text(row[f'{name}_reported'])})"
                f" {row[f'{name}_coverage']:.0%}"
                for name in ("normal", "shear")
                if f"{name}_error" in row
            )
            right = f"{row['contacts_right']:.0%} of scenes with the right number of contacts"
            right += f", {row['contacts_none']:.0%} with none"
            echo(f"  {where:16}{row['sigma']:7.0e}{parts}{place}  {right}")


def _print_parts(rows: list[dict[str, Any]], echo: Callable[[str], object]) -> None:
    echo("  errors of the posterior / √(n + b); n: variance due to noise, b: variance due to the prior")
    echo(
        f"  {'b / (n + b)':16}{'coordinates':>12}{'RMS':>7}{'by noise':>10}{'b in it':>9}{'95 %':>7}"
        f"{'99.9 %':>8}{'kurtosis':>10}"
    )
    for row in rows:
        echo(
            f"  {row['from']:.0%} to {row['to']:<9.0%}{row['coordinates']:12}{row['rms']:7.2f}"
            f"{row['by_noise']:10.2f}{row['in_errors']:9.0%}{row['q950']:7.2f}{row['q999']:8.2f}"
            f"{row['kurtosis']:10.1f}"
        )
