"""``skinnode resolve RECORDING…``: solves recordings again with other options, in several processes."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from skinnode.resolve.plan import Job
    from skinnode.resolve.units import ResultSummary


def resolve(
    recordings: Annotated[
        list[Path],
        typer.Argument(help="Recordings (.mcap, .log, .blf or .asc).", metavar="RECORDING..."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Folder for one file per recording, created if needed. Files are never overwritten.",
            metavar="FOLDER",
        ),
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Override a recorded option: a key of the hand file, solver.KEY or "
            "patches.NAME.KEY, where NAME can be *. Several comma-separated values are tried in turn.",
            metavar="KEY=VALUE[,VALUE...]",
        ),
    ] = None,
    hand: Annotated[
        Path | None,
        typer.Option(
            "--hand",
            help="Hand file for logs without a journal, such as candump logs from another master.",
            metavar="HAND.toml",
        ),
    ] = None,
    kind: Annotated[
        Literal["parquet", "mcap"],
        typer.Option("--format", help="Format of the results.", metavar="parquet|mcap"),
    ] = "parquet",
    processes: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Number of processes; default: one per core.", metavar="N"),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Use the workers of this Dask scheduler. They need the same version of skinnode, and must "
            "see the recordings and the output folder under the same paths.",
            metavar="ADDRESS",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object.")] = False,
) -> None:
    """Solve recordings again, with other options or calibrations, and compare the results.

    The results are bit-identical to a replay with these options, regardless of the number of processes. The
    fields of each recording are written to one file, in the same format as the output of `skinnode convert`.
    If an option has several values, every combination is solved, and a table compares the results. To resume
    after an interruption, run the same command again; lost workers do not affect the results.

    The exit status is 1 if a recording is damaged or incomplete or lacks frames, and 2 if the command could
    not run.
    """
    from skinnode.config import load_hand
    from skinnode.resolve.part_files import PartFiles
    from skinnode.resolve.plan import make_plan
    from skinnode.resolve.recording import recording_at
    from skinnode.resolve.run import run, work_folder
    from skinnode.resolve.settings import variants

    _check(kind, processes, scheduler)
    chosen = variants(settings or [])
    plan = None if hand is None else load_hand(hand.absolute())
    opened = [recording_at(path, plan) for path in recordings]
    with work_folder(output) as folder, _workers(processes, scheduler, folder) as workers, _bar() as tell:
        jobs = make_plan(opened, chosen, output.absolute(), f".{kind}", workers.count)
        done = run(jobs, workers, PartFiles(folder), tell)
    results = [_facts(job, each) for job, each in zip(jobs, done, strict=True)]
    if as_json:
        print(json.dumps({"results": results}))
    else:
        _print(results)
    if any(result["faults"] for result in results):
        raise typer.Exit(1)


def _check(kind: str, processes: int | None, scheduler: str | None) -> None:
    """Check that the options are compatible and that the required packages are installed."""
    from skinnode.errors import ConfigError
    from skinnode.messages.typestore import require_mcap
    from skinnode.record.parquet_file import require_pyarrow
    from skinnode.resolve.cluster import require_dask

    if scheduler is not None:
        if processes is not None:
            raise ConfigError("--processes", processes, "only without --scheduler")
        require_dask()
    if kind == "mcap":
        require_mcap("--format mcap")
    else:
        require_pyarrow(Path("--format parquet"))


def _workers(processes: int | None, scheduler: str | None, folder: Path) -> Any:
    """Return the workers as a context manager."""
    import os

    from skinnode.resolve.cluster import Cluster
    from skinnode.resolve.processes import Processes

    if scheduler is not None:
        return Cluster(scheduler, folder)
    return Processes(processes or len(os.sched_getaffinity(0)), folder)


@contextmanager
def _bar() -> Iterator[Callable[[int, int, str], None]]:
    """Yield a function that shows the progress on stderr if stderr is a terminal."""
    if not sys.stderr.isatty():
        yield lambda done, total, newest: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from skinnode.cli._console import console

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=None)
        yield lambda done, total, newest: progress.update(
            task, completed=done, total=total, description=newest.replace("[", r"\[")
        )


def _facts(job: Job, done: ResultSummary) -> dict[str, Any]:
    """Return the result of a job as JSON-compatible data."""
    sums = done.sums
    return {
        "recording": str(job.recording.path),
        "settings": {setting.key: setting.text for setting in job.variant},
        "file": str(job.write.target),
        "fields": sums.fields,
        "untrusted": sums.untrusted,
        "touched": sums.touched,
        "contacts": sums.contacts,
        "deepest_m": sums.deepest_m,
        "mean_std_m": sums.std_sum_m / sums.known_std if sums.known_std else None,
        "solve_s": sums.cpu_s,
        "notes": list(done.notes),
        "faults": list(done.faults),
    }


def _print(results: Sequence[dict[str, Any]]) -> None:
    from skinnode.cli._console import console, table

    keys = list(results[0]["settings"])
    numbers = ("fields", "untrusted", "touched", "contacts", "deepest µm", "σz µm", "µs/field")
    shown = table("file", *keys, *numbers, right=numbers)
    for result in results:
        std_m, each_us = result["mean_std_m"], 1e6 * result["solve_s"] / max(result["fields"], 1)
        shown.add_row(
            Path(result["file"]).name,
            *result["settings"].values(),
            *(str(result[name]) for name in numbers[:4]),
            f"{1e6 * result['deepest_m']:.1f}",
            "-" if std_m is None else f"{1e6 * std_m:.3f}",
            f"{each_us:.0f}",
        )
    out = console()
    out.print(shown)
    found = [(kind[:-1], text) for kind in ("notes", "faults") for each in results for text in each[kind]]
    for kind, text in dict.fromkeys(found):
        out.print(f"{kind}: {text}", soft_wrap=True)
