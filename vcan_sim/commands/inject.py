"""``vcan-sim inject``: change the faults of a running simulator, and print the counts of injected faults."""

from __future__ import annotations

from typing import Annotated

import typer

Simulator = Annotated[
    str | None,
    typer.Option(
        help="Process-ID of the simulator, or name of its hand; required if several simulators run.",
        metavar="PID|HAND",
    ),
]


def inject(
    faults: Annotated[
        list[str] | None,
        typer.Argument(
            help="Faults such as palm:unplugged, palm:lost=0.1, can0:starved=0.5, palm:none or none. "
            "Default: print the faults without a change.",
            metavar="[[PLACE:]FAULTS]...",
        ),
    ] = None,
    simulator: Simulator = None,
) -> None:
    """Change the faults of a simulator that runs in another terminal, and print all faults and their counts.

    Write faults as for `vcan-sim run --fault`. Faults that are not named do not change.
    """
    from vcan_sim.control import request, running_simulator

    answer = request(running_simulator(simulator), faults or [])
    for line in answer.lines():
        print(line, flush=True)
