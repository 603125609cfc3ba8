"""``skinnode host hand.toml``: brings a hand up, solves its scans and reports every second."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import JsonLines, OtherChannel, OtherInterface, Seconds
from skinnode.cli._publish import AskedPublication, Commands, Listen, Publish, asked_publication
from skinnode.cli._zenoh_options import Router, ZenohConfig, ZenohOptions
from skinnode.process import clock

if TYPE_CHECKING:
    from skinnode.cli._run_report import Report
    from skinnode.config import HandConfig
    from skinnode.host import Host
    from skinnode.host.events import EventSubscription

_LONGEST_WAIT_S = 0.1
"""Maximum delay before the command reacts to Ctrl-C, in s."""


def host(
    hand: Annotated[Path, typer.Argument(help="Hand file to run.", metavar="HAND.toml")],
    interface: OtherInterface = None,
    channel: OtherChannel = None,
    seconds: Seconds = None,
    as_json: JsonLines = False,
    publish: Publish = False,
    commands: Commands = False,
    listen: Listen = None,
    router: Router = None,
    zenoh_config: ZenohConfig = None,
    zenoh_port: Annotated[
        int | None,
        typer.Option(
            "--zenoh-port",
            "--port",
            help="First of the 16 ports used by daemons on this machine; default 17447.",
            metavar="PORT",
        ),
    ] = None,
) -> None:
    """Bring up a hand's patches as the CANopen manager, compute displacement fields and report every second.

    Onsets and releases of touches are reported when they happen. With --json, each patch has `touched`,
    `touch_odds` and `contacts` (null before the first field): centroid, area, normal and shear force with
    standard deviations, in m, m² and N. With --publish, other processes can use the hand (sk.connect in
    Python, or ROS 2 via rmw_zenoh). Ctrl-C ends the command and leaves the nodes pre-operational. The exit
    status is 1 if a patch was not operational at the end, an interface failed or reported errors, or a guest
    received no SYNC. The exit status is also 1 if a scan was torn or a frame was lost, unless the node
    reported that its computer was too slow. The exit status is 2 if the hand could not be run, or if a node
    sent frames whose content does not match their identifier.
    """
    from skinnode.config import load_hand

    plan = load_hand(hand).on(interface, channel)  # before the imports that take a second
    connections = ZenohOptions(router, zenoh_config, zenoh_port, listen)
    published = asked_publication(connections, publish=publish, commands=commands)
    from skinnode.cli._run_report import JsonReport, TextReport
    from skinnode.compiled.jit import is_cold
    from skinnode.host.scan_solver import check_solvable
    from skinnode.process.signals import stop_on_signal

    report = JsonReport() if as_json else TextReport()
    if is_cold():
        report.note("compiling the kernels once; this takes a few seconds")
    for patch in plan.patches:  # no resource is open yet, so Ctrl-C may end the program at once
        check_solvable(patch, plan.solver, plan.sync.period_s)
    with stop_on_signal() as stop, published.claimed(plan):  # refused before the bring-up
        status = _run(plan, seconds, report, stop, published)
    if status:
        raise typer.Exit(status)


def _run(
    plan: HandConfig,
    seconds: float | None,
    report: Report,
    stop: threading.Event,
    published: AskedPublication,
) -> int:
    """Run the hand until the host is stopped or the duration has elapsed, and return the exit status.

    The host logs each frame whose content does not match its identifier; Python prints the log on stderr.
    """
    from skinnode.cli._run_report import exit_status, faults_and_notes, final_state_text, operational_text
    from skinnode.host import BringUpCancelled, Host
    from skinnode.process.garbage_collection import without_long_collections

    try:
        with without_long_collections(), Host.from_config(plan, cancelled=stop.is_set) as running:
            where = ", ".join(f"{bus.name} ({bus.interface} {bus.channel})" for bus in plan.buses)
            report.note(f"{operational_text(running)} on {where}; press Ctrl-C to stop")
            with published.running(running, report):
                _watch(running, stop, seconds, report)
            faults, notes = faults_and_notes(running)
    except BringUpCancelled:
        return 0
    report.note(final_state_text(plan))
    for note in notes:
        report.note(f"note: {note}")
    for fault in faults:
        report.note(f"fault: {fault}")
    return exit_status(running, faults)


def _note_touches(events: EventSubscription, report: Report) -> None:
    """Report the onsets and releases since the previous call."""
    while (event := events.get(0.0)) is not None:
        if event.what in ("touched", "released"):
            report.note(str(event))


def _watch(running: Host, stop: threading.Event, seconds: float | None, report: Report) -> None:
    """Collect the fields; report touches as they happen, and the host's state every second."""
    from skinnode.cli._run_report import Second

    start_s = clock.monotonic()
    end_s = float("inf") if seconds is None else start_s + seconds
    latencies_s: list[float] = []
    events = running.events()
    with running.fields() as fields:
        before, due_s = running.stats(), start_s + 1.0
        while not stop.is_set():
            _note_touches(events, report)
            now_s = clock.monotonic()
            if now_s >= min(due_s, end_s):
                now = running.stats()
                report.second(Second(running, now_s - start_s, before, now, latencies_s, fields.dropped))
                before, latencies_s, due_s = now, [], due_s + 1.0
                if now_s >= end_s:
                    return
            field = fields.get(max(0.0, min(due_s, end_s, now_s + _LONGEST_WAIT_S) - now_s))
            if field is not None and field.stamp is not None:
                latencies_s.append((field.stamp.t_solved_ns - field.stamp.t_receive_ns) * 1e-9)
