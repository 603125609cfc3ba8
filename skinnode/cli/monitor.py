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
from skinnode.cli._watched_hand import (
    Remote,
    Replayed,
    Scene,
    Simulate,
    Speed,
    WatchedHand,
    WatchOptions,
    check_options,
    watched,
)
from skinnode.cli._zenoh_options import Router, ZenohConfig, ZenohOptions, ZenohPort

if TYPE_CHECKING:
    import threading

    from skinnode.monitor.source import Source


def monitor(
    hand: WatchedHand = None,
    interface: OtherInterface = None,
    channel: OtherChannel = None,
    replay: Replayed = None,
    speed: Speed = None,
    simulate: Simulate = False,
    scene: Scene = None,
    remote: Remote = None,
    router: Router = None,
    zenoh_config: ZenohConfig = None,
    zenoh_port: ZenohPort = None,
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
    """Show a hand in the terminal: depth and shear maps, touches, health, rates, load, events.

    The command runs the hand as `skinnode host` does, but waits for missing patches. With --remote, it shows
    a hand that another process runs. Keys: 1-9 select a patch, z shows only the selected patch, t tares the
    selected patch, n resets its node, r records, space freezes the picture, ? shows help, q quits. The screen
    requires the optional packages of the `tui` extra. The exit status is 0 if no fault occurred, 1 if any
    fault occurred (faults are printed at the end), 2 if the monitor could not run.
    """
    from skinnode.cli._console import progress
    from skinnode.errors import ConfigError

    if not as_json:
        _require_screen()
    zenoh = ZenohOptions(router, zenoh_config, zenoh_port)
    options = WatchOptions(hand, interface, channel, replay, speed, simulate, scene, remote, zenoh)
    check_options(options)
    if not output or (Path(output).exists() and not Path(output).is_dir()):
        raise ConfigError("--output", output, "a folder name; the first recording creates the folder")
    from skinnode.host import BringUpCancelled
    from skinnode.process.signals import stop_on_signal

    with ExitStack() as opened:
        with progress(as_json) as tell:
            source_of = opened.enter_context(watched(options, tell))
        stop = opened.enter_context(stop_on_signal())
        stack = opened.enter_context(ExitStack())
        if not as_json:
            import skinnode.monitor.app  # noqa: F401  # slow, so import it before deadlines apply
        try:
            with progress(as_json) as tell:
                source = source_of.start(stack, stop, tell)
        except BringUpCancelled:
            return
        faults = _print(source, stop, seconds) if as_json else _show(source, stop, seconds, Path(output))
        faults = [*faults, *source.flaws]
    for fault in faults:
        print(f"fault: {fault}", file=sys.stderr if as_json else sys.stdout)
    if faults:
        raise typer.Exit(1)


def _require_screen() -> None:
    """Raise ConfigError if there is no terminal or the package textual is not installed."""
    from importlib.util import find_spec

    from skinnode.errors import ConfigError, Shown

    if find_spec("textual") is None:
        allowed = "the package textual (sh install.sh tui), or --json"
        raise ConfigError("skinnode monitor", Shown("no package textual"), allowed)
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigError("standard input and output", Shown("no terminal"), "a terminal, or --json")


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
        raise typer.Exit(1 if app.faults.lines or source.flaws else 0)
    return app.faults.lines


def _print(source: Source, stop: threading.Event, seconds: float | None) -> list[str]:
    """Print one JSON line per second and return the faults. Raises the SkinError that stopped the source."""
    from skinnode.monitor.session_faults import FaultBook, watch
    from skinnode.text.json_values import plain

    faults = FaultBook(live=source.live)
    for line in watch(source, stop, seconds, faults):
        print(json.dumps(plain(line)), flush=True)
    return faults.lines
