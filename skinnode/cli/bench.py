"""``skinnode bench``: runs the benchmarks.

Ratios compare times from the same run, because absolute times depend on the machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from skinnode.cli._help import App
from skinnode.errors import ConfigError

app = App(help="Measure the performance of solver, node and host on this machine.", no_args_is_help=True)

JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Also write the results to FILE.")
]
PlotFile = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE", help="Plot the results to FILE (needs matplotlib).")
]
Rounds = Annotated[int, typer.Option(min=1, help="Number of measurements per implementation.")]


@app.command()
def kernel(json: JsonFile = None, plot: PlotFile = None, rounds: Rounds = 31) -> None:
    """Compare the speed of the compiled kernels with NumPy and LAPACK.

    The kernels are F with its Jacobian J, one step of each operator, and dense linear algebra.
    """
    from skinnode.bench import kernel as bench

    _prepare(json, plot)
    figures = bench.run(rounds)
    _print_machine(figures)
    typer.echo(f"{'':28}{'':22}{'µs':>10}{'ratio':>8}")
    for row in figures["rows"]:
        typer.echo(f"{row['what']:28}{row['who']:22}{row['us']:10.1f}{row['ratio']:8.1f}")
    typer.echo(
        "The times of F + J and of steps are for one wire. A step includes evaluations of F and J. The\n"
        "trust radius is so small that every operator must shorten its step. skinnode, LAPACK and BLAS use\n"
        "one thread."
    )
    _write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.ratios import draw_kernel

        draw_kernel(plot, figures)


@app.command()
def solve(json: JsonFile = None, plot: PlotFile = None, rounds: Rounds = 31) -> None:
    """Solve one wire with skinnode, SciPy and Ceres, from the same initial guess near the solution.

    Every solver is timed at the loosest tolerance that yields a displacement error of at most 1e-9.
    """
    from skinnode.bench import solve as bench

    _prepare(json, plot)
    figures = bench.run(rounds)
    _print_machine(figures)
    typer.echo(f"{'':42}{'µs per wire':>10}{'ratio':>8}{'error':>10}{'tolerance':>11}")
    for row in figures["rows"]:
        spent = "not reached".rjust(18) if row["us"] is None else f"{row['us']:10.1f}{row['ratio']:8.2f}"
        typer.echo(f"{row['who']:42}{spent}{row['error']:10.0e}{row['tolerance']:11.0e}")
    typer.echo(
        "ratio: time relative to skinnode dogleg; tolerance: the loosest with an error of at most 1e-9."
    )
    if not any("pyceres" in row["who"] for row in figures["rows"]):
        typer.echo("Ceres is not installed; to measure it too, run sh install.sh bench.")
    _write(json, figures)
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

    _prepare(json, plot)
    typer.echo(bench.HEAD)
    figures = bench.run(seeds, jobs=jobs, report=lambda row: typer.echo(bench.line(row)))
    off = [row for row in figures["rows"] if row["wrong"]]
    wrong = [row for row in off if not row["known_limit"]]
    _print_machine(figures)
    typer.echo(bench.LEGEND)
    each = "one seed" if seeds == 1 else f"{seeds} seeds each"
    typer.echo(f"\n{len(figures['rows'])} rows, {each}: {len(wrong)} converged and wrong")
    for row in wrong:
        typer.echo(f"  {named(row)}")
    for row in off:
        if row["known_limit"]:
            typer.echo(f"  known limit: {named(row)}")
    _write(json, figures)
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

    _prepare(json)

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
    _print_machine(figures)
    _write(json, figures)
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

    _prepare(json, plot)
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
    _print_machine(figures)
    bench.print_all(figures, typer.echo)
    _write(json, figures)
    if plot is not None:
        from skinnode.bench.plots import accuracy as whole
        from skinnode.bench.plots import pareto

        (pareto if only == "pareto" else whole).draw(plot, figures)
    if not all(row["reached"] or row["absolute"] for row in figures["must"]):
        raise typer.Exit(1)


def _detection(json: Path | None, plot: Path | None, seed: int, presses: int, hours: float) -> None:
    from skinnode.bench import accuracy_detection as bench
    from skinnode.bench.accuracy_detection_report import print_all

    _prepare(json, plot)
    figures = bench.run(seed, presses, hours)
    _print_machine(figures)
    print_all(figures, typer.echo)
    _write(json, figures)
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

    _prepare(json, plot)
    figures = bench.run(experiments)
    _print_machine(figures)
    bench.print_all(figures, typer.echo)
    _write(json, plain(figures))
    if plot is not None:
        from skinnode.bench.plots.path import draw

        draw(plot, figures)


@app.command()
def scale(
    json: JsonFile = None,
    plot: PlotFile = None,
    patches: Annotated[
        list[int] | None,
        typer.Option(min=1, max=1000, help="Number of patches; one patch is touched. Can be repeated."),
    ] = None,
    scans: Annotated[
        int,
        typer.Option(min=1, max=10_000, help="Number of scans per measurement; fewer for large hands."),
    ] = 20,
    real_time: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=3600.0,
            help="Duration of each measurement in real time on udp_multicast, in s; 0 skips them.",
            metavar="S",
        ),
    ] = 10.0,
) -> None:
    """Measure how the CPU time and memory of the simulator and the host grow with skin area and touched area.

    Hands run in virtual time, except for the measurements on udp_multicast. By default, the largest hand has
    1,000 patches, and the benchmark takes several minutes.
    """
    from skinnode.bench import real_time as multicast
    from skinnode.bench import scale as bench

    _prepare(json, plot)
    measured = multicast.run(real_time) if real_time else {}
    if measured:
        _print_real_time(measured)
    figures = bench.run(patches or bench.PATCHES, scans) | {"real_time": measured}
    _print_machine(figures)
    typer.echo("CPU time per patch and scan, ms")
    typer.echo(
        f"{'patches':>8}{'touched':>9}{'chunks':>9}{'nodes':>8}{'bus':>8}{'host':>8}"
        f"{'virtual/real time':>19}{'MB':>7}"
    )
    for row in figures["area"] + figures["contact"] + figures["changed"]:
        times = "".join(f"{row[key]:8.2f}" for key in ("nodes_ms", "bus_ms", "host_ms"))
        chunks = "changed" if row["changed_only"] else "all"
        typer.echo(
            f"{row['patches']:8}{row['touched']:9}{chunks:>9}{times}"
            f"{row['faster']:19.2f}{row['memory_mb']:7.0f}"
        )
    reading = figures["physics"]
    share = 100 * reading["untouched_us"] / reading["touched_us"]
    typer.echo(
        f"time to simulate the skin for one scan: touched {reading['touched_us']:.0f} µs, "
        f"untouched {reading['untouched_us']:.1f} µs ({share:.1f} %); "
        f"noise of the converter {reading['converter_us']:.1f} µs"
    )
    _write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.scale import draw

        draw(plot, figures)


def _print_real_time(figures: dict[str, Any]) -> None:
    """Print the real-time measurements of the simulator."""
    for row in figures["rows"]:
        scans = row["scans"] + row["skipped"]
        typer.echo(
            f"simulator in real time on udp_multicast, hop_limit {row['hop_limit']}: "
            f"{row['patches']} patches, {row['touched']} touched, {row['frames_per_s']:.0f} frames/s: "
            f"{row['simulator']:.2f} of a core, {row['skipped']} of {scans} scans skipped; "
            f"host {row['host']:.2f} of a core, {row['fields']} fields; machine load {row['load']:.1f}"
        )
    times = figures["frame_us"]
    typer.echo(
        f"time to send a frame and to receive it at both endpoints: {times['python_can']:.1f} µs with "
        f"python-can, {times['port']:.1f} µs with CanPort"
    )


@app.command()
def node(
    json: JsonFile = None,
    seconds: Annotated[
        float, typer.Option(min=0.2, max=3600.0, help="Duration of each measurement on the bus, in s.")
    ] = 10.0,
    rounds: Rounds = 31,
    interface: Annotated[
        str, typer.Option(help="python-can interface; virtual is a bus within the process.")
    ] = "virtual",
    channel: Annotated[
        str | None, typer.Option(help="Channel of the interface; default: an unused name.")
    ] = None,
) -> None:
    """Measure the timing accuracy and the CPU cost of a node.

    The benchmark covers the pacing of chunks, the time from SYNC to the first chunk, the heartbeat on a full
    bus, and the time in µs to handle each kind of frame.
    """
    from skinnode.bench import node as bench

    _prepare(json)
    figures = bench.run(seconds, rounds, interface, channel)
    _print_machine(figures)
    typer.echo(f"{'ms':30}{'p50':>8}{'p99':>8}{'max':>8}{'limit':>8}{'n':>8}{'frames/s received':>19}")
    for row in figures["rows"]:
        late_ms = [row[key] for key in ("p50_ms", "p99_ms", "max_ms")]
        spread = "".join("       -" if value is None else f"{value:8.3f}" for value in late_ms)
        typer.echo(f"{row['what']:30}{spread}{row['goal_ms']:8.1f}{row['n']:8}{row['load_hz']:19.0f}")
    typer.echo(f"\n{'handled by the node':30}{'µs':>8}")
    for row in figures["handling"]:
        typer.echo(f"{row['what']:30}{row['us']:8.1f}")
    typer.echo(
        "\nExact pacing is for a board. Thrifty pacing is for many nodes on one machine; it sends bursts of\n"
        "frames at the same mean rate. Other processes on this machine affect the measured times."
    )
    _write(json, figures)


@app.command()
def pipeline(
    json: JsonFile = None,
    plot: PlotFile = None,
    seconds: Annotated[float, typer.Option(min=1, help="Duration of each measurement, in s.")] = 10.0,
    short: Annotated[bool, typer.Option("--short", help="Run only rows that have a requirement.")] = False,
    interface: Annotated[
        str, typer.Option(help="udp, or socketcan for the single bus given by --channel.")
    ] = "udp",
    channel: Annotated[str, typer.Option(help="Channel for socketcan.")] = "vcan0",
    all_cores: Annotated[
        bool, typer.Option("--all-cores", help="Allow the host and the load generator to use all cores.")
    ] = False,
) -> None:
    """Run a host with sixteen patches on four fully loaded buses; measure losses, latency and CPU load.

    The exit status is 1 if a frame was lost or the frame counts do not add up. The measured times do not
    affect the exit status.
    """
    from skinnode.bench import pipeline as bench

    if interface not in ("udp", "socketcan"):
        raise ConfigError("--interface", interface, "udp or socketcan")
    _prepare(json, plot)
    typer.echo(bench.HEAD)
    figures = bench.run(
        seconds,
        short=short,
        interface=interface,
        channel=channel,
        all_cores=all_cores,
        report=lambda row: typer.echo(bench.line(row)),
    )
    typer.echo(bench.LEGEND)
    _print_machine(figures)
    _print_must(figures["must"])
    _write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.pipeline import draw

        draw(plot, figures)
    lost = not all(row["reached"] for row in figures["must"] if not row["time"])
    if lost or any(row["discrepancies"] for row in figures["rows"]):
        raise typer.Exit(1)


@app.command()
def recording(
    json: JsonFile = None,
    buses: Annotated[int, typer.Option(min=1, max=8, help="Number of full buses, four patches each.")] = 4,
    minutes: Annotated[float, typer.Option(min=0.1, help="Duration of each recording in minutes.")] = 1.0,
    block: Annotated[
        float, typer.Option(min=1, help="Duration of the simulated traffic, in s; the traffic is repeated.")
    ] = 5.0,
) -> None:
    """Write recordings of fully loaded buses; measure their size, cost of writing and MCAP seek time."""
    from skinnode.bench import recording as bench
    from skinnode.messages.typestore import require_mcap

    require_mcap("skinnode bench recording")
    _prepare(json)
    typer.echo(
        f"{'format':18}{'GB/hour':>9}{'µs per frame':>14}{'µs per field':>14}"
        f"{'ms per flush':>14}{'of a core':>11}"
    )

    def report(row: dict[str, Any]) -> None:
        field_us = "-" if row["field_us"] is None else f"{row['field_us']:.0f}"
        typer.echo(
            f"{row['format']:18}{row['gb_per_hour']:9.2f}{row['frame_us']:14.1f}{field_us:>14}"
            f"{row['flush_ms']:14.2f}{row['core']:10.1%}"
        )

    figures = bench.run(buses, minutes, block, report)
    rates, seek = figures["rates"], figures["seek"]
    typer.echo(
        f"{rates['frames_hz']:.0f} frames/s, {rates['fields_hz']:.0f} fields/s, "
        f"{rates['minutes']:.1f} minutes\n"
        f"MCAP with fields: opened in {seek['open_s']:.2f} s, seek {seek['seek_ms']:.0f} ms "
        f"(median of {bench.SEEKS}, at most {seek['seek_max_ms']:.0f} ms), {seek['chunks']} chunks"
    )
    _print_machine(figures)
    _write(json, figures)


@app.command()
def remote(
    json: JsonFile = None,
    seconds: Annotated[float, typer.Option(min=1, help="Duration, in s.")] = 60.0,
    publish_only: Annotated[
        bool, typer.Option("--publish-only", help="Measure the host without a second process or pings.")
    ] = False,
) -> None:
    """Run a host with sixteen patches and a program in a second process; measure losses and latency.

    At the same time, two more processes exchange field-sized pings over Zenoh. The exit status is 1 if a
    field was lost. The measured times do not affect the exit status.
    """
    from skinnode.bench import remote as bench
    from skinnode.remote.session import require_zenoh

    require_zenoh("skinnode bench remote")
    _prepare(json)
    figures = bench.run(seconds, publish_only=publish_only, report=lambda row: None)
    typer.echo(bench.line(figures["total"]))
    _print_machine(figures)
    _print_must(figures["must"])
    _write(json, figures)
    if not all(row["reached"] for row in figures["must"] if not row["time"]):
        raise typer.Exit(1)


@app.command()
def soak(
    json: JsonFile = None,
    minutes: Annotated[float, typer.Option(min=0.1, help="Duration of the soak test in minutes.")] = 10.0,
    seed: Annotated[
        int, typer.Option(help="Seed for the faults; the same seed reproduces the same rounds.")
    ] = 1,
    own_cache: Annotated[
        bool, typer.Option(hidden=True, help="Run in this process, with the existing kernel cache.")
    ] = False,
) -> None:
    """Run a simulated hand under random faults for minutes or hours.

    CAN frames of every kind are dropped, other processes occupy the processors, and the kernel cache is
    damaged at the start. The host must keep running, every patch must recover, all frame counts must add up,
    and memory use and the numbers of threads and file descriptors must not grow. The exit status is 1 if any
    of these requirements is not met.
    """
    from skinnode.bench import soak as bench

    if not own_cache:
        _prepare(json)
        raise typer.Exit(_soak_on_damaged_cache(json, minutes, seed))
    figures = bench.run(minutes, seed, typer.echo)
    for line in bench.summary_lines(figures):
        typer.echo(line)
    _print_must(figures["must"])
    _write(json, figures)
    if missed := [row["what"] for row in figures["must"] if not row["reached"]]:
        typer.echo(f"The soak failed: {'; '.join(missed)}.")
        raise typer.Exit(1)


def _soak_on_damaged_cache(json: Path | None, minutes: float, seed: int) -> int:
    """Run the soak test in a child process with a damaged kernel cache; return the child's exit status."""
    import subprocess
    import sys
    import tempfile

    from skinnode.bench import soak_cache as cache

    with tempfile.TemporaryDirectory(prefix="skinnode-soak-") as folder:
        cache.fill(Path(folder))
        typer.echo("The soak test starts with a damaged copy of the kernel cache:")
        for line in cache.damage(Path(folder), seed):
            typer.echo(f"  {line}")
        command = [sys.executable, "-c", "from skinnode.cli.main import main; main()", "bench", "soak"]
        command += ["--minutes", str(minutes), "--seed", str(seed), "--own-cache"]
        command += [] if json is None else ["--json", str(json)]
        sys.stdout.flush()
        return subprocess.run(command, env=cache.environment(Path(folder)), check=False).returncode


def _print_must(must: list[dict[str, Any]]) -> None:
    for row in must:
        got = "-" if row["got"] is None else f"{row['got']:.2f}".removesuffix(".00")
        verdict = "met" if row["reached"] else "NOT MET"
        typer.echo(f"{row['what']:69}{got:>9}  limit {row['asked']:g}: {verdict}")


def _prepare(json: Path | None, plot: Path | None = None) -> None:
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


def _print_machine(figures: dict[str, Any]) -> None:
    typer.echo(", ".join(f"{key} {value}" for key, value in figures["machine"].items()))


def _write(path: Path | None, figures: dict[str, Any]) -> None:
    if path is not None:
        from skinnode.bench.timing import write_json

        write_json(path, figures)
