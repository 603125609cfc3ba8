"""Fills the tables of docs/solver.md, and docs/img/, from what ``skinnode bench`` wrote.

    .venv/bin/skinnode bench path --json out/path.json --plot out/path.png
    .venv/bin/python docs/figures.py out

A folder has some of {kernel,solve,path,accuracy,stability}.json and .png; tables without a file stay as they
are. ``wrong_models.txt`` is what docs/wrong_models.py printed.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from skinnode.bench.accuracy import best_of_each

DOCS = Path(__file__).parent
PAGE = DOCS / "solver.md"
COLOURS = 256
"""Of the pictures: they look the same, at a quarter of the bytes."""
MOST_BYTES = 200_000


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
    return f"{machine(figures)}\n\n" + table(["who", "µs a wire", "ratio", "error", "tolerance"], rows)


def path(figures: dict[str, Any]) -> str:
    paper = figures["paper"]
    calls, errors = paper["table2_function_calls_per_step"], paper["table3_accuracy_percent"]
    parts = [
        f"{machine(figures)} {figures['experiments']} random presses a setting, one wire, 30 unknowns. "
        "*Walk*: as in the paper, `Uniform(plain=True)`; *ours*: `Uniform()`. Calls are of F with J, a step; "
        "the paper counts 31 for each, by finite differences. *lost*: wires not CONVERGED; the error is the "
        "mean of the others."
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
        head = ["operator", "samples", "calls, walk", "ours", "paper / 31", "error, walk", "ours", "paper"]
        parts.append(table(head, rows))
    parts.append("The whole path by dogleg, and what the schedules make of it (means a wire):")
    rows = []
    for setting in figures["settings"]:
        walked, own, adaptive = setting["dogleg"], setting["ours"], setting["adaptive"]
        many = setting["periodic"][-1]
        for name, row in (
            ("walk, 10 samples", walked[1]),
            ("`Uniform()`, 10 samples", own[1]),
            ("walk, 100 samples", walked[4]),
            ("`Uniform()`, 100 samples", own[4]),
            ("`Periodic()`, 100 samples", many),
            ("`Adaptive()`, the last sample", adaptive),
        ):
            searched = f" + {row['search_iterations']:.0f}" if row["cycle"] else ""
            cycle = f", T = {row['cycle']:g}" if row["cycle"] else ""
            rows.append(
                [
                    _place(setting),
                    name + cycle,
                    f"{row['iterations']:.1f}{searched}",
                    f"{row['evaluations']:.0f}",
                    f"{row['runtime_ms']:.2f}",
                    _reached(row),
                ]
            )
    head = ["setting", "schedule", "steps (+ search)", "evaluations, all", "ms", "error"]
    parts.append(table(head, rows))
    ten = "; ".join(f"{row['what']}: {row['ms']:.2f} ms" for row in figures["ten_steps"])
    worst = max(row["error"] for row in figures["ten_steps"])
    parts.append(
        f"Ten-step path of one wire at the first setting, to {percent(worst)}: {ten}. "
        "The paper prints 2.03 s."
    )
    wrong = sum(row["wrong"] for setting in figures["settings"] for row in _all_rows(setting))
    parts.append(f"Converged and wrong, all settings and schedules: {wrong}.")
    return "\n\n".join(parts)


def _place(setting: dict[str, Any]) -> str:
    return f"`{setting['layout']}`, h = {setting['height']:g}, {setting['depth']:.0%}"


def _reached(row: dict[str, Any]) -> str:
    error = "-" if row["accuracy_percent"] is None else f"{row['accuracy_percent']:.0e} %"
    return error + (f", {row['failed']} lost" if row["failed"] else "")


def _all_rows(setting: dict[str, Any]) -> list[dict[str, Any]]:
    found = [row for key in ("operators", "operators_ours") for rows in setting[key].values() for row in rows]
    return [*found, *setting["dogleg"], *setting["ours"], *setting["periodic"], setting["adaptive"]]


def accuracy(figures: dict[str, Any]) -> str:
    parts = [
        f"{machine(figures)} {figures['scenes']} random scenes for each line of the coverage.",
        "Four wires, no noise: each solver's fastest way to 1e-9. **Bold**: on the Pareto front of all rows.",
    ]
    rows = []
    for panel in figures["front"]:
        for i, row in enumerate(best_of_each(panel["rows"])):
            solved = row["error"] is not None and row["error"] <= 0.01
            name = f"**{row['who']}**" if row["front"] else row["who"]
            error = f"{row['error']:.0e}" if solved else "fails"
            rows.append(
                [f"`{panel['scene']}`" if i == 0 else "", name, row["how"], f"{row['us']:.0f}", error]
            )
    parts.append(table(["scene", "who", "how", "µs a wire", "error"], rows))
    parts.append(
        "A 10 % press: RMS error (reported deviation) of the wires CONVERGED, shares of the displacement. "
        "*Bound*: Cramér-Rao without a prior. *exact* is `Tracker(method='exact')` with its referee: where "
        "it is better than the bound, wires were taken from the posterior."
    )
    rows = [
        [
            f"`{exact['layout']}` {exact['height']:g}",
            f"{exact['sigma']:.0e}",
            _pair(exact),
            _pair(own),
            percent(exact["bound"]),
        ]
        for exact, own in _by_method(figures["noise"])
    ]
    parts.append(table(["layout, h", "noise", "exact", "posterior", "bound"], rows))
    rows = [
        [f"`{exact['layout']}` {exact['height']:g}", str(exact["bits"]), _pair(exact), _pair(own)]
        for exact, own in _by_method(figures["codes"])
    ]
    parts.append(table(["layout, h", "bits", "exact", "posterior"], rows))
    parts.append("Random scenes: one body or two, sharp or blunt, 5 to 30 % deep.")
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
    parts.append(table(head, rows))
    parts.append(
        "Errors of the posterior in these scenes over √(n + b), by the share of b in it (n by the noise, b "
        "left open by the prior, section 2.7). *By noise*: the RMS if b were not in the errors at all; *b in "
        "it*: how much of b is. A normal variable has 1.96, 3.29 and 3.0 in the last three columns."
    )
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
    parts.append(table(head, rows))
    rows = [
        [
            row["what"],
            "-" if row["value"] is None else f"{row['value']:.3g}",
            row["limit"],
            "yes" if row["reached"] else "**no**",
        ]
        for row in figures["must"]
    ]
    parts.append(table(["must be reached", "figure", "limit", "reached"], rows))
    return "\n\n".join(parts)


def _by_method(rows: list[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    exact = [row for row in rows if row["method"] == "exact"]
    return list(zip(exact, (row for row in rows if row["method"] == "posterior"), strict=True))


def _pair(row: dict[str, Any]) -> str:
    return f"{percent(row['error'])} ({percent(row['reported'])})"


def stability(figures: dict[str, Any]) -> str:
    parts = [
        f"{machine(figures)} {figures['seeds']} seeds a row, {len(figures['rows'])} rows, "
        f"**{figures['wrong']} wires CONVERGED and wrong**. Wrong is an error above 5 deviations and beyond "
        "chance, with exact data above 1e-6 (`bench/verdict.py`). Below: the rows with noise, by `auto` (by "
        "the method it chose); errors and deviations in the deepest frame, median over the seeds."
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
    exact = [row for row in figures["rows"] if "exact data" in row["case"] or "samples" in row["case"]]
    totals: dict[str, list[dict[str, Any]]] = {}
    for row in exact:
        totals.setdefault(row["method"], []).append(row)
    parts.append("Exact data, all hard cases together:")
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
    parts.append(table(["method", "wires", "accurate", "flagged", "wrong"], rows))
    return "\n\n".join(parts)


MADE: dict[str, Callable[[dict[str, Any]], str]] = {
    "kernel": kernel,
    "solve": solve,
    "path": path,
    "accuracy": accuracy,
    "stability": stability,
}


def fill(page: str, name: str, text: str) -> str:
    """``page`` with ``text`` between the markers of ``name``."""
    start, end = f"<!-- FIGURES: {name} -->", f"<!-- END: {name} -->"
    if start not in page or end not in page:
        raise ValueError(f"{PAGE.name}: has no markers {start} and {end}")
    before, rest = page.split(start, 1)
    return f"{before}{start}\n\n{text}\n\n{end}{rest.split(end, 1)[1]}"


def shrink(source: Path, target: Path) -> None:
    """A picture with few colours, and no more bytes than a repository should carry."""
    from PIL import Image  # comes with matplotlib

    picture = Image.open(source).convert("RGB")
    while True:
        # of the ways to choose colours the one that keeps a thin red line red
        few = picture.quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        few.save(target, optimize=True)
        if target.stat().st_size <= MOST_BYTES:
            return
        picture = picture.resize((picture.width * 9 // 10, picture.height * 9 // 10))


def main() -> None:
    folder = Path(sys.argv[1])
    page = PAGE.read_text(encoding="utf-8")
    for name, make in MADE.items():
        if (folder / f"{name}.json").exists():
            text = make(json.loads((folder / f"{name}.json").read_text(encoding="utf-8")))
            if (folder / f"{name}.png").exists():
                shrink(folder / f"{name}.png", DOCS / "img" / f"{name}.png")
            if (DOCS / "img" / f"{name}.png").exists():
                text += f"\n\n![skinnode bench {name} --plot](img/{name}.png)"
            page = fill(page, name, text)
            print(f"{name}: filled")
    printed = folder / "wrong_models.txt"
    if printed.exists():
        page = fill(page, "wrong models", "```\n" + printed.read_text(encoding="utf-8").rstrip() + "\n```")
        print("wrong models: filled")
    PAGE.write_text(re.sub(r"\n{3,}", "\n\n", page), encoding="utf-8")


if __name__ == "__main__":
    main()
