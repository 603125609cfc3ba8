"""``skinnode conformance``: tests a CANopen node for conformance to CiA 301, case by case."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import node_ids

if TYPE_CHECKING:
    from skinnode.conformance import Eds, Report


def conformance(
    node_id: Annotated[
        int | None,
        typer.Option(
            min=1, max=127, help="Node-ID of the node to test.", metavar="N", autocompletion=node_ids
        ),
    ] = None,
    interface: Annotated[str, typer.Option(help="python-can interface.", metavar="NAME")] = "socketcan",
    channel: Annotated[str, typer.Option(help="Channel of the interface.", metavar="NAME")] = "can0",
    bitrate: Annotated[int, typer.Option(help="Bits per second.", metavar="BPS")] = 1_000_000,
    fd: Annotated[bool, typer.Option("--fd", help="Send PDOs in CAN FD frames.")] = False,
    eds: Annotated[
        Path | None,
        typer.Option(help="EDS of the node; not needed for a patch of this project.", metavar="FILE"),
    ] = None,
    only: Annotated[
        str, typer.Option(help="Areas and cases, separated by commas, such as SDO,PDO-03.", metavar="NAMES")
    ] = "",
    junit: Annotated[Path | None, typer.Option(help="Write JUnit XML to this file.", metavar="FILE")] = None,
    html: Annotated[Path | None, typer.Option(help="Write an HTML report.", metavar="FILE")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write all results and frames as JSON.", metavar="FILE")
    ] = None,
    list_cases: Annotated[
        bool, typer.Option("--list", help="Print the IDs, titles and clauses of the cases, and exit.")
    ] = False,
) -> None:
    """Test a node against CiA 301 with raw frames; print one line for each case.

    The command RESETS the node many times, starts and stops it, remaps its PDOs, and stores and restores its
    parameters. The node's configuration is read first and restored at the end. The command addresses some
    messages to all nodes, and sends frames that appear to come from other nodes. Use a bus without another
    master and preferably without any other node, on a machine that can be stopped safely.

    The exit status is 0 if no case failed, 1 if any failed, 2 if the tests could not run.
    """
    from skinnode.cli._bus import find_bus
    from skinnode.conformance import connect, run_cases, select
    from skinnode.conformance.report import list_lines, result_line, summary_line
    from skinnode.errors import ConfigError
    from skinnode.files.output_file import require_writable
    from skinnode.transport import CanPort

    cases = select(only.split(",") if only else ())
    if list_cases:
        typer.echo("\n".join(list_lines(cases)))
        return
    if node_id is None:
        raise ConfigError("--node-id", None, "1 to 127")
    for option, file in (("--junit", junit), ("--html", html), ("--json", json_file)):
        if file is not None:
            require_writable(option, file)
    sheet = None if eds is None else _sheet(eds)
    bus = find_bus(interface, channel, bitrate, fd, None, None).bus
    with CanPort(bus) as port:
        dut = connect(port, node_id, sheet)
        report = run_cases(dut, cases, lambda result: typer.echo(result_line(result)))
    for problem in report.problems:
        typer.echo(f"note: {problem}")
    typer.echo(summary_line(report))
    _write(report, f"node {node_id} on {interface} {channel}", junit, html, json_file)
    if report.failed:
        raise typer.Exit(1)


def _sheet(file: Path) -> Eds:
    from skinnode.conformance import parse_eds_file

    return parse_eds_file(file, "--eds")[0]


def _write(report: Report, title: str, junit: Path | None, html: Path | None, json_file: Path | None) -> None:
    import datetime
    import json

    from skinnode.conformance.html_report import as_html
    from skinnode.conformance.report import as_json, as_junit
    from skinnode.files.output_file import write_text

    if junit is not None:
        write_text("--junit", junit, as_junit(report))
    if html is not None:
        write_text("--html", html, as_html(report, title, datetime.datetime.now().astimezone()))
    if json_file is not None:
        write_text("--json", json_file, json.dumps(as_json(report), indent=2) + "\n")
