"""``skinnode monitor``: shows a hand full-screen, or as one line of JSON per second."""

from __future__ import annotations

import json
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import OtherChannel, OtherInterface

if TYPE_CHECKING:
    import threading

    from skinnode.config import HandConfig
    from skinnode.monitor.source import Source

_SIMULATED = 4
"""Number of patches to simulate if no hand file is given."""


def monitor(
    hand: Annotated[
        Path | None, typer.Argument(help="Hand file to run and show.", metavar="[HAND.toml]")
    ] = None,
    interface: OtherInterface = None,
    channel: OtherChannel = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Show a recording made by `skinnode record`.", metavar="RECORDING"),
    ] = None,
    speed: Annotated[
        float | None, typer.Option(help="Speed of --replay: 2 is twice as fast; default 1.", metavar="X")
    ] = None,
    simulate: Annotated[
        bool,
        typer.Option(
            "--simulate",
            help="Simulate pressed patches on a private bus: the hand's patches, or four without a hand.",
        ),
    ] = False,
    output: Annotated[
        str,  # Path would turn an empty string into the current folder
        typer.Option("--output", "-o", help="Folder for recordings made with the key r.", metavar="FOLDER"),
    ] = ".",
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="End after this many seconds; default: run until q is pressed.", metavar="S"
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per second instead of showing a screen.")
    ] = False,
) -> None:
    """Show a hand on the terminal: depth and shear maps, touches, health, rates, load, events.

    The command runs the hand as `skinnode host` does, but waits for missing patches. Keys: 1-9 select a
    patch, z shows only the selected patch, t tares the selected patch, r records, space freezes the picture,
    ? shows help, q quits. The screen requires the optional packages of the extra `tui`. The exit status is 0
    if no fault occurred, 1 if any fault occurred (faults are printed at the end), 2 if the monitor could not
    run.
    """
    from skinnode.errors import NOTHING, ConfigError, Shown

    if not as_json:
        _require_screen()
    if (hand is not None or simulate) == (replay is not None):
        got = NOTHING if replay is None else Shown("both it and --replay")
        raise ConfigError("HAND.toml", got, "one of HAND.toml, --simulate and --replay RECORDING")
    _require_used(interface, channel, speed, played=replay is not None, simulated=simulate)
    if not output or (Path(output).exists() and not Path(output).is_dir()):
        raise ConfigError("--output", output, "a folder name; the first recording creates the folder")
    from skinnode.host import BringUpCancelled
    from skinnode.process.signals import stop_on_signal

    with stop_on_signal() as stop, ExitStack() as stack:
        try:
            if replay is not None:
                source = _recording(stack, replay, 1.0 if speed is None else speed)
            else:
                source = _running(stack, _plan(hand, interface, channel, simulate), stop, simulate, as_json)
        except BringUpCancelled:
            return
        faults = _print(source, stop, seconds) if as_json else _show(source, stop, seconds, Path(output))
        faults = [*faults, *source.flaws]
    for fault in faults:
        print(f"fault: {fault}", file=sys.stderr if as_json else sys.stdout)
    if faults:
        raise typer.Exit(1)


def _require_used(
    interface: str | None, channel: str | None, speed: float | None, *, played: bool, simulated: bool
) -> None:
    """Raise ConfigError for an option without effect on a recording or a simulated hand."""
    from skinnode.errors import ConfigError

    if speed is not None and not played:
        raise ConfigError("--speed", speed, "only with --replay")
    for option, value in (("--interface", interface), ("--channel", channel)):
        if value is not None and (played or simulated):
            allowed = f"only without {'--replay' if played else '--simulate'}, which opens no bus of a hand"
            raise ConfigError(option, value, allowed)


def _require_screen() -> None:
    """Raise ConfigError if there is no terminal or the package textual is not installed."""
    from importlib.util import find_spec

    from skinnode.errors import ConfigError, Shown

    if find_spec("textual") is None:
        allowed = "the package textual (sh install.sh tui), or --json"
        raise ConfigError("skinnode monitor", Shown("no package textual"), allowed)
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigError("standard input and output", Shown("no terminal"), "a terminal, or --json")


def _plan(hand: Path | None, interface: str | None, channel: str | None, simulate: bool) -> HandConfig:
    """Return the hand to run, with settings that make the host wait for missing patches."""
    from skinnode.config import load_hand
    from skinnode.demo.hand import demo_hand

    if hand is not None:
        plan = load_hand(hand).on(interface, channel)
    else:
        plan = demo_hand(_SIMULATED, seed=1)
        # only the method "posterior" computes contact forces
        solver = plan.solver.model_copy(update={"method": "posterior"})
        plan = plan.model_copy(update={"name": "simulated hand", "solver": solver})
    if simulate:
        from skinnode.demo.simulated import on_simulated_buses

        plan = on_simulated_buses(plan)
    waiting = plan.bring_up.model_copy(update={"missing": "wait"})
    return plan.model_copy(update={"bring_up": waiting})


def _running(
    stack: ExitStack, plan: HandConfig, stop: threading.Event, simulate: bool, quiet: bool
) -> Source:
    """Return a monitor source that runs a host; closing ``stack`` also closes the source.

    Raises the same errors as :meth:`Host.from_config`.
    """
    from skinnode.cli._console import progress
    from skinnode.compiled.jit import is_cold
    from skinnode.host import Host
    from skinnode.host.scan_solver import check_solvable
    from skinnode.monitor.source import HostSource
    from skinnode.process.garbage_collection import responsive_threads, without_long_collections
    from skinnode.text.words import counted

    if not quiet:
        import skinnode.monitor.app  # noqa: F401  # slow, so import it before deadlines apply

    with progress(quiet) as tell:
        tell("compiling the kernels once" if is_cold() else "preparing the solvers")
        for patch in plan.patches:
            check_solvable(patch, plan.solver)
        if simulate:
            from skinnode.demo.simulated import simulated

            stack.enter_context(simulated(plan))
        tell(f"bringing up {counted(len(plan.patches), 'patch', 'patches')}")
        stack.enter_context(responsive_threads())
        stack.enter_context(without_long_collections())  # collects garbage now, before the first SYNC
        host = stack.enter_context(Host.from_config(plan, cancelled=stop.is_set))
    return stack.enter_context(HostSource(host))


def _recording(stack: ExitStack, path: Path, speed: float) -> Source:
    """Return a monitor source that plays a recording; closing ``stack`` also closes the source."""
    from skinnode.monitor.source import ReplaySource
    from skinnode.record import replay

    return stack.enter_context(ReplaySource(replay(path, speed=speed)))


def _show(source: Source, stop: threading.Event, seconds: float | None, output: Path) -> list[str]:
    """Show the screen until the user closes it; return the faults found.

    Raises the SkinError that stopped the source.
    """
    from skinnode.monitor.app import MonitorApp, terminal_colours

    app = MonitorApp(
        source, folder=output, colours=terminal_colours(os.environ), over=stop.is_set, seconds=seconds
    )
    app.run(mouse=False)  # without mouse capture, text can be selected and copied
    if app.failure is not None:
        raise app.failure
    if app.return_code:  # the package textual has reported an internal error
        raise typer.Exit(2)
    if app.terminal_is_deaf:  # output would be invisible while the screen is shown
        raise typer.Exit(1 if app.faults.lines else 0)
    return app.faults.lines


def _print(source: Source, stop: threading.Event, seconds: float | None) -> list[str]:
    """Print one JSON line per second and return the faults. Raises the SkinError that stopped the source."""
    from skinnode.monitor.report import FaultBook, watch
    from skinnode.text.json_values import plain

    faults = FaultBook(live=source.live)
    for line in watch(source, stop, seconds, faults):
        print(json.dumps(plain(line)), flush=True)
    return faults.lines
