"""``skinnode node``: runs a Linux board with an A/D converter as a skin patch on a CAN bus."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._layout_option import HELP as LAYOUT_HELP
from skinnode.cli._options import JsonLines, Seconds
from skinnode.process import clock
from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.node import FileMemory, NodeRunner
    from skinnode.transport import CanPort


def node(
    source: Annotated[
        str,
        typer.Option(
            help="Source of the resistances: MODULE:NAME, or a name registered by a package.", metavar="NAME"
        ),
    ],
    node_id: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=127,
            help="Node-ID, unless the --store file contains a node-ID set by LSS.",
            metavar="N",
        ),
    ] = None,
    layout: Annotated[str, typer.Option(help=LAYOUT_HELP, metavar="LAYOUT")] = "staggered",
    interface: Annotated[str, typer.Option(help="python-can interface.", metavar="NAME")] = "socketcan",
    channel: Annotated[str, typer.Option(help="Channel of the interface.", metavar="NAME")] = "can0",
    bitrate: Annotated[
        int, typer.Option(min=10_000, max=1_000_000, help="Bits per second.", metavar="BPS")
    ] = 1_000_000,
    fd: Annotated[
        bool, typer.Option("--fd", help="Send PDOs in CAN FD frames with bit-rate switching.")
    ] = False,
    data_bitrate: Annotated[
        int, typer.Option(min=10_000, max=8_000_000, help="Data bit rate of CAN FD frames.", metavar="BPS")
    ] = 5_000_000,
    code_bits: Annotated[
        int, typer.Option(help="Width of a resistance code in bits: 16 or 24.", metavar="16|24")
    ] = 16,
    serial: Annotated[
        int, typer.Option(min=0, max=0xFFFF_FFFF, help="Serial number (0x1018:4).", metavar="N")
    ] = 0,
    store: Annotated[
        Path | None,
        typer.Option(
            help="File that keeps configuration, baseline and node-ID across restarts.", metavar="FILE"
        ),
    ] = None,
    strict_timing: Annotated[
        bool,
        typer.Option(
            "--strict-timing", help="Send frames on time to within 0.2 ms instead of 2 ms; uses more CPU."
        ),
    ] = False,
    seconds: Seconds = None,
    as_json: JsonLines = False,
) -> None:
    """Run one patch as a CANopen node that sends the resistances read from a source.

    A source is a class or function that takes the layout and returns an object whose read(t_ns) method
    returns the (U, K) resistances in ohms. `--source simulated` needs no hardware. The command prints its
    counters every second until you press Ctrl-C. The exit status is 1 if the source failed, scans were
    skipped, frames were not sent, another node used the same node-ID, or the --store file could not be used.
    The exit status is 2 if the node could not run.
    """
    from skinnode.canopen.lss import NOT_CONFIGURED
    from skinnode.cli._bus import bus_of
    from skinnode.cli._layout_option import find_layout, import_from_here
    from skinnode.errors import ConfigError
    from skinnode.files.output_file import require_writable
    from skinnode.node import NodeRunner, PatchNode
    from skinnode.node.pacing import EXACT, THRIFTY
    from skinnode.node.patch.find_source import make_source
    from skinnode.process.garbage_collection import without_long_collections
    from skinnode.process.signals import stop_on_signal
    from skinnode.protocol.profile import PatchProfile
    from skinnode.transport import CanPort

    if node_id is None and store is None:
        raise ConfigError("--node-id", None, "1 to 127, or --store FILE and a node-ID stored there by LSS")
    if store is not None:
        require_writable("--store", store)
    import_from_here()
    patch = find_layout(layout)
    profile = PatchProfile.from_layout(patch, code_bits, "fd" if fd else "classic")
    bus = bus_of(interface, channel, bitrate, fd, data_bitrate)
    measuring = make_source(source, patch, "--source")
    with _memory(store) as memory, stop_on_signal() as stop, CanPort(bus) as port:
        board = PatchNode(
            NOT_CONFIGURED if node_id is None else node_id,
            patch,
            measuring,
            send=port.send,
            profile=profile,
            serial=serial,
            memory=memory,
            pacing=EXACT if strict_timing else THRIFTY,
            set_bit_rate=port.set_bitrate,
        )
        with without_long_collections(), NodeRunner(port, [board]) as runner:
            where = f"{interface} {channel}{', CAN FD' if fd else ''}"
            sizes = f"{profile.rows} × {profile.columns} wires, {code_bits}-bit codes"
            who = _node_text(board.node_id, node_id)
            _note(f"{who} ({sizes}, source {source}) on {where}; press Ctrl-C to stop", as_json)
            _watch(runner, port, stop, seconds, as_json)
        faults = _faults(_progress(runner, port, 0.0))
    for fault in faults:
        _note(f"fault: {fault}", as_json)
    if faults:
        raise typer.Exit(1)


@contextmanager
def _memory(store: Path | None) -> Iterator[FileMemory | None]:
    """Lock the file ``store`` and yield the non-volatile memory stored in it."""
    from skinnode.errors import ConfigError
    from skinnode.files.file_lock import FileInUse, NotARegularFile
    from skinnode.node.memory_file import FileMemory

    if store is None:
        yield None
        return
    if os.path.islink(store):
        raise ConfigError("--store", str(store), "a file, not a symbolic link")
    if os.path.exists(store) and not os.path.isfile(store):
        raise ConfigError("--store", str(store), "a regular file, or a name that does not exist")
    memory = FileMemory(store)
    try:
        memory.claim()
    except FileInUse as error:
        allowed = f"a file that no other process is using ({error.strerror})"
        raise ConfigError("--store", str(store), allowed) from None
    except NotARegularFile as error:
        raise ConfigError("--store", str(store), f"a file that can be locked ({error.strerror})") from None
    except OSError as error:
        raise ConfigError("--store", str(store), f"a file in a writable folder ({error.strerror})") from error
    with memory:
        yield memory


def _node_text(node_id: int, given: int | None) -> str:
    """Return the node-ID in use as text; a node-ID stored by LSS takes precedence over --node-id."""
    from skinnode.canopen.lss import NOT_CONFIGURED

    who = "node without a node-ID" if node_id == NOT_CONFIGURED else f"node {node_id}"
    return who if node_id == given or given is None else f"{who} (stored by LSS; {given} is not used)"


@dataclass(frozen=True, slots=True)
class _Progress:
    """Status and counters of a running node; the counters start at 0."""

    elapsed_s: float
    node_id: int | None
    """Node-ID of the node; None until a node-ID is assigned."""
    state: str
    scans: int
    frames: int
    overruns: int
    source_failures: int
    source_error: str
    bus_errors: int
    bus_error: str
    rival_frames: int
    memory_problem: str


def _progress(runner: NodeRunner, port: CanPort, elapsed_s: float) -> _Progress:
    from skinnode.canopen.lss import NOT_CONFIGURED

    (board,) = runner.nodes
    return _Progress(
        round(elapsed_s, 3),
        None if board.node_id == NOT_CONFIGURED else board.node_id,
        board.nmt_state.name.lower().replace("_", "-"),
        board.scans_sent,
        port.sent,
        board.overruns,
        board.source_failures,
        board.source_error,
        runner.bus_errors,
        runner.bus_error,
        board.rival_frames,
        board.memory_problem,
    )


def _faults(end: _Progress) -> list[str]:
    """Return the faults so far, one line each."""
    counts = (
        (end.source_failures, "failure", "failures", f" of the source, most recently: {end.source_error}"),
        (end.overruns, "scan", "scans", " skipped because earlier scans were still being sent"),
        (
            end.rival_frames,
            "boot-up or heartbeat",
            "boot-ups or heartbeats",
            " from another node with this node-ID",
        ),
        (end.bus_errors, "bus error", "bus errors", f"; first error of the latest series: {end.bus_error}"),
    )
    faults = [f"{counted(count, one, several)}{what}" for count, one, several, what in counts if count]
    return [*faults, f"memory: {end.memory_problem}"] if end.memory_problem else faults


def _watch(
    runner: NodeRunner, port: CanPort, stop: threading.Event, seconds: float | None, as_json: bool
) -> None:
    """Print a line every second until the command is stopped, the duration has elapsed or the node stops."""
    start_s = clock.monotonic()
    end_s = float("inf") if seconds is None else start_s + seconds
    before, due_s = replace(_progress(runner, port, 0.0), scans=0, frames=0), start_s + 1.0
    while not stop.wait(max(0.0, min(due_s, end_s) - clock.monotonic())) and not runner.failed:
        now_s = clock.monotonic()
        now = _progress(runner, port, now_s - start_s)
        print(json.dumps(asdict(now)) if as_json else _line(before, now), flush=True)
        before, due_s = now, due_s + 1.0
        if now_s >= end_s:
            return


def _line(before: _Progress, now: _Progress) -> str:
    scans, frames = now.scans - before.scans, now.frames - before.frames
    worse = "".join(f"  fault: {fault}" for fault in _faults(now))
    who = now.node_id or "no node-ID"
    return f"{now.elapsed_s:6.1f} s  {who}  {now.state}  {scans} scans  {frames} frames{worse}"


def _note(text: str, as_json: bool) -> None:
    print(json.dumps({"note": text}) if as_json else text, flush=True)
