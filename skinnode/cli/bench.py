"""``skinnode bench``: runs the benchmarks. Those of the solver are in this file.

Ratios compare times from the same run, because absolute times depend on the machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from skinnode.cli import _bench_system
from skinnode.cli._bench_output import JsonFile, PlotFile, Rounds, prepare, print_machine, write
from skinnode.cli._help import App
from skinnode.errors import ConfigError

app = App(help="Measure the performance of solver, node and host on this machine.", no_args_is_help=True)


@app.command()
def kernel(json: JsonFile = None, plot: PlotFile = None, rounds: Rounds = 31) -> None:
    """Compare the speed of the compiled kernels with NumPy and LAPACK.

    The kernels are F with its Jacobian J, one step of each operator, and dense linear algebra.
    """
    from skinnode.bench import kernel as bench

    prepare(json, plot)
    figures = bench.run(rounds)
    print_machine(figures)
    typer.echo(f"{'':28}{'':22}{'µs':>10}{'ratio':>8}")
    for row in figures["rows"]:
        typer.echo(f"{row['what']:28}{row['who']:22}{row['us']:10.1f}{row['ratio']:8.1f}")
    typer.echo(
        "The times of F + J and of steps are for one wire. A step includes evaluations of F and J. The\n"
        "trust radius is so small that every operator must shorten its step. skinnode, LAPACK and BLAS use\n"
        "one thread."
    )
    write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.ratios import draw_kernel

        draw_kernel(plot, figures)


@app.command()
def solve(json: JsonFile = None, plot: PlotFile = None, rounds: Rounds = 31) -> None:
    """Solve one wire with skinnode, SciPy and Ceres, from the same initial guess near the solution.

    Every solver is timed at the loosest tolerance that yields a displacement error of at most 1e-9.
    """
    from skinnode.bench import solve as bench

    prepare(json, plot)
    figures = bench.run(rounds)
    print_machine(figures)
    typer.echo(f"{'':42}{'µs per wire':>10}{'ratio':>8}{'error':>10}{'tolerance':>11}")
    for row in figures["rows"]:
        spent = "not reached".rjust(18) if row["us"] is None else f"{row['us']:10.1f}{row['ratio']:8.2f}"
        typer.echo(f"{row['who']:42}{spent}{row['error']:10.0e}{row['tolerance']:11.0e}")
    typer.echo(
        "ratio: time relative to skinnode dogleg; tolerance: the loosest with an error of at most 1e-9."
    )
    if not any("pyceres" in row["who"] for row in figures["rows"]):
        typer.echo("Ceres is not installed; to measure it too, run sh install.sh bench.")
    write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.ratios import draw_solve

        draw_solve(plot, figures)


@app.command()
def stability(
    json: JsonFile = None,
    plot: PlotFile = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds for each hard case.")] = 50,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes that solve cases in parallel.")] = 1,
) -> None:
    """Solve every hard case with many random seeds; print errors, standard deviations and statuses.

    The exit status is 1 if any wire is CONVERGED but wrong.
    """
    from skinnode.bench import stability as bench
    from skinnode.bench.verdict import named

    prepare(json, plot)
    typer.echo(bench.HEAD)
    figures = bench.run(seeds, jobs=jobs, report=lambda row: typer.echo(bench.line(row)))
    off = [row for row in figures["rows"] if row["wrong"]]
    wrong = [row for row in off if not row["known_limit"]]
    print_machine(figures)
    typer.echo(bench.LEGEND)
    each = "one seed" if seeds == 1 else f"{seeds} seeds each"
    typer.echo(f"\n{len(figures['rows'])} rows, {each}: {len(wrong)} converged and wrong")
    for row in wrong:
        typer.echo(f"  {named(row)}")
    for row in off:
        if row["known_limit"]:
            typer.echo(f"  known limit: {named(row)}")
    write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.stability import draw

        draw(plot, figures)
    if wrong:
        raise typer.Exit(1)


@app.command()
def trust(
    json: JsonFile = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed for the random numbers.")] = 1,
    short: Annotated[
        bool,
        typer.Option("--short", help="Measure only one layout at two noise levels, and 20 pairs of faults."),
    ] = False,
    table: Annotated[
        bool,
        typer.Option(
            "--table", help="Measure only the scenes in which earlier versions trusted a wrong result."
        ),
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="TEXT", help="Run only rows whose section and name contain TEXT; repeatable."),
    ] = None,
    hours: Annotated[
        float,
        typer.Option(
            min=0, help="Simulated time over which to count false alarms, in patch-hours at 100 scans/s."
        ),
    ] = 0.1,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes that solve scans in parallel.")] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run with the same --json and --seed.")
    ] = False,
) -> None:
    """Solve simulated presses with and without faults, and check which fields are trusted.

    Trusted fields must be correct, and patches without faults must be trusted. The exit status is 1 if a
    target is missed. The sections are healthy, single (faults), pair, hours, table, speed and road.
    """
    from skinnode.bench import trust as bench
    from skinnode.bench.trust_report import lines

    prepare(json)

    def progress(line: str) -> None:
        typer.echo(line, err=True)

    kept = None if json is None else json.with_name(json.name + ".streams")
    if kept is not None and not resume:
        kept.unlink(missing_ok=True)
    wanted = ["table"] if table else (only or [])
    options = bench.SHORT if short else {"hours": hours}
    figures = bench.run(seed, only=wanted, jobs=jobs, progress=progress, kept=kept, **options)
    parts = [part for part in bench.PARTS if part in wanted or not (wanted or short)]
    figures = bench.with_parts(figures, seed, parts, progress)
    if not (figures["rows"] or parts):
        raise ConfigError("--only", ", ".join(wanted), "part of a section and row, such as single: crossing")
    for line in lines(figures):
        typer.echo(line)
    print_machine(figures)
    write(json, figures)
    if kept is not None:
        kept.unlink(missing_ok=True)  # this file is needed only to continue an interrupted run
    if not all(row["reached"] for row in figures["must"]):
        raise typer.Exit(1)


@app.command()
def accuracy(
    json: JsonFile = None,
    plot: PlotFile = None,
    scenes: Annotated[
        int, typer.Option(min=1, help="Number of random scenes per row of the coverage table.")
    ] = 200,
    rounds: Rounds = 31,
    only: Annotated[
        Literal["detection", "families", "past", "skew", "pareto"] | None,
        typer.Option(
            help="Run only this part: the touch detector, both priors on families of loads that neither "
            "expects, streams with and without earlier frames, scans whose upper wires are sampled one after "
            "the other, or the error of each method against its time. For families, --scenes counts the "
            "scenes per family, layout and noise level; for past and pareto, the scenes per family; for "
            "skew, the scenes per row of its table."
        ),
    ] = None,
    prior: Annotated[
        Literal["cells", "discs"], typer.Option(help="Prior for the loads in the part `past`.")
    ] = "cells",
    seed: Annotated[int, typer.Option(min=0, help="Seed for the part `detection`.")] = 1,
    presses: Annotated[
        int, typer.Option(min=1, help="Number of presses per row of the part `detection`.")
    ] = 200,
    hours: Annotated[
        float, typer.Option(min=0.01, help="Patch-hours at rest in the part `detection`.")
    ] = 100.0,
) -> None:
    """Measure the displacement error as a function of solve time, noise and code width.

    The benchmark also measures the coverage of confidence intervals and the solve time per scan. With
    `--only detection`, it measures which touches the detector finds, how soon it finds them, and how many
    false alarms occur. With `--only past`, it measures how much earlier frames improve an estimate; with
    `--only skew`, the errors of a moving skin whose upper wires are sampled one after the other; with
    `--only pareto`, the error and the CPU time of each method on the same streams. The exit status is 1 if a
    requirement is not met. There are no requirements on times, because times depend on the machine.
    """
    if only == "detection":
        _detection(json, plot, seed, presses, hours)
        return
    from skinnode.bench import accuracy as bench

    prepare(json, plot)
    if only is not None:
        if plot is not None and only != "pareto":
            raise typer.BadParameter(f"got --plot, but --only {only} has no plot", param_hint="--plot")

        def progress(line: str) -> None:
            typer.echo(line, err=True)

        if only == "families":
            figures = bench.run_families(scenes, progress)
        elif only == "past":
            figures = bench.run_past(scenes, prior, progress)
        elif only == "skew":
            figures = bench.run_skew(scenes, progress)
        else:
            figures = bench.run_pareto(scenes, progress)
    else:
        figures = bench.run(scenes, rounds)
    print_machine(figures)
    bench.print_all(figures, typer.echo)
    write(json, figures)
    if plot is not None:
        from skinnode.bench.plots import accuracy as whole
        from skinnode.bench.plots import pareto

        (pareto if only == "pareto" else whole).draw(plot, figures)
    if not all(row["reached"] or row["absolute"] for row in figures["must"]):
        raise typer.Exit(1)


def _detection(json: Path | None, plot: Path | None, seed: int, presses: int, hours: float) -> None:
    from skinnode.bench import accuracy_detection as bench
    from skinnode.bench.accuracy_detection_report import print_all

    prepare(json, plot)
    figures = bench.run(seed, presses, hours)
    print_machine(figures)
    print_all(figures, typer.echo)
    write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.detection import draw

        draw(plot, figures)
    if not all(row["reached"] or row["absolute"] for row in figures["must"]):
        raise typer.Exit(1)


@app.command()
def path(
    json: JsonFile = None,
    plot: PlotFile = None,
    experiments: Annotated[
        int, typer.Option(min=1, help="Number of random presses per layout and press depth.")
    ] = 10,
) -> None:
    """Reproduce tables 2, 3 and 4 and figures 8 to 13 of the paper; print the paper's values beside them."""
    from skinnode.bench import path as bench
    from skinnode.text.json_values import plain

    prepare(json, plot)
    figures = bench.run(experiments)
    print_machine(figures)
    bench.print_all(figures, typer.echo)
    write(json, plain(figures))
    if plot is not None:
        from skinnode.bench.plots.path import draw

        draw(plot, figures)


for command in _bench_system.COMMANDS:
    app.command()(command)
