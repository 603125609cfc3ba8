"""``skinnode bench``: speed beside error, ratios taken in one run. No benchmark fails on an absolute time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from skinnode.cli._bench import Result

app = typer.Typer(help="Measure speed beside error; ratios are of one run.", no_args_is_help=True)

_Json = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file.", metavar="FILE")]
_Repeat = Annotated[
    int, typer.Option(min=1, max=10_000, help="Timings of each case; the shortest counts.", metavar="N")
]


@app.command()
def kernel(json_file: _Json = None, repeat: _Repeat = 30) -> None:
    """F and J of one wire, and one step of each operator: compiled against NumPy."""
    from skinnode.cli import _bench, _bench_kernel

    _check(json_file)
    _report(_bench_kernel.measure(_bench.Clock(repeat)), json_file)


@app.command()
def solve(json_file: _Json = None, repeat: _Repeat = 10) -> None:
    """One wire to 1e-9 from the frame before: ours, SciPy and Ceres on the same compiled F and J."""
    from skinnode.cli import _bench, _bench_solve

    _check(json_file)
    _report(_bench_solve.measure(_bench.Clock(repeat)), json_file)


def _check(json_file: Path | None) -> None:
    from skinnode.cli._files import require_writable

    if json_file is not None:
        require_writable("--json", json_file)


def _report(result: Result, json_file: Path | None) -> None:
    import json

    from rich.console import Console

    from skinnode.cli import _bench

    console = Console(highlight=False)
    _bench.show(result, console)
    if json_file is not None:
        json_file.write_text(json.dumps(_bench.as_json(result), indent=2, allow_nan=False) + "\n")
        console.print(f"figures written to {json_file}", soft_wrap=True)
