"""Options and sources shared by the commands that watch a hand: ``monitor`` and ``view``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable
    from contextlib import ExitStack

    from skinnode.config import HandConfig
    from skinnode.monitor.source import Source

_SIMULATED = 4
"""Number of patches to simulate if no hand file is given."""

WatchedHand = Annotated[Path | None, typer.Argument(help="Hand file to run and show.", metavar="[HAND.toml]")]
Replayed = Annotated[
    Path | None,
    typer.Option("--replay", help="Show a recording made by `skinnode record`.", metavar="RECORDING"),
]
Speed = Annotated[
    float | None, typer.Option(help="Speed of --replay: 2 is twice as fast; default 1.", metavar="X")
]
Simulate = Annotated[
    bool,
    typer.Option(
        "--simulate",
        help="Simulate pressed patches on a private bus: the hand's patches, or four without a hand.",
    ),
]


def require_one_source(hand: Path | None, replay: Path | None, *, simulate: bool) -> None:
    """Raise ConfigError unless the options select exactly one source: a hand or a recording."""
    from skinnode.errors import NOTHING, ConfigError, Shown

    if (hand is not None or simulate) == (replay is not None):
        got = NOTHING if replay is None else Shown("both it and --replay")
        raise ConfigError("HAND.toml", got, "one of HAND.toml, --simulate and --replay RECORDING")


def require_used(
    interface: str | None, channel: str | None, speed: float | None, *, played: bool, simulated: bool
) -> None:
    """Raise ConfigError if an option would have no effect on a recording or a simulated hand."""
    from skinnode.errors import ConfigError

    if speed is not None and not played:
        raise ConfigError("--speed", speed, "only with --replay")
    for option, value in (("--interface", interface), ("--channel", channel)):
        if value is not None and (played or simulated):
            allowed = f"only without {'--replay' if played else '--simulate'}, which opens no bus of a hand"
            raise ConfigError(option, value, allowed)


def plan_of(hand: Path | None, interface: str | None, channel: str | None, simulate: bool) -> HandConfig:
    """Return the hand to run, with settings that make the host wait for missing patches."""
    from skinnode.config import load_hand
    from skinnode.demo.hand import demo_hand

    if hand is not None:
        plan = load_hand(hand).on(interface, channel)
    else:
        plan = demo_hand(_SIMULATED, seed=1)
        # only the "posterior" method computes contact forces
        solver = plan.solver.model_copy(update={"method": "posterior"})
        plan = plan.model_copy(update={"name": "simulated hand", "solver": solver})
    if simulate:
        from skinnode.demo.simulated import on_simulated_buses

        plan = on_simulated_buses(plan)
    waiting = plan.bring_up.model_copy(update={"missing": "wait"})
    return plan.model_copy(update={"bring_up": waiting})


def running(
    stack: ExitStack,
    plan: HandConfig,
    stop: threading.Event,
    *,
    simulate: bool,
    tell: Callable[[str], None],
) -> Source:
    """Return a source that runs a host; closing ``stack`` also closes the source.

    Raises the same errors as :meth:`Host.from_config`.

    Args:
        stack: Stack that closes the resources opened here.
        plan: The hand.
        stop: Event that cancels the start.
        simulate: Whether to simulate the patches.
        tell: Function that displays the current step.
    """
    from skinnode.compiled.jit import is_cold
    from skinnode.host import Host
    from skinnode.host.scan_solver import check_solvable
    from skinnode.monitor.source import HostSource
    from skinnode.process.garbage_collection import responsive_threads, without_long_collections
    from skinnode.text.words import counted

    tell("compiling the kernels once" if is_cold() else "preparing the solvers")
    for patch in plan.patches:
        check_solvable(patch, plan.solver, plan.sync.period_s)
    if simulate:
        from skinnode.demo.simulated import simulated

        stack.enter_context(simulated(plan))
    tell(f"bringing up {counted(len(plan.patches), 'patch', 'patches')}")
    stack.enter_context(responsive_threads())
    stack.enter_context(without_long_collections())  # collects garbage now, before the first SYNC
    host = stack.enter_context(Host.from_config(plan, cancelled=stop.is_set))
    return stack.enter_context(HostSource(host))


def recording(stack: ExitStack, path: Path, speed: float) -> Source:
    """Return a source that plays a recording; closing ``stack`` also closes the source."""
    from skinnode.monitor.source import ReplaySource
    from skinnode.record import replay

    return stack.enter_context(ReplaySource(replay(path, speed=speed)))
