"""``skinnode demo``: presses simulated patches, reads them over a virtual CAN bus and scores the fields."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinnode.moved import moved

MAX_PATCHES = 16

__getattr__ = moved("skinnode.cli.demo", "skinnode.demo.hand")


def demo(
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Duration of pressing and sliding, in s.", metavar="S")
    ] = 8.0,
    patches: Annotated[
        int,
        typer.Option(min=1, max=MAX_PATCHES, help="Number of patches of 10 × 10 electrodes.", metavar="N"),
    ] = 4,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed for the scene and the converter noise.", metavar="N")
    ] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write all results to this file.", metavar="FILE")
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            help="Plot the true field, the measured field and the error to this file.", metavar="FILE.png"
        ),
    ] = None,
) -> None:
    """Press simulated patches and decode their scans from real CANopen traffic.

    Each patch is a CANopen node on a virtual bus inside this process. A spherical indenter presses and
    slides; the host collects the PDOs and solves the scans. The exit status is 1 if a scan was torn, a frame
    was lost, or errors exceed the reported uncertainty. The limit for the RMS error is 1.15 times the
    reported RMS standard deviation. The limit for a coordinate error is 6 standard deviations.
    """
    import json

    from skinnode.cli._console import console
    from skinnode.demo import plot as demo_plot
    from skinnode.demo import run as demo_run
    from skinnode.demo.hand import demo_hand
    from skinnode.files.output_file import require_writable, write_text
    from skinnode.files.plot_file import require_matplotlib

    for option, file in (("--json", json_file), ("--plot", plot)):
        if file is not None:
            require_writable(option, file)
    if plot is not None:
        require_matplotlib(plot)
    out = console()
    run = demo_run.play(demo_hand(patches, seed), seconds, out)
    demo_run.print_report(out, run.report)
    if json_file is not None:
        write_text(
            "--json", json_file, json.dumps(demo_run.as_json(run.report), indent=2, allow_nan=False) + "\n"
        )
        out.print(f"figures written to {json_file}")
    if plot is not None:
        demo_plot.draw_demo(plot, run.traces)
        out.print(f"plot written to {plot}")
    if run.report.faults:
        raise typer.Exit(1)
