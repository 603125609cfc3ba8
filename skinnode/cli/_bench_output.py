"""Options and output that the benchmarks of ``skinnode bench`` have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Also write the results to FILE.")
]
PlotFile = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE", help="Plot the results to FILE (needs matplotlib).")
]
Rounds = Annotated[int, typer.Option(min=1, help="Number of measurements per implementation.")]


def print_must(must: list[dict[str, Any]]) -> None:
    """Print the requirements of a benchmark, and whether they are met."""
    for row in must:
        got = "-" if row["got"] is None else f"{row['got']:.2f}".removesuffix(".00")
        verdict = "met" if row["reached"] else "NOT MET"
        typer.echo(f"{row['what']:69}{got:>9}  limit {row['asked']:g}: {verdict}")


def prepare(json: Path | None, plot: Path | None = None) -> None:
    """Check that the output files can be written, and report whether the kernels must be compiled first."""
    from skinnode.compiled.jit import is_cold
    from skinnode.files.output_file import require_writable
    from skinnode.files.plot_file import require_matplotlib

    if json is not None:
        require_writable("--json", json)
    if plot is not None:
        require_matplotlib(plot)
        require_writable("--plot", plot)

    if is_cold():
        typer.echo("Compiling the kernels; later starts use the compiled code.", err=True)


def print_machine(figures: dict[str, Any]) -> None:
    """Print the description of the machine."""
    typer.echo(", ".join(f"{key} {value}" for key, value in figures["machine"].items()))


def write(path: Path | None, figures: dict[str, Any]) -> None:
    """Write the results of a benchmark to ``path``, unless it is None."""
    if path is not None:
        from skinnode.bench.timing import write_json

        write_json(path, figures)
