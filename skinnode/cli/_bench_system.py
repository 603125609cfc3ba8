"""Benchmarks of the simulator, node, host, recordings and daemon, which ``skinnode bench`` runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from skinnode.cli._bench_output import JsonFile, PlotFile, Rounds, prepare, print_machine, print_must, write
from skinnode.errors import ConfigError


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

    prepare(json, plot)
    measured = multicast.run(real_time) if real_time else {}
    if measured:
        _print_real_time(measured)
    figures = bench.run(patches or bench.PATCHES, scans) | {"real_time": measured}
    print_machine(figures)
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
    write(json, figures)
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

    prepare(json)
    figures = bench.run(seconds, rounds, interface, channel)
    print_machine(figures)
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
    write(json, figures)


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
    prepare(json, plot)
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
    print_machine(figures)
    print_must(figures["must"])
    write(json, figures)
    if plot is not None:
        from skinnode.bench.plots.pipeline import draw

        draw(plot, figures)
    lost = not all(row["reached"] for row in figures["must"] if not row["time"])
    if lost or any(row["discrepancies"] for row in figures["rows"]):
        raise typer.Exit(1)


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
    prepare(json)
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
    print_machine(figures)
    write(json, figures)


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
    prepare(json)
    figures = bench.run(seconds, publish_only=publish_only, report=lambda row: None)
    typer.echo(bench.line(figures["total"]))
    print_machine(figures)
    print_must(figures["must"])
    write(json, figures)
    if not all(row["reached"] for row in figures["must"] if not row["time"]):
        raise typer.Exit(1)


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
        prepare(json)
        raise typer.Exit(_soak_on_damaged_cache(json, minutes, seed))
    figures = bench.run(minutes, seed, typer.echo)
    for line in bench.summary_lines(figures):
        typer.echo(line)
    print_must(figures["must"])
    write(json, figures)
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


COMMANDS = (scale, node, pipeline, recording, remote, soak)
"""Commands in the order of the help."""
