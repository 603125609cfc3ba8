"""``skinnode convert SOURCE TARGET``: converts recordings, and computes field tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.config import HandConfig
    from skinnode.record.convert import Conversion

_RRD = ".rrd"
_EXAGGERATION = 10.0
"""Factor by which drawings enlarge displacements, as in ``skinnode view``."""


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
            help="Hand file for a log without a journal, such as a candump log from another master.",
            metavar="HAND.toml",
        ),
    ] = None,
    frames_only: Annotated[
        bool, typer.Option("--frames-only", help="Write only the frames and the journal to an MCAP file.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object.")] = False,
) -> None:
    """Convert a recording to another format, or to a table of its fields and resistances.

    Formats with frames: .mcap (MCAP for ROS 2), .log (candump), .blf and .asc (Vector). Field tables:
    .parquet and .npz. Three-dimensional view: .rrd (Rerun). The fields are the same as those computed by
    `skinnode replay`. A note lists the data that the target cannot contain. To repair a damaged MCAP file,
    convert it to a new MCAP file.

    The exit status is 1 if the source is damaged or incomplete, and 2 if it could not be converted.
    """
    from skinnode.config import load_hand
    from skinnode.errors import ConfigError
    from skinnode.record.convert import TARGETS, ending_in
    from skinnode.record.convert import convert as run
    from skinnode.record.open_recording import FRAME_FILES

    if frames_only and target.suffix != ".mcap":
        raise ConfigError("--frames-only", str(target), "only with an .mcap target")
    plan = None if hand is None else load_hand(hand)
    if source.suffix in FRAME_FILES and target.suffix not in (*TARGETS, _RRD):
        raise ConfigError("target", str(target), ending_in((*TARGETS, _RRD)))
    if source.suffix in FRAME_FILES and target.suffix == _RRD:
        done = _draw(source, target, plan)
    else:
        done = run(source, target, hand=plan, frames_only=frames_only)
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


def _draw(source: Path, target: Path, hand: HandConfig | None) -> Conversion:
    """Draw a recording and save the drawing as a Rerun file."""
    from skinnode.errors import ConfigError
    from skinnode.record.convert import Conversion
    from skinnode.transport.frame_log import create_binary
    from skinnode.view.file_conversion import convert_to_file
    from skinnode.view.viewer_process import require_viewer

    require_viewer("target")
    if target.exists():
        raise ConfigError("target", str(target), "a new file; this one already exists and is not overwritten")
    if not target.parent.is_dir():
        raise ConfigError("target", str(target), "a file in an existing folder")
    create_binary(target).close()  # fails if another command has created the file
    try:
        done = convert_to_file(source, target, exaggeration=_EXAGGERATION, hand=hand)
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    lost = f"{target.name} cannot contain frames or the journal; it cannot be converted back to a recording"
    return Conversion(0, done.counts.drawn, tuple(done.replay.flaws), (*done.replay.notes, lost))
