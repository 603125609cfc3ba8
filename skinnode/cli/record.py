"""``skinnode record hand.toml -o FOLDER``: runs a hand and records every frame."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skinnode.cli._options import JsonLines, OtherChannel, OtherInterface, Seconds
from skinnode.process import clock
from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.config import HandConfig
    from skinnode.record import Recorder


def record(
    hand: Annotated[Path, typer.Argument(help="The hand to record.", metavar="HAND.toml")],
    output: Annotated[
        str,  # Path would turn an empty string into the current folder
        typer.Option(
            "--output",
            "-o",
            help="A new file ending in .log, .blf or .mcap; or a folder, created if needed, for a file named "
            "after the hand, the date and the time. Existing files are never overwritten.",
            metavar="FOLDER|FILE",
        ),
    ],
    kind: Annotated[
        Literal["log", "blf", "mcap"],
        typer.Option(
            "--format",
            help="Format of a new file in a folder: candump text, Vector BLF or MCAP.",
            metavar="log|blf|mcap",
        ),
    ] = "log",
    listen: Annotated[
        bool,
        typer.Option("--listen", help="Only record the frames received; do not send frames or solve scans."),
    ] = False,
    interface: OtherInterface = None,
    channel: OtherChannel = None,
    seconds: Seconds = None,
    as_json: JsonLines = False,
) -> None:
    """Run a hand's patches as `skinnode host` does, and record every frame received or sent.

    Play the recording with `skinnode replay`; can-utils and python-can can read it too. An MCAP file also
    contains the fields, contacts, health and events as ROS 2 messages. If the command is killed, at most the
    last second of the recording is lost. A recording made with --listen contains no baselines. To compute its
    fields, copy the log without its journal and replay the copy with --hand. The exit status is 1 if frames
    could not be written or if a fault occurred that `skinnode host` would report, and 2 if the hand could not
    be run.
    """
    from skinnode.config import load_hand
    from skinnode.process.signals import stop_on_signal
    from skinnode.record import Recorder

    plan = load_hand(hand).on(interface, channel)
    with stop_on_signal() as stop, Recorder(plan, output, kind) as recorder:
        _say(as_json, file=str(recorder.path))
        faults = (_listen if listen else _run)(plan, recorder, stop, seconds, as_json)
    stats = recorder.stats()
    counts = {"frames": stats.frames, "dropped": stats.dropped, "failure": stats.failure}
    if recorder.records_fields and not listen:
        counts |= {"fields": stats.fields, "fields_dropped": stats.fields_dropped}
    _say(as_json, **counts)
    for fault in faults:
        _say(as_json, note=f"fault: {fault}")
    if stats.dropped or stats.fields_dropped or stats.failure or faults:
        raise typer.Exit(1)


def _run(
    plan: HandConfig, recorder: Recorder, stop: threading.Event, seconds: float | None, as_json: bool
) -> list[str]:
    """Run and record the hand; return its faults, one line each."""
    from skinnode.cli._run_report import faults_and_notes
    from skinnode.host import BringUpCancelled, Host
    from skinnode.host.scan_solver import check_solvable
    from skinnode.record import followed

    for patch in plan.patches:
        check_solvable(patch, plan.solver, plan.sync.period_s)
    try:
        with Host.from_config(plan, cancelled=stop.is_set, tap=recorder) as running:
            patches = counted(len(plan.patches), "patch", "patches")
            _say(as_json, note=f"{patches} operational; press Ctrl-C to stop")
            with followed(recorder, running), running.fields(capacity=1) as fields:
                _follow(recorder, stop, seconds, as_json, lambda: fields.get(0.0))
            faults, notes = faults_and_notes(running)
            skipped = {name: stream.skipped for name, stream in running.stats().patches.items()}
            notes += [
                f"{name}: {counted(count, 'scan')} skipped in favour of newer scans; "
                "their frames were recorded"
                for name, count in skipped.items()
                if count
            ]
            for note in notes:
                _say(as_json, note=f"note: {note}")
            return faults
    except BringUpCancelled:
        return []


def _listen(
    plan: HandConfig, recorder: Recorder, stop: threading.Event, seconds: float | None, as_json: bool
) -> list[str]:
    from skinnode.errors import SkinError
    from skinnode.host.link import BusLink
    from skinnode.host.mainline import Mainline
    from skinnode.host.tap import tap_link

    failures: list[SkinError] = []
    with ExitStack() as stack:
        links = [stack.enter_context(BusLink(bus, {}, failures.append)) for bus in plan.buses]
        for link in links:
            tap_link(recorder, link)
        stack.enter_context(Mainline(links))
        _say(as_json, note="listening; press Ctrl-C to stop")
        _follow(recorder, stop, seconds, as_json)
    if failures:
        raise failures[0]
    return []


def _follow(
    recorder: Recorder,
    stop: threading.Event,
    seconds: float | None,
    as_json: bool,
    check: Callable[[], object] = lambda: None,
) -> None:
    """Print a line every second until the command is stopped or the duration has elapsed.

    ``check`` is called before each line is printed; its exceptions propagate.
    """
    start_s = clock.monotonic()
    end_s = float("inf") if seconds is None else start_s + seconds
    due_s = start_s + 1.0
    while not stop.wait(max(0.0, min(due_s, end_s) - clock.monotonic())):
        now_s = clock.monotonic()
        check()
        stats = recorder.stats()
        _say(as_json, elapsed_s=round(now_s - start_s, 1), frames=stats.frames, dropped=stats.dropped)
        if now_s >= end_s:
            return
        due_s += 1.0


def _say(as_json: bool, **facts: object) -> None:
    shown = {key: value for key, value in facts.items() if value is not None}
    if as_json:
        print(json.dumps(shown), flush=True)
    elif "note" in shown:
        print(shown["note"], flush=True)
    else:
        print("  ".join(f"{key} {value}" for key, value in shown.items()), flush=True)
