"""``skinnode demo``: simulated patches pressed, gathered over a virtual CAN bus, decoded and scored.

This is the one place of the package that knows the simulator as well as the host. Both talk only through
the bus; the truth that the simulator keeps is used for the score alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from skinnode.config import HandConfig

MAX_PATCHES = 16
_NAMES = ("palm", "thumb", "index", "middle", "ring", "little", "wrist", "back")
_SYNC_MS_PER_PATCH = 20
"""A 10 × 30 patch takes up to 101 × 135 bits a scan: at 20 ms a patch a plan needs 68 % of 1 Mbit/s."""


def demo(
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="How long to press and slide.", metavar="S")
    ] = 8.0,
    patches: Annotated[
        int, typer.Option(min=1, max=MAX_PATCHES, help="How many patches of 10 × 10 electrodes.", metavar="N")
    ] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Seed of scene and converter noise.", metavar="N")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write all figures to this file.", metavar="FILE")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw truth, field and error to this file.", metavar="FILE.png")
    ] = None,
) -> None:
    """Press simulated patches and decode them from real CANopen traffic.

    Each patch is a CANopen node on an embedded virtual bus; a spherical indenter presses and slides, the
    host gathers the PDOs and solves. Exit status 1 if a scan was torn, a frame lost, or errors lie above the
    uncertainty reported with them: RMS over the run above 1.15 of it, or a coordinate beyond 6 deviations.
    """
    import json

    from skinnode.cli._console import console
    from skinnode.demo import plot as demo_plot
    from skinnode.demo import run as demo_run
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


def demo_hand(patches: int, seed: int) -> HandConfig:
    """The hand of the demo: ``patches`` reference patches on one virtual bus of its own."""
    import uuid

    from skinnode.config import parse_hand

    names = [_NAMES[i] if i < len(_NAMES) else f"patch{i + 1}" for i in range(patches)]
    return parse_hand(
        {
            "name": "demo",
            "buses": [{"name": "can0", "interface": "virtual", "channel": f"demo-{uuid.uuid4().hex[:8]}"}],
            "patches": [
                {"name": name, "node_id": i + 1, "layout": {"preset": "staggered"}}
                for i, name in enumerate(names)
            ],
            "sync": {"period_ms": _SYNC_MS_PER_PATCH * patches},
            "simulation": {"seed": seed, "depth": 0.3},
        }
    )
