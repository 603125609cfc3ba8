"""Solves every hard case with many random seeds, and reports each method's error, uncertainty and verdict."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, Final

import numpy as np

from skinnode.bench import methods
from skinnode.bench.case import Case
from skinnode.bench.cases import all_cases
from skinnode.bench.timing import machine
from skinnode.bench.verdict import Solved, Tally
from skinnode.process.child_processes import starting_children
from skinnode.text.json_values import plain

TWIN_SEEDS: Final = 2
"""Number of streams on which ``auto`` and another method must agree bit for bit before ``auto`` reuses the
results of the other method."""


@contextlib.contextmanager
def processes(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of ``jobs`` processes; if the ``with`` block raises an exception, kill the processes."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawn) as pool:
        try:
            yield pool
        except BaseException:  # kill, because cancelled jobs make Python 3.11 print a traceback
            for process in multiprocessing.active_children():
                process.kill()
            raise


def run(
    seeds: int,
    *,
    cases: Sequence[Case] | None = None,
    only: Sequence[str] | None = None,
    jobs: int = 1,
    report: Callable[[dict[str, Any]], object] = lambda row: None,
) -> dict[str, Any]:
    """Solve the hard cases and assign verdicts to the results.

    Args:
        seeds: Number of streams per case.
        cases: Cases to solve; default: all.
        only: Methods to use; default: all methods of each case.
        jobs: Number of processes that solve cases in parallel; the results do not depend on this number.
        report: Function that receives each row as soon as it is complete.

    Returns:
        The rows, and the number of wrong wires, excluding known limitations (``Case.known_wrong``).
    """
    rows: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        found: Iterable[list[dict[str, Any]]]
        if cases is None and jobs > 1:
            with starting_children():
                pool = stack.enter_context(processes(jobs))
                shares = [pool.submit(_numbered, seeds, only, i) for i in range(len(all_cases()))]
            found = (each.result() for each in shares)
        else:
            found = (_rows(case, only, seeds) for case in (all_cases() if cases is None else cases))
        for row in itertools.chain.from_iterable(found):
            rows.append(row)
            report(row)
    return {
        "benchmark": "stability",
        "machine": machine(),
        "seeds": seeds,
        "rows": plain(rows),
        "wrong": sum(row["wrong"] for row in rows if not row["known_limit"]),
    }


def _numbered(seeds: int, only: Sequence[str] | None, number: int) -> list[dict[str, Any]]:
    """Return the rows of case ``number``. Cases are looked up by number because they cannot be pickled."""
    return _rows(all_cases()[number], only, seeds)


def _rows(case: Case, only: Sequence[str] | None, seeds: int) -> list[dict[str, Any]]:
    """Solve a case's streams with each of its methods; return one row per method."""
    chosen = [name for name in case.methods if only is None or name in only]
    solvers = {name: methods.set_up(case, name) for name in chosen}
    tallies = {name: Tally(case.converter.exact) for name in chosen}
    twins = [other for other in ("exact", "posterior") if "auto" in chosen and other in chosen]
    name_code = zlib.crc32(case.name.encode())  # seeds are independent of the other cases
    for seed in range(seeds):
        stream = case.make(np.random.default_rng([seed, name_code]))
        tracked = stream.every(case.stride)
        found: dict[str, Solved] = {}
        for name, solve in solvers.items():
            start = time.perf_counter()
            path = methods.last_only(name)
            known = name == "auto" and seed >= TWIN_SEEDS and twins
            found[name] = found[twins[0]] if known else solve(stream if path else tracked)
            tallies[name].time_s += time.perf_counter() - start
            tallies[name].add(seed, found[name], stream.truth_m[-1:] if path else tracked.truth_m)
        twins = [other for other in twins if found["auto"].equals(found[other])]
    head = {"number": case.number, "case": case.name}
    same = {"auto": twins[0]} if twins and seeds > TWIN_SEEDS else {}
    return [
        head
        | {"method": name, "same_as": same.get(name), "known_limit": name in case.known_wrong}
        | tally.row()
        for name, tally in tallies.items()
    ]


HEAD = (
    f"{'':49}{'':22}{'error relative to displacement':>32}{'wires':>18}\n"
    f" # {'case':46}{'method':22}{'median':>11}{'worst':>10}{'reported':>11}{'conv.':>8}"
    f"{'accurate':>9}{'flagged':>9}{'wrong':>7}"
)


LEGEND = (
    "#: number of the hard case. Errors and reported standard deviations are relative to the displacement\n"
    "of the CONVERGED wires in the deepest frame. worst: largest error in any frame. accurate, flagged,\n"
    "wrong: numbers of wires in all frames. A wire is flagged if it is not CONVERGED or not trusted.\n"
    "Any other wire is wrong if neither chance nor the reported standard deviation explains its error."
)


def line(row: dict[str, Any]) -> str:
    """Format a row of the table."""
    method = row["method"] if row["same_as"] is None else f"{row['method']} = {row['same_as']}"
    return (
        f"{row['number']:2} {row['case']:46}{method:22}{share(row['median_error']):>11}"
        f"{share(row['worst_error']):>10}{share(row['reported']):>11}{row['converged']:8.1%}"
        f"{row['accurate']:9}{row['flagged']:9}{row['wrong']:7}"
    )


def share(value: float) -> str:
    """Format a fraction as a percentage, or in scientific notation if very small or large; NaN as a dash."""
    if not np.isfinite(value):
        return "-" if np.isnan(value) else "inf"
    if 1e-4 <= value < 1:
        return f"{value:.2%}"
    return f"{value:.0%}" if 1 <= value < 100 else f"{value:.0e}"
