"""``skinnode convert SOURCE TARGET``: converts recordings, and computes field tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from skinnode.text.words import counted


def convert(
    source: Annotated[
        Path,
        typer.Argument(
            help="Recording (.mcap, .log, .blf, .asc) or table of fields (.parquet, .npz).", metavar="SOURCE"
        ),
    ],
    target: Annotated[
        Path,
        typer.Argument(
            help="New file; its suffix determines the format. Existing files are never overwritten.",
            metavar="TARGET",
        ),
    ],
    hand: Annotated[
        Path | None,
        typer.Option(
            "--hand",
            help="Hand file for a log without a journal, such as a candump log of another master.",
            metavar="HAND.toml",
        ),
    ] = None,
    frames_only: Annotated[
        bool, typer.Option("--frames-only", help="Do not compute the fields for an MCAP file.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object.")] = False,
) -> None:
    """Convert a recording to another format, or to a table of its fields and resistances.

    Formats with frames: .mcap (MCAP for ROS 2), .log (candump), .blf and .asc (Vector). Field tables:
    .parquet and .npz. The fields are the same as those computed by `skinnode replay`. A note lists the data
    that the target cannot contain. To repair a damaged MCAP file, convert it to a new MCAP file.

    The exit status is 1 if the source is damaged or incomplete, and 2 if it could not be converted.
    """
    from skinnode.config import load_hand
    from skinnode.record.convert import convert as run

    done = run(source, target, hand=None if hand is None else load_hand(hand), frames_only=frames_only)
    if as_json:
        facts = {"target": str(target), "frames": done.frames, "fields": done.fields}
        print(json.dumps({**facts, "notes": done.notes, "faults": done.faults}))
    else:
        contents = counted(done.frames, "frame") if done.frames else ""
        if done.fields or not done.frames:
            contents += f"{', ' if contents else ''}{counted(done.fields, 'field')}"
        print(f"{target}: {contents}")
        for note in done.notes:
            print(f"note: {note}")
        for fault in done.faults:
            print(f"fault: {fault}")
    if done.faults:
        raise typer.Exit(1)
