"""``skinnode bench``: ratios taken in one run, never a judgement on an absolute time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(help="Measure the solver against its peers on this machine.", no_args_is_help=True)

JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the figures to FILE as well.")
]
Rounds = Annotated[int, typer.Option(min=1, help="How often each candidate has its turn.")]


@app.command()
def kernel(json: JsonFile = None, rounds: Rounds = 31) -> None:
    """F + J and one step of each operator: compiled against NumPy."""
    from skinnode.cli import _bench_kernel

    _prepare(json)
    figures = _bench_kernel.run(rounds)
    _print_machine(figures)
    typer.echo(f"{'':28}{'':22}{'µs a wire':>10}{'ratio':>8}")
    for row in figures["rows"]:
        typer.echo(f"{row['what']:28}{row['who']:22}{row['us']:10.1f}{row['ratio']:8.1f}")
    typer.echo(
        "A step has its evaluations in it; the trust radius is held short, so that it has to be searched."
    )
    _write(json, figures)


@app.command()
def solve(json: JsonFile = None, rounds: Rounds = 31) -> None:
    """One wire to 1e-9 from a near start: ours, SciPy's and Ceres' solvers on the same compiled F and J."""
    from skinnode.cli import _bench_solve

    _prepare(json)
    figures = _bench_solve.run(rounds)
    _print_machine(figures)
    typer.echo(f"{'':42}{'µs a wire':>10}{'ratio':>8}{'error':>10}{'tolerance':>11}")
    for row in figures["rows"]:
        spent = "not reached".rjust(18) if row["us"] is None else f"{row['us']:10.1f}{row['ratio']:8.2f}"
        typer.echo(f"{row['who']:42}{spent}{row['error']:10.0e}{row['tolerance']:11.0e}")
    typer.echo("ratio: to skinnode dogleg; tolerance: the loosest given to the solver that reaches 1e-9.")
    if not any("pyceres" in row["who"] for row in figures["rows"]):
        typer.echo("Ceres is not installed: with pip install pyceres it is measured too.")
    _write(json, figures)


def _prepare(json: Path | None) -> None:
    """Refuse what could not be written, before the work; say why the first run takes longer."""
    from skinnode.cli._files import require_writable
    from skinnode.jit import is_cold

    if json is not None:
        require_writable("--json", json)

    if is_cold():
        typer.echo("Compiling the kernels; the next start finds them ready.", err=True)


def _print_machine(figures: dict[str, Any]) -> None:
    typer.echo(", ".join(f"{key} {value}" for key, value in figures["machine"].items()))


def _write(path: Path | None, figures: dict[str, Any]) -> None:
    if path is not None:
        from skinnode.cli._bench_timing import write_json

        write_json(path, figures)
