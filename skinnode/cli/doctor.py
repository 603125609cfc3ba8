"""``skinnode doctor [HAND.toml]``: what is wrong, how sure that is, and what to do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._bus import Bitrate, Bus, Channel, Fd, Interface, Json

if TYPE_CHECKING:
    from skinnode.doctor.facts import BusFacts, Finding


def doctor(
    hand: Annotated[Path | None, typer.Argument(help="What should be there.", metavar="[HAND.toml]")] = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    bus: Bus = None,
    active: Annotated[
        bool,
        typer.Option("--active", help="Start nodes that do not run, and send SYNC where nobody does."),
    ] = False,
    html: Annotated[
        Path | None, typer.Option(help="Write a report with plots, one file.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Examine buses, nodes, configuration, wires, noise, baseline, timing and losses.

    It listens and reads, and does not disturb a hand that runs. The skin is judged
    from scans: of a hand that does not run there are none without --active. Leave
    the skin alone meanwhile. Exit status 0 if nothing was found, 1 if something
    was, 2 if it could not run.
    """
    from skinnode.cli._bus import find_bus, find_hand
    from skinnode.cli._console import print_json, progress
    from skinnode.cli._files import require_writable, write_text
    from skinnode.doctor.checks import diagnose
    from skinnode.doctor.gather import gather

    if html is not None:
        from skinnode.cli._plot import require_matplotlib

        require_writable("--html", html)
        require_matplotlib(Path("report.svg"))
    if hand is None or bus is not None:
        place = find_bus(interface, channel, bitrate, fd, hand, bus)
        plan, buses = place.hand, [place.bus]
    else:
        plan = find_hand(hand, interface, channel, bitrate, fd)
        buses = [item for item in plan.buses if plan.patches_on(item.name)]
    with progress(as_json) as tell:
        facts = [gather(item, plan, active=active, progress=tell) for item in buses]
    findings = [finding for known in facts for finding in diagnose(known)]
    if html is not None:
        from skinnode.doctor.page import as_html

        write_text("--html", html, as_html(facts, findings, plan.name if plan else facts[0].name))
    if as_json:
        print_json(_as_json(facts, findings))
    else:
        _print(facts, findings)
    if findings:
        raise typer.Exit(1)


def _as_json(facts: list[BusFacts], findings: list[Finding]) -> dict[str, object]:
    from dataclasses import asdict

    from skinnode.doctor.checks import not_judged

    return {
        "findings": [asdict(finding) for finding in findings],
        "not_judged": [line for known in facts for line in not_judged(known)],
        "buses": [
            {
                "name": known.name,
                "seconds": round(known.seconds, 3),
                "frames": known.frames,
                "load": known.load,
                "dropped": known.dropped,
                "patches": {
                    patch.name: {
                        "node_id": patch.node_id,
                        "state": None if patch.found is None else patch.found.state,
                        "scans": 0 if patch.scans is None else patch.scans.scans,
                    }
                    for patch in known.patches
                },
            }
            for known in facts
        ],
    }


def _print(facts: list[BusFacts], findings: list[Finding]) -> None:
    from rich.markup import escape
    from rich.padding import Padding

    from skinnode.cli._console import console
    from skinnode.doctor.checks import not_judged
    from skinnode.words import counted

    out = console()
    for known in facts:
        there = sum(patch.found is not None for patch in known.patches)
        scans = sum(patch.scans.scans for patch in known.patches if patch.scans is not None)
        out.print(
            f"[bold]{escape(known.name)}[/bold] ({escape(f'{known.interface} {known.channel}')}): {there} of "
            f"{len(known.patches)} patches there, {counted(known.frames, 'frame')}, "
            f"{counted(scans, 'scan')} in {known.seconds:.1f} s, load {known.load:.0%}"
        )
    colours = {"certain": "red", "likely": "yellow", "possible": "cyan"}
    for finding in findings:
        colour = colours[finding.sure]
        what = escape(f"{finding.where}: {finding.what}")
        out.print(f"\n[{colour}]{finding.sure:>8}[/{colour}]  [bold]{what}[/bold]")
        out.print(Padding(escape(finding.evidence), (0, 0, 0, 10)))
        out.print(Padding(f"→ {escape(finding.advice)}", (0, 0, 0, 10)))
    lines = [line for known in facts for line in not_judged(known)]
    if lines:
        out.print("\nnot judged:")
        for line in lines:
            out.print(Padding(escape(line), (0, 0, 0, 10)))
    out.print(
        f"\n{counted(len(findings), 'finding')}" if findings else "\nnothing is wrong with what was looked at"
    )
