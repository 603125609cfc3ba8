"""``skinnode view``: shows a hand in 3-D in a window or a browser, or saves the drawing to a file."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from skinnode.cli._options import OtherChannel, OtherInterface, Seconds
from skinnode.cli._watched_hand import (
    Remote,
    Replayed,
    Scene,
    Simulate,
    Speed,
    WatchedHand,
    WatchedSource,
    WatchOptions,
    check_options,
    watched,
)
from skinnode.cli._zenoh_options import Router, ZenohConfig, ZenohOptions, ZenohPort

if TYPE_CHECKING:
    import threading

    from skinnode.errors import SkinError
    from skinnode.monitor.source import Source
    from skinnode.view.drawing_process import DrawingProcess
    from skinnode.view.drawing_thread import DrawingThread
    from skinnode.view.outputs import Output, OutputOptions
    from skinnode.view.texts import DrawnCounts
    from skinnode.view.viewer_process import ViewerProcess

_LOOK_S = 0.1
"""Interval at which the viewer is checked, in s."""
_PORTS = 65_534


class _Drawing(NamedTuple):
    """Drawing options."""

    output: OutputOptions
    rate_hz: float
    exaggeration: float
    seconds: float | None


def view(
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
    web: Annotated[
        bool, typer.Option("--web", help="Show the hand in a browser instead of a window.")
    ] = False,
    address: Annotated[
        str | None,
        typer.Option(
            help="Address on which --web listens; default 127.0.0.1, which only this machine can reach.",
            metavar="IP",
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            min=1, max=_PORTS, help="Port for --web; default 9090. The next port is used too.", metavar="PORT"
        ),
    ] = None,
    save: Annotated[
        str | None,
        typer.Option(
            help="Write a new file for `rerun FILE.rrd` instead of opening a window.", metavar="FILE.rrd"
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            min=0.1, max=1000.0, help="Maximum drawing rate of each patch, in Hz; default 30.", metavar="HZ"
        ),
    ] = None,
    exaggerate: Annotated[
        float,
        typer.Option(min=0.0, max=1000.0, help="Factor by which to enlarge displacements.", metavar="X"),
    ] = 10.0,
    seconds: Seconds = None,
) -> None:
    """Show a hand in 3-D: pressed surfaces, shear, contacts and forces, health, events and plots over time.

    The command runs the hand like `skinnode host`, but waits for missing patches. With --remote, it shows a
    hand that another process runs. With neither --web nor --save, it opens a window and ends when the window
    is closed. With only --replay and --save, it converts the whole recording as fast as possible. Requires
    the optional packages of the `view` extra. The exit status is 0 if no fault occurred, 1 if any fault
    occurred (the faults are printed at the end), and 2 if the command could not run.
    """
    from skinnode.errors import ConfigError

    _require_viewer()
    zenoh = ZenohOptions(router, zenoh_config, zenoh_port)
    options = WatchOptions(hand, interface, channel, replay, speed, simulate, scene, remote, zenoh)
    check_options(options)
    for option, value in (("--address", address), ("--port", port)):
        if value is not None and not web:
            raise ConfigError(option, value, "only with --web")
    from skinnode.view.outputs import PORT, SUFFIX, OutputOptions
    from skinnode.view.viewer_process import LOCAL

    if save is not None and not save.endswith(SUFFIX):  # Path would turn an empty string into a folder
        raise ConfigError("--save", save, f"a file name that ends in {SUFFIX}")
    outputs = OutputOptions(
        window=not web and save is None,
        web=web,
        save=None if save is None else Path(save),
        address=LOCAL if address is None else address,
        port=PORT if port is None else port,
    )
    converts = replay is not None and save is not None and speed is None and not web
    for option, number in (("--rate", rate), ("--seconds", seconds)):
        if number is not None and converts:
            allowed = "with --replay and --save only together with --speed; otherwise, all fields are drawn"
            raise ConfigError(option, number, allowed)
    from skinnode.process.signals import stop_on_signal
    from skinnode.view.drawing_thread import RATE_HZ

    drawing = _Drawing(outputs, RATE_HZ if rate is None else rate, exaggerate, seconds)
    if converts:
        assert replay is not None
        assert save is not None
        with stop_on_signal() as stop:
            faults, counts = _convert(replay, Path(save), stop, exaggerate)
    else:
        shown = _watch(options, drawing)
        if shown is None:
            return
        faults, counts = shown
    _report(faults, counts)


def _require_viewer() -> None:
    from skinnode.view.viewer_process import require_viewer

    require_viewer()


def _open(stack: ExitStack, options: OutputOptions) -> Output:
    """Open the output; called before the hand is opened, so that a port in use is reported immediately."""
    from skinnode.view.outputs import open_output

    output = stack.enter_context(open_output(options))
    if output.page_url is not None:
        print(f"open {output.page_url} in a browser; press Ctrl-C to stop", flush=True)
    return output


def _watch(options: WatchOptions, drawing: _Drawing) -> tuple[list[str], DrawnCounts] | None:
    """Draw a hand until drawing stops; return the faults and field counts, or None if cancelled."""
    from skinnode.cli._console import progress
    from skinnode.host import BringUpCancelled
    from skinnode.process.signals import stop_on_signal

    with ExitStack() as opened:
        with progress() as tell:
            source_of = opened.enter_context(watched(options, tell))
        stop = opened.enter_context(stop_on_signal())
        stack = opened.enter_context(ExitStack())
        output = _open(stack, drawing.output)
        unused = stack.enter_context(ExitStack())
        if output.save is not None:  # a file without fields would make a retry fail
            unused.callback(output.save.unlink, missing_ok=True)
        process = _draw_on(stack, output, source_of, drawing)
        try:
            with progress() as tell:
                source = source_of.start(stack, stop, tell)
        except BringUpCancelled:
            return None
        unused.pop_all()
        return _show(output, process, source, stop, drawing)


def _draw_on(stack: ExitStack, output: Output, source_of: WatchedSource, drawing: _Drawing) -> DrawingProcess:
    from skinnode.view.drawing_process import DrawingOptions, DrawingProcess

    options = DrawingOptions(drawing.exaggeration, source_of.wall_minus_mono_ns, live=True)
    return stack.enter_context(DrawingProcess(source_of.hand, output.target(source_of.name), options))


def _show(
    output: Output,
    process: DrawingProcess,
    source: Source,
    stop: threading.Event,
    drawing: _Drawing,
) -> tuple[list[str], DrawnCounts]:
    """Draw the source's fields until drawing stops; return the faults and the field counts."""
    from skinnode.view.drawing_thread import DrawingThread

    with DrawingThread(source, process.draw, rate_hz=drawing.rate_hz) as thread:
        _wait(source, output, thread, stop, drawing.seconds)
    if thread.failure is not None:
        if output.viewer is not None and output.viewer.ended:
            raise _viewer_ended(output.viewer)
        raise thread.failure
    return [*thread.faults.lines, *source.flaws], thread.counts


def _wait(
    source: Source, output: Output, thread: DrawingThread, stop: threading.Event, seconds: float | None
) -> None:
    """Wait until the user, the time limit, the viewer, an error or the recording's end stops the drawing."""
    import time

    end_s = None if seconds is None else time.monotonic() + seconds
    over = False
    while not stop.wait(_LOOK_S) and thread.failure is None:
        if end_s is not None and time.monotonic() >= end_s:
            return
        if source.over and output.viewer is None:
            return
        if source.over and not over:
            over = True
            print("end of the recording; press Ctrl-C to stop", flush=True)
        if output.viewer is not None and output.viewer.ended:
            if output.page_url is None and output.viewer.closed:  # by the user
                return
            raise _viewer_ended(output.viewer)


def _viewer_ended(viewer: ViewerProcess) -> SkinError:
    from skinnode.errors import SkinError

    return SkinError(f"the viewer ended: {viewer.why()}")


def _convert(
    path: Path, save: Path, stop: threading.Event, exaggeration: float
) -> tuple[list[str], DrawnCounts]:
    """Write a whole recording to a file; return its faults and the field counts."""
    from skinnode.view.file_conversion import convert_to_file
    from skinnode.view.outputs import require_new_file

    require_new_file(save)
    done = convert_to_file(path, save, exaggeration=exaggeration, cancelled=stop.is_set)
    return [*done.faults.lines, *done.replay.flaws], done.counts


def _report(faults: list[str], counts: DrawnCounts) -> None:
    print(
        f"{counts.drawn} fields drawn, {counts.left_out} left out in favour of newer fields, "
        f"{counts.dropped} dropped because drawing was too slow"
    )
    for fault in faults:
        print(f"fault: {fault}", file=sys.stdout)
    if faults:
        raise typer.Exit(1)
