"""Typer application ``skinnode`` with all subcommands."""

from __future__ import annotations

from typing import Annotated

import typer

from skinnode.cli import (
    bench,
    conformance,
    convert,
    demo,
    doctor,
    eds,
    hand,
    host,
    info,
    lss,
    monitor,
    nmt,
    node,
    od,
    record,
    replay,
    resolve,
    scan,
    tare,
    view,
)
from skinnode.cli._help import App

app = App(
    name="skinnode",
    help="Run robot skin on a CAN bus: measure how skin patches deform when they are pressed.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command(name="demo")(demo.demo)
app.command(name="host")(host.host)
app.add_typer(hand.app, name="hand")
app.command(name="node")(node.node)
app.command(name="eds")(eds.eds)
app.command(name="scan")(scan.scan)
app.command(name="info")(info.info)
app.command(name="od")(od.od)
app.command(name="nmt")(nmt.nmt)
app.command(name="tare")(tare.tare)
app.add_typer(lss.app, name="lss")
app.command(name="monitor")(monitor.monitor)
app.command(name="view")(view.view)
app.command(name="doctor")(doctor.doctor)
app.command(name="record")(record.record)
app.command(name="replay")(replay.replay)
app.command(name="convert")(convert.convert)
app.command(name="resolve")(resolve.resolve)
app.command(name="conformance")(conformance.conformance)
app.add_typer(bench.app, name="bench")


def _print_version(wanted: bool) -> None:
    if wanted:
        from skinnode import __version__

        typer.echo(f"skinnode {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass
