"""``skinnode replay RECORDING``: decodes and solves a recording with the same code as a live host."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from skinnode.model.frames import FieldFrame
    from skinnode.record import Replay


_NO_BASELINES = (
    "the recording contains no baselines, as after skinnode record --listen; to compute fields, replay a "
    "copy of the log without its journal with --hand"
)


def replay(
    recording: Annotated[
        Path,
        typer.Argument(
            help="The .mcap, .log, .blf or .asc file of the recording. The journal (.jsonl) of a file other "
            "than .mcap must be in the same folder.",
            metavar="RECORDING",
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
    speed: Annotated[
        float | None,
        typer.Option(
            help="Playback speed: 1 is as recorded, 2 is twice as fast.", metavar="X", show_default="1"
        ),
    ] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Play as fast as the scans can be solved.")] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print a JSON object for each field, and an object with the counters at the end."
        ),
    ] = False,
) -> None:
    """Decode and solve a recording made by `skinnode record`; results are bit-identical to the live run.

    With --hand, decode a log recorded by another program. Its scans are solved with the layouts and baselines
    from the hand file; the first scans may lack history that a live host would have had.

    With --json, each field has `contacts`: centroid, area, normal and shear force with standard deviations,
    in m, m² and N.

    The exit status is 1 if the recording is damaged, was not closed properly, lacks frames or contains error
    frames. The exit status is also 1 if a scan was torn or missed, or if a chunk or summary was lost. The
    exit status is 2 if the recording cannot be read.
    """
    from skinnode.config import load_hand
    from skinnode.errors import ConfigError
    from skinnode.process.signals import stop_on_signal
    from skinnode.record import replay as play

    if fast and speed is not None:
        raise ConfigError("--speed", speed, "no speed with --fast")
    plan = None if hand is None else load_hand(hand)
    factor = None if fast else 1.0 if speed is None else speed
    with stop_on_signal() as stop:
        run = play(recording, speed=factor, cancelled=stop.is_set, hand=plan)
        deepest_m = {patch.name: 0.0 for patch in run.hand.patches}
        for field in run:
            assert field.stamp is not None  # the host timestamps every field
            if as_json:
                print(json.dumps(field_table(field)), flush=not fast)
            depth_m = float(-field.displacement_m[..., 2].min())
            deepest_m[field.stamp.patch] = max(deepest_m[field.stamp.patch], depth_m)
    faults = _faults(run)
    notes = run.notes if run.has_baselines else (*run.notes, _NO_BASELINES)
    if as_json:
        noted = {"notes": notes} if notes else {}
        print(json.dumps({"patches": _patches(run, deepest_m), **noted, "faults": faults}))
    else:
        for name, facts in _patches(run, deepest_m).items():
            depth_m = facts.pop("deepest_m")
            counts = "  ".join(f"{key} {value}" for key, value in facts.items())
            print(f"{name}  {counts}  deepest {1e6 * depth_m:.1f} µm")
        for note in notes:
            print(f"note: {note}")
        for fault in faults:
            print(f"fault: {fault}")
    if faults:
        raise typer.Exit(1)


def field_table(field: FieldFrame) -> dict[str, Any]:
    """Return a field as JSON-compatible data; numbers keep their full precision."""
    from skinnode.cli._contacts import contact_tables
    from skinnode.host.trust_report import trust_table

    stamp = field.stamp
    assert stamp is not None
    return {
        "patch": stamp.patch,
        "scan": stamp.scan,
        "t_sync_ns": stamp.t_sync_ns,
        "t_receive_ns": stamp.t_receive_ns,
        **trust_table(field),
        "method": field.method,
        "displacement_m": field.displacement_m.tolist(),
        "contacts": contact_tables(field),
        # an unknown value has an infinite standard deviation, which JSON cannot represent
        "displacement_std_m": [
            [[v if v < float("inf") else None for v in electrode] for electrode in wire]
            for wire in field.displacement_std_m.tolist()
        ],
    }


def _patches(run: Replay, deepest_m: dict[str, float]) -> dict[str, dict[str, Any]]:
    return {
        name: {
            "solved": stream.solved,
            "skipped": stream.skipped,
            "withheld": stream.withheld,
            "untrusted": stream.untrusted,
            "torn": stream.assembler.scans_torn,
            "missed": stream.assembler.scans_missed,
            "deepest_m": deepest_m[name],
        }
        for name, stream in run.patch_stats().items()
    }


def _faults(run: Replay) -> list[str]:
    from skinnode.host.accounting import losses_of_bus, losses_of_stream

    found = run.flaws
    for name, bus in run.bus_stats().items():
        found += [f"{name}: {text}" for text in losses_of_bus(bus).values()]
    for name, stream in run.patch_stats().items():
        found += [f"{name}: {text}" for text in losses_of_stream(stream).values()]
        if not stream.offered and not run.stopped:
            found.append(f"{name}: no scan could be decoded")
    return found
