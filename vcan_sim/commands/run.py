"""``vcan-sim run hand.toml``: run the patches of a hand as CANopen nodes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import OtherChannel, OtherInterface, Seconds
from skinnode.process import clock
from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.config import HandConfig
    from skinnode.node import NmtState
    from vcan_sim.fleet import Fleet, NodeReport
    from vcan_sim.scenes import SceneConfig

_WARN_AGAIN_S = 10.0
"""Minimum interval between warnings about a busy machine, in s."""


def run(  # noqa: PLR0913 - Typer derives a command's options from its arguments
    hand: Annotated[Path, typer.Argument(help="The hand to simulate.", metavar="HAND.toml")],
    interface: OtherInterface = None,
    channel: OtherChannel = None,
    seconds: Seconds = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="Faults of all nodes, such as lost=0.01,restart_every_s=5,frozen, or of one patch or bus, "
            "such as palm:open_upper=3. This option can be repeated.",
            metavar="[PLACE:]FAULTS",
        ),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            help="Scene to play on the patches: a file, or a name from `vcan-sim list`.", metavar="SCENE.toml"
        ),
    ] = None,
    imperfections: Annotated[
        str | None,
        typer.Option(
            help="Imperfections of all patches: ordinary, or values such as ordinary,placement=0.05,seed=3.",
            metavar="ordinary|SIZES",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(help="Plot the forces and pressures of the scene to FILE, then exit.", metavar="FILE"),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="Record the bus trace, ground truth, faults and scene in a new FOLDER.", metavar="FOLDER"
        ),
    ] = None,
) -> None:
    """Simulate the patches of a hand as CANopen nodes. A sphere presses on each patch and slides over it.

    With --scene, the bodies of the scene replace the sphere. To start the nodes, run `skinnode host` with the
    same file in another terminal. To change the faults while the simulator is running, use `vcan-sim inject`.
    """
    from skinnode.config import load_hand

    plan = load_hand(hand).on(interface, channel)  # reports errors before the slow imports
    from skinnode.process.garbage_collection import without_long_collections
    from skinnode.process.signals import stop_on_signal
    from vcan_sim.fleet import Fleet
    from vcan_sim.scenes import load_scene
    from vcan_sim.scenes.library import scene_file
    from vcan_sim.skin.imperfections import Imperfections

    scene = None if scene is None else scene_file(scene)
    if plot is not None:
        _preview(plan, scene, plot)
        return
    played = None if scene is None else load_scene(scene, plan)
    made = None if imperfections is None else Imperfections.from_text(imperfections)
    simulated = Fleet(plan, scene=played, imperfections=made)
    simulated.faults.inject(*fault or [])
    with (
        stop_on_signal() as stop,
        _recorded(simulated, played, record) as poll,
        simulated as fleet,
        _controlled(fleet),
        without_long_collections(),
    ):
        where = ", ".join(f"{bus.name} ({bus.interface} {bus.channel})" for bus in plan.buses)
        patches = counted(len(plan.patches), "patch", "patches")
        _say(f"{patches} of {plan.name!r} on {where}; press Ctrl-C to stop")
        _watch(fleet, stop.wait, seconds, poll)
        injected = _injected(fleet) if fleet.faults.log else []
    reports = fleet.report()
    _say(_summary(reports))
    if slow := sum(report.slow_overruns for report in reports):
        _say(
            f"note: {counted(slow, 'scan')} skipped because this machine was too busy; "
            "the hand is not at fault"
        )
    for line in injected:
        _say(line)
    if record is not None:
        _say(f"recorded to {record}")


def _preview(hand: HandConfig, scene: Path | None, plot: Path) -> None:
    """Plot a scene to an image file.

    Raises:
        ConfigError: If there is no scene, matplotlib is missing, or the file cannot be written.
    """
    from skinnode.errors import ConfigError
    from skinnode.files.plot_file import require_matplotlib
    from vcan_sim.scenes import load_scene
    from vcan_sim.scenes.plot import write_plot

    if scene is None:
        raise ConfigError("--plot", str(plot), "only with --scene")
    require_matplotlib(plot)
    write_plot(load_scene(scene, hand), hand, plot)
    _say(f"wrote {plot}")


def _watch(
    fleet: Fleet, wait: Callable[[float], bool], seconds: float | None, poll: Callable[[], None]
) -> None:
    """Print one status line per second until ``wait`` returns True, ``seconds`` elapse or a thread fails."""
    start = clock.monotonic()
    before = fleet.report()
    silent_until_s = 0.0
    for second in range(1, sys.maxsize):
        due = float(second) if seconds is None else min(second, seconds)
        if wait(max(0.0, start + due - clock.monotonic())) or fleet.failed:
            return
        poll()
        now = fleet.report()
        _say(_progress(due, before, now))
        if due >= silent_until_s and (slow := _too_slow(before, now)):
            print(slow, file=sys.stderr, flush=True)
            silent_until_s = due + _WARN_AGAIN_S
        before = now
        if seconds is not None and due >= seconds:
            return


def _progress(elapsed_s: float, before: Sequence[NodeReport], now: Sequence[NodeReport]) -> str:
    steps = list(zip(before, now, strict=True))
    frames = sum(new.frames_sent - old.frames_sent for old, new in steps)
    each = "  ".join(
        f"{new.patch} {_words(new.nmt_state)} {new.scans_sent - old.scans_sent} scans" for old, new in steps
    )
    return f"{elapsed_s:6.1f} s  {each}  {frames} frames"


def _too_slow(before: Sequence[NodeReport], now: Sequence[NodeReport]) -> str:
    """Return a warning if scans were skipped because this machine was too busy; otherwise, return ""."""
    steps = list(zip(before, now, strict=True))
    skipped = sum(new.slow_overruns - old.slow_overruns for old, new in steps)
    if not skipped:
        return ""
    scans = skipped + sum(new.scans_sent - old.scans_sent for old, new in steps)
    return (
        f"vcan-sim: this machine is too busy: {skipped} of {scans} scans in the last second were skipped "
        "(EMCY 0x8110); stop other programs, simulate fewer patches, or use a longer sync.period_ms"
    )


def _words(state: NmtState) -> str:
    return state.name.lower().replace("_", "-")


def _summary(reports: Sequence[NodeReport]) -> str:
    scans, frames = sum(r.scans_sent for r in reports), sum(r.frames_sent for r in reports)
    sent, frames_in = counted(scans, "scan"), counted(frames, "frame")
    return f"sent {sent} in {frames_in} from {counted(len(reports), 'node')}"


def _injected(fleet: Fleet) -> list[str]:
    """Return the counts of injected faults: one line per patch, and one per bus with injected faults."""
    lines = []
    for place, counts in fleet.counts().items():
        shown = ", ".join(f"{count} {name}" for name, count in counts.items())
        if counts or place in fleet.patches:
            lines.append(f"{place}: {shown or 'nothing injected'}")
    return lines


@contextmanager
def _recorded(fleet: Fleet, scene: SceneConfig | None, folder: Path | None) -> Iterator[Callable[[], None]]:
    """Record the fleet in ``folder``, if given. Yields a function to be called once per second."""
    if folder is None:
        yield lambda: None
        return
    from vcan_sim.recording import Recording

    with Recording(folder, fleet, scene) as recording:
        yield recording.poll


@contextmanager
def _controlled(fleet: Fleet) -> Iterator[None]:
    """Open the control socket for `vcan-sim inject`. If that fails, print a note."""
    from vcan_sim.control import ControlError, ControlServer

    with ExitStack() as entered:
        try:
            entered.enter_context(ControlServer(fleet, fleet.hand.name))
        except ControlError as error:
            print(
                f"note: `vcan-sim inject` cannot reach this simulator: {error}", file=sys.stderr, flush=True
            )
        yield


def _say(line: str) -> None:
    print(line, flush=True)
