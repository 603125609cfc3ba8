"""``vcan-sim inject``: change the faults of a running simulator, and print the counts of injected faults."""

from __future__ import annotations

from typing import Annotated

import typer

Simulator = Annotated[
    str | None,
    typer.Option(
        help="Process ID of the simulator, or name of its hand. Required if several are running.",
        metavar="PID|HAND",
    ),
]


def inject(
    faults: Annotated[
        list[str] | None,
        typer.Argument(
            help="Faults such as palm:unplugged, palm:lost=0.1, can0:starved=0.5, palm:none or none. "
            "Default: print the current faults.",
            metavar="[[PLACE:]FAULTS]...",
        ),
    ] = None,
    simulator: Simulator = None,
) -> None:
    """Change the faults of a running simulator; print the current faults and the counts of injected faults.

    The faults have the same form as in `vcan-sim run --fault`. Faults that are not listed remain unchanged.
    """
    from vcan_sim.control import request, running_simulator

    answer = request(running_simulator(simulator), faults or [])
    for line in answer.lines():
        print(line, flush=True)
