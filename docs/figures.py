"""Write the results of ``skinnode bench`` to the tables of the solver's pages and to docs/img/.

    .venv/bin/skinnode bench path --json out/path.json --plot out/path.png
    .venv/bin/python docs/figures.py out

The folder may contain {kernel,solve,systems,path,accuracy,pareto,stability,trust}.json and the corresponding
.png files; pareto.json is the output of ``skinnode bench accuracy --only pareto``. A table whose file is
missing is not changed. ``wrong_models.txt`` is the output of docs/wrong_models.py.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from skinnode.bench import trust_report
from skinnode.bench.accuracy import best_of_each
from skinnode.bench.accuracy_pareto import MOTIONS, pooled, sigmas

DOCS = Path(__file__).parent
PAGES = (DOCS / "solver.md", DOCS / "solver-figures.md", DOCS / "methods.md")
COLOURS = 256
"""Number of colours to which a picture is reduced; the file size decreases to a quarter without a visible
change."""
MOST_BYTES = 150_000
SHORT_NOISE = 1e-5
"""Relative noise of the rows in the short accuracy table."""


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.3g} %"


def machine(figures: dict[str, Any]) -> str:
    parts = figures["machine"]
    return "Machine: " + ", ".join(f"{key} {value}" for key, value in parts.items()) + "."


def kernel(figures: dict[str, Any]) -> str:
    rows = [[row["what"], row["who"], f"{row['us']:.1f}", f"{row['ratio']:.1f}"] for row in figures["rows"]]
    return f"{machine(figures)}\n\n" + table(["what", "who", "µs", "ratio"], rows)


def solve(figures: dict[str, Any]) -> str:
    rows = [
        [
            row["who"],
            "not reached" if row["us"] is None else f"{row['us']:.1f}",
            "-" if row["us"] is None else f"{row['ratio']:.2f}",
            f"{row['error']:.0e}",
            f"{row['tolerance']:.0e}",
        ]
        for row in figures["rows"]
    ]
    return f"{machine(figures)}\n\n" + table(["who", "µs per wire", "ratio", "error", "tolerance"], rows)


def systems(figures: dict[str, Any]) -> str:
    """Return a table of the solvers' results on test problems from the literature."""
    rows = []
    for row in figures["rows"]:
        solved = [
            str(each) for kind in ("square", "tall") for each in (row[kind] or ["-"] * len(row["square"]))
        ]
        calls = " / ".join(str(each) for each in row["calls"])
        rows.append([row["who"], *solved, str(row["false"]), str(row["unclaimed"]), calls])
    of = figures["of"]
    head = [
        "solver",
        *(f"square, × {factor}" for factor in (1, 10, 100)),
        *(f"tall, × {factor}" for factor in (1, 10, 100)),
        *("falsely claimed", "solved, not claimed", "calls of r / J"),
    ]
    return f"{machine(figures)} There are {of['square']} square and {of['tall']} tall problems.\n\n" + table(
        head, rows
    )


def path(figures: dict[str, Any]) -> str:
    paper = figures["paper"]
    calls, errors = paper["table2_function_calls_per_step"], paper["table3_accuracy_percent"]
    parts = [
        f"{machine(figures)} Each setting has {figures['experiments']} random presses of one wire with 30 "
        "unknowns. *Plain* is the paper's tracker, `Uniform(plain=True)`; *ours* is `Uniform()`. One call "
        "evaluates F and J; the tables show the number of calls per step. The paper counts 31 calls for the "
        "same work, because it uses finite differences. A wire is *lost* if it is not CONVERGED; the error "
        "is the mean over the other wires."
    ]
    for setting in figures["settings"]:
        rows = []
        for operator, walked in setting["operators"].items():
            for i, (row, own) in enumerate(zip(walked, setting["operators_ours"][operator], strict=True)):
                theirs = errors[operator][i]
                rows.append(
                    [
                        operator if i == 0 else "",
                        str(row["steps"]),
                        f"{row['calls_per_step']:.2f}",
                        f"{own['calls_per_step']:.2f}",
                        f"{calls[operator][i] / 31:.1f}",
                        *(_reached(each) for each in (row, own)),
                        f"{theirs:g} %" if isinstance(theirs, float) and theirs == theirs else "failed",
                    ]
                )
        parts.append(f"**{_place(setting)}**")
        head = ["operator", "samples", "calls, plain", "ours", "paper / 31", "error, plain", "ours", "paper"]
        parts.append(table(head, rows))
    ten = "; ".join(f"{row['what']}: {row['ms']:.2f} ms" for row in figures["ten_steps"])
    worst = max(row["error"] for row in figures["ten_steps"])
    parts.append(
        "For one wire, a ten-step path at the first setting to an error of "
        f"{percent(worst)} took these times: {ten}. The paper reports 2.03 s."
    )
    wrong = sum(row["wrong"] for setting in figures["settings"] for row in _all_rows(setting))
    parts.append(f"Number of wires that are CONVERGED but wrong, in all settings and schedules: {wrong}.")
    return "\n\n".join(parts)


def step_control(figures: dict[str, Any]) -> str:
    """Return a table of the cost of a path by dogleg with each schedule, for the first and last setting."""
    rows = []
    for setting in (figures["settings"][0], figures["settings"][-1]):
        plain, own, adaptive = setting["dogleg"], setting["ours"], setting["adaptive"]
        many = setting["periodic"][-1]
        for name, row in (
            ("plain, 100 samples", plain[4]),
            ("`Uniform()`, 100 samples", own[4]),
            ("`Periodic()`, 100 samples", many),
            ("plain, 10 samples", plain[1]),
            ("`Uniform()`, 10 samples", own[1]),
            ("`Adaptive()`, the last sample", adaptive),
        ):
            searched = f" + {row['search_iterations']:.0f}" if row["cycle"] else ""
            cycle = f", T = {row['cycle']:g}" if row["cycle"] else ""
            rows.append(
                [
                    _place(setting) if row is plain[4] else "",
                    name + cycle,
                    f"{row['iterations']:.1f}{searched}",
                    f"{row['evaluations']:.0f}",
                    f"{row['runtime_ms']:.2f}",
                    _reached(row),
                ]
            )
    head = ["layout, h, press", "schedule", "steps (+ search)", "evaluations, all", "ms", "error"]
    return table(head, rows)


def _place(setting: dict[str, Any]) -> str:
    return f"`{setting['layout']}`, h = {setting['height']:g}, {setting['depth']:.0%}"


def _reached(row: dict[str, Any]) -> str:
    error = "-" if row["accuracy_percent"] is None else f"{row['accuracy_percent']:.0e} %"
    return error + (f", {row['failed']} lost" if row["failed"] else "")


def _all_rows(setting: dict[str, Any]) -> list[dict[str, Any]]:
    found = [row for key in ("operators", "operators_ours") for rows in setting[key].values() for row in rows]
    return [*found, *setting["dogleg"], *setting["ours"], *setting["periodic"], setting["adaptive"]]


def front(figures: dict[str, Any]) -> str:
    """Return a table of error versus time, with each solver's fastest result."""
    rows = []
    for panel in figures["front"]:
        for i, row in enumerate(best_of_each(panel["rows"])):
            solved = row["error"] is not None and row["error"] <= 0.01
            name = f"**{row['who']}**" if row["front"] else row["who"]
            error = f"{row['error']:.0e}" if solved else "fails"
            rows.append(
                [f"`{panel['scene']}`" if i == 0 else "", name, row["how"], f"{row['us']:.0f}", error]
            )
    found = table(["scene", "who", "how", "µs per wire", "error"], rows)
    return f"{machine(figures)} Results on the Pareto front of all rows are in **bold**.\n\n{found}"


def noise(figures: dict[str, Any], only: float | None = None) -> str:
    rows = [
        [
            f"`{exact['layout']}` {exact['height']:g}",
            f"{exact['sigma']:.0e}",
            _pair(exact),
            _pair(own),
            percent(exact["bound"]),
        ]
        for exact, own in _by_method(figures["noise"])
        if only is None or math.isclose(exact["sigma"], only)
    ]
    return table(["layout, h", "noise", "exact", "posterior", "bound"], rows)


def short_noise(figures: dict[str, Any]) -> str:
    return noise(figures, SHORT_NOISE)


def codes(figures: dict[str, Any]) -> str:
    rows = [
        [f"`{exact['layout']}` {exact['height']:g}", str(exact["bits"]), _pair(exact), _pair(own)]
        for exact, own in _by_method(figures["codes"])
    ]
    return table(["layout, h", "bits", "exact", "posterior"], rows)


def coverage(figures: dict[str, Any]) -> str:
    rows = [
        [
            f"`{row['layout']}` {row['height']:g}",
            f"{row['sigma']:.0e}",
            row["method"],
            f"{row['converged']:.1%}",
            _pair(row),
            "-" if row["ratio"] is None else f"{row['ratio']:.2f}",
            "-" if row["coverage"] is None else f"{row['coverage']:.1%}",
        ]
        for row in figures["coverage"]
    ]
    head = ["layout, h", "noise", "method", "CONVERGED", "error (reported)", "error / reported", "in 95 %"]
    return table(head, rows)


def parts_of_errors(figures: dict[str, Any]) -> str:
    rows = [
        [
            f"{row['from']:.0%} to {row['to']:.0%}",
            str(row["coordinates"]),
            f"{row['rms']:.2f}",
            f"{row['by_noise']:.2f}",
            f"{row['in_errors']:.0%}",
            f"{row['q950']:.2f}",
            f"{row['q999']:.2f}",
            f"{row['kurtosis']:.1f}",
        ]
        for row in figures["parts"]
    ]
    head = [
        "share of b",
        "coordinates",
        "RMS",
        "by noise",
        "b in it",
        "95 % below",
        "99.9 % below",
        "kurtosis",
    ]
    return table(head, rows)


def limits(figures: dict[str, Any]) -> str:
    rows = [
        [
            row["what"],
            "-" if row["value"] is None else f"{row['value']:.3g}",
            row["limit"],
            "yes" if row["reached"] else "**no**",
        ]
        for row in figures["must"]
        if not row["what"].startswith(
            ("coverage", "error / own bound")
        )  # these requirements appear in the coverage table
    ]
    return table(["must be reached", "figure", "limit", "reached"], rows)


def _by_method(rows: list[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    exact = [row for row in rows if row["method"] == "exact"]
    return list(zip(exact, (row for row in rows if row["method"] == "posterior"), strict=True))


def _pair(row: dict[str, Any]) -> str:
    return f"{percent(row['error'])} ({percent(row['reported'])})"


def stability(figures: dict[str, Any]) -> str:
    parts = [
        f"{machine(figures)} There were {figures['seeds']} seeds per row and {len(figures['rows'])} rows; "
        f"**{figures['wrong']} wires were CONVERGED but wrong**. A CONVERGED wire is wrong if its error "
        "exceeds 5 standard deviations and chance cannot explain it. With noise-free data, it is wrong if "
        "its error exceeds 1e-6. "
        "The table shows the rows with noise, solved by the method that `auto` chose. Errors and standard "
        "deviations are medians over the seeds in the deepest frame."
    ]
    rows = [
        [
            str(row["number"]),
            row["case"],
            row["same_as"] or row["method"],
            percent(row["median_error"]),
            percent(row["reported"]),
            f"{row['converged']:.1%}",
            str(row["wrong"]),
        ]
        for row in figures["rows"]
        if row["method"] == "auto"
    ]
    head = ["#", "case", "by", "error", "reported", "CONVERGED", "wrong"]
    parts.append(table(head, rows))
    return "\n\n".join(parts)


def exact_data(figures: dict[str, Any]) -> str:
    exact = [row for row in figures["rows"] if "exact data" in row["case"] or "samples" in row["case"]]
    totals: dict[str, list[dict[str, Any]]] = {}
    for row in exact:
        totals.setdefault(row["method"], []).append(row)
    rows = [
        [
            name,
            str(sum(row["wires"] for row in some)),
            f"{sum(row['accurate'] for row in some) / sum(row['wires'] for row in some):.1%}",
            f"{sum(row['flagged'] for row in some) / sum(row['wires'] for row in some):.1%}",
            str(sum(row["wrong"] for row in some)),
        ]
        for name, some in totals.items()
    ]
    summary = (
        f"There were {figures['seeds']} seeds per row and {len(figures['rows'])} rows; "
        f"**{figures['wrong']} wires were CONVERGED but wrong**. "
        "Totals over all hard cases with noise-free data:"
    )
    return f"{summary}\n\n" + table(["method", "wires", "accurate", "flagged", "wrong"], rows)


def pareto(figures: dict[str, Any]) -> str:
    """Return a table of the methods' errors, CPU times and coverage on streams of all families."""
    rows = [
        [
            f"{row['sigma']:.0e}",
            row["motion"],
            row["method"],
            f"{row['ms']:.2f}",
            percent(row["error"]),
            "yes" if row["front"] else "",
            f"{row['coverage']:.1%}",
            f"{row['coverage_moved']:.1%}",
            f"{row['far']:.1e}" if row["far"] else "0",
            f"{row['untrusted']:.1%}",
        ]
        for sigma in sigmas(figures)
        for motion in MOTIONS
        for row in pooled(figures, sigma, motion)
    ]
    head = ["noise", "body", "method", "ms", "median error", "on the front", "in 95 %", "moved", "beyond 5"]
    return table([*head, "not trusted"], rows)


def trust(figures: dict[str, Any]) -> str:
    command = f"This is the output of `skinnode bench trust --seed {figures['seed']}`. {machine(figures)}"
    return f"{command}\n\n```text\n" + "\n".join(trust_report.lines(figures)) + "\n```"


MADE: dict[str, dict[str, Callable[[dict[str, Any]], str]]] = {
    "kernel": {"kernel": kernel},
    "solve": {"solve": solve},
    "systems": {"systems": systems},
    "path": {"path": path, "step control": step_control},
    "accuracy": {
        "front": front,
        "noise": noise,
        "noise in short": short_noise,
        "codes": codes,
        "coverage": coverage,
        "parts": parts_of_errors,
        "limits": limits,
    },
    "pareto": {"pareto": pareto},
    "stability": {"stability": stability, "exact data": exact_data},
    "trust": {"trust": trust},
}
"""Functions that create the tables, by benchmark and by the table's marker."""


def fill(name: str, text: str) -> None:
    """Write ``text`` between the markers ``name`` on the page that contains them.

    Raises:
        ValueError: No page contains the markers.
    """
    start, end = f"<!-- FIGURES: {name} -->", f"<!-- END: {name} -->"
    for file in PAGES:
        page = file.read_text(encoding="utf-8")
        if start in page and end in page:
            before, rest = page.split(start, 1)
            after = rest.split(end, 1)[1]
            file.write_text(f"{before}{start}\n\n{text}\n\n{end}{after}", encoding="utf-8")
            print(f"{file.name}: {name}")
            return
    raise ValueError(f"got no page with {start} and {end}, expected one of {[file.name for file in PAGES]}")


def shrink(source: Path, target: Path) -> None:
    """Reduce a picture's colours and, if necessary, its size, so that it needs at most ``MOST_BYTES``."""
    from PIL import Image  # a dependency of matplotlib

    picture = Image.open(source).convert("RGB")
    while True:
        # this quantization method preserves the colour of thin red lines
        few = picture.quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        few.save(target, optimize=True)
        if target.stat().st_size <= MOST_BYTES:
            return
        picture = picture.resize((picture.width * 9 // 10, picture.height * 9 // 10))


def main() -> None:
    folder = Path(sys.argv[1])
    for bench, tables in MADE.items():
        if (folder / f"{bench}.json").exists():
            figures = json.loads((folder / f"{bench}.json").read_text(encoding="utf-8"))
            for name, make in tables.items():
                fill(name, make(figures))
            if (folder / f"{bench}.png").exists():
                shrink(folder / f"{bench}.png", DOCS / "img" / f"{bench}.png")
    printed = folder / "wrong_models.txt"
    if printed.exists():
        fill("wrong models", "```text\n" + printed.read_text(encoding="utf-8").rstrip() + "\n```")


if __name__ == "__main__":
    main()
