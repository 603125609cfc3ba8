"""``skinnode doctor [HAND.toml]``: finds faults, and prints a certainty and a remedy for each."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import Bitrate, Bus, Channel, Fd, Interface, Json

if TYPE_CHECKING:
    from skinnode.diagnose.facts import BusFacts
    from skinnode.diagnose.root_causes import Group


def doctor(
    hand: Annotated[
        Path | None, typer.Argument(help="Hand file to compare with the buses.", metavar="[HAND.toml]")
    ] = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    fd: Fd = False,
    bus: Bus = None,
    active: Annotated[
        bool,
        typer.Option(
            "--active", help="Start nodes that are not running, and send SYNC if no other node does."
        ),
    ] = False,
    html: Annotated[
        Path | None, typer.Option(help="Write a report with plots to one HTML file.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Examine buses, nodes, configuration, wires, noise, baseline, timing and losses.

    The command only receives frames and reads objects, so it does not disturb a running hand. To test the
    skin, the command needs the scans that the nodes send; with --active, it starts nodes that are not
    running. Do not touch the skin while the command runs. The exit status is 0 if no fault was found, 1 if
    any was found, 2 if the command could not run.
    """
    from skinnode.cli._bus import find_buses
    from skinnode.cli._console import print_json, progress
    from skinnode.diagnose.collect_facts import collect_facts
    from skinnode.diagnose.root_causes import grouped
    from skinnode.files.output_file import require_writable, write_text

    if html is not None:
        from skinnode.files.plot_file import require_matplotlib

        require_writable("--html", html)
        require_matplotlib(Path("report.svg"))
    places = find_buses(interface, channel, bitrate, fd, hand, bus)
    plan, buses = places[0].hand, [place.bus for place in places if place.patches or len(places) == 1]
    with progress(as_json) as tell:
        facts = [collect_facts(item, plan, active=active, progress=tell) for item in buses]
    groups = grouped(facts)
    if html is not None:
        from skinnode.diagnose.html_report import as_html

        write_text("--html", html, as_html(facts, groups, plan.name if plan else facts[0].name))
    if as_json:
        print_json(_as_json(facts, groups))
    else:
        _print(facts, groups)
    if groups:
        raise typer.Exit(1)


def _as_json(facts: list[BusFacts], groups: list[Group]) -> dict[str, object]:
    from dataclasses import asdict

    from skinnode.diagnose.checks.run import not_judged, others

    return {
        "findings": [
            {**asdict(finding), "cause": None if finding is group.cause else f"{cause.where}: {cause.what}"}
            for group in groups
            for cause in (group.cause,)
            for finding in (cause, *group.consequences)
        ],
        "others": [line for known in facts for line in others(known)],
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


def _print(facts: list[BusFacts], groups: list[Group]) -> None:
    from rich.text import Text

    from skinnode.cli._console import console, indented
    from skinnode.diagnose.checks.run import not_judged, others
    from skinnode.diagnose.root_causes import merged
    from skinnode.text.words import counted

    out = console()
    for known in facts:
        there = sum(patch.found is not None for patch in known.patches)
        scans = sum(patch.scans.scans for patch in known.patches if patch.scans is not None)
        rest = (
            f" ({known.interface} {known.channel}): "
            + (f"{there} of {len(known.patches)} patches present, " if known.patches else "no patches, ")
            + f"{counted(known.frames, 'frame')}, "
            f"{counted(scans, 'scan')} in {known.seconds:.1f} s, load {known.load:.0%}"
        )
        out.print(Text.assemble((known.name, "bold"), rest))
        for line in others(known):
            out.print(line)
    colours = {"certain": "red", "likely": "yellow", "possible": "cyan"}
    for group in groups:
        finding, colour = group.cause, colours[group.cause.sure]
        said = f"{finding.where}: {finding.what}"
        out.print(Text.assemble("\n", (f"{finding.sure:>8}", colour), "  ", (said, "bold")))
        out.print(indented(finding.evidence))
        out.print(indented(f"→ {finding.advice}"))
        if group.consequences:
            out.print(indented("probable consequences:"))
        for below, places in merged(group.consequences):
            out.print(indented(f"{', '.join(places)}: {below.what}", 12))
            if len(places) == 1:
                out.print(indented(below.evidence, 14))
    lines = [line for known in facts for line in not_judged(known)]
    if lines:
        out.print("\nnot judged:")
        for line in lines:
            out.print(indented(line))
    out.print(f"\n{_summary(groups)}")


def _summary(groups: list[Group]) -> str:
    from skinnode.text.words import counted

    if not groups:
        return "the checks that were run found no faults"
    below = sum(len(group.consequences) for group in groups)
    causes = counted(len(groups), "finding")
    return f"{causes} with {counted(below, 'consequence')}" if below else causes
