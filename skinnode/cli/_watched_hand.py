"""Options and sources shared by the commands that watch a hand: ``monitor`` and ``view``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable
    from contextlib import AbstractContextManager, ExitStack

    from skinnode.cli._zenoh_options import ZenohOptions
    from skinnode.config import HandConfig
    from skinnode.monitor.source import Source

_SIMULATED = 4
"""Number of patches to simulate if no hand file is given."""

WatchedHand = Annotated[Path | None, typer.Argument(help="Hand file to run and show.", metavar="[HAND.toml]")]
Replayed = Annotated[
    Path | None,
    typer.Option("--replay", help="Show a recording made by `skinnode record`.", metavar="RECORDING"),
]
Speed = Annotated[
    float | None, typer.Option(help="Speed of --replay: 2 is twice as fast; default 1.", metavar="X")
]
Simulate = Annotated[
    bool,
    typer.Option(
        "--simulate",
        help="Simulate pressed patches on a private bus: the hand's patches, or four without a hand.",
    ),
]
Scene = Annotated[
    Path | None,
    typer.Option(
        help="Scene that --simulate plays: a file, or a name from `vcan-sim list`.", metavar="SCENE.toml"
    ),
]
Remote = Annotated[
    str | None,
    typer.Option(help="Show the hand of this name that `skinnode host --publish` publishes.", metavar="NAME"),
]


class WatchOptions(NamedTuple):
    """Values of the options that select the hand to watch."""

    hand: Path | None
    interface: str | None
    channel: str | None
    replay: Path | None
    speed: float | None
    simulate: bool
    scene: Path | None
    remote: str | None
    zenoh: ZenohOptions


class WatchedSource(NamedTuple):
    """Hand to watch, before its source is started."""

    hand: HandConfig
    name: str
    wall_minus_mono_ns: int
    """Wall-clock time minus the source's monotonic time, in ns."""
    start: Callable[[ExitStack, threading.Event, Callable[[str], None]], Source]
    """Function that starts the source. Closing the stack also closes the source; the event cancels the start;
    the last argument displays the current step. Raises the same errors as :meth:`Host.from_config`."""


def check_options(options: WatchOptions) -> None:
    """Raise ConfigError unless the options select exactly one source and each option has an effect."""
    from skinnode.errors import NOTHING, ConfigError, Shown

    sources = {
        "HAND.toml": options.hand is not None,
        "--simulate": options.simulate and options.hand is None,  # HAND.toml --simulate is one source
        "--replay": options.replay is not None,
        "--remote": options.remote is not None,
    }
    given = [name for name, is_given in sources.items() if is_given]
    if len(given) != 1:
        key, got = (given[0], Shown(f"both it and {given[1]}")) if given else ("HAND.toml", NOTHING)
        raise ConfigError(key, got, "one of HAND.toml, --simulate, --replay RECORDING and --remote NAME")
    if options.speed is not None and options.replay is None:
        raise ConfigError("--speed", options.speed, "only with --replay")
    if options.scene is not None and not options.simulate:
        raise ConfigError("--scene", str(options.scene), "only with --simulate")
    if options.remote is None:
        options.zenoh.require_unused("only with --remote")
    unused = "--simulate" if options.simulate else given[0] if options.hand is None else None
    for option, value in (("--interface", options.interface), ("--channel", options.channel)):
        if value is not None and unused is not None:
            raise ConfigError(option, value, f"only without {unused}, which does not open a hand's buses")


@contextmanager
def watched(options: WatchOptions, tell: Callable[[str], None]) -> Iterator[WatchedSource]:
    """Load the hand file, open the recording or connect to the remote hand; close it on exit.

    Args:
        options: Options that :func:`check_options` accepts.
        tell: Function that displays the current step.

    Raises:
        ConfigError: The hand file or the recording cannot be read, or the remote hand is not published.
        SkinError: The daemon of the remote hand does not answer.
    """
    if options.remote is not None:
        with _remote(options.remote, options.zenoh, tell) as source:
            yield source
    elif options.replay is not None:
        with _recording(options.replay, 1.0 if options.speed is None else options.speed) as source:
            yield source
    else:
        yield _host(options)


@contextmanager
def _remote(name: str, zenoh: ZenohOptions, tell: Callable[[str], None]) -> Iterator[WatchedSource]:
    session = zenoh.session("--remote")
    from skinnode.monitor.live_source import RemoteSource
    from skinnode.process import clock
    from skinnode.remote import connect

    tell(f"connecting to {name!r}")
    with connect(name, router=session.router, config=session.config, port=session.port) as remote:
        yield WatchedSource(
            remote.hand,
            remote.hand.name,
            clock.time_ns() - clock.monotonic_ns(),
            lambda stack, stop, tell: stack.enter_context(RemoteSource(remote)),
        )


@contextmanager
def _recording(path: Path, speed: float) -> Iterator[WatchedSource]:
    from skinnode.monitor.replay_source import ReplaySource
    from skinnode.record import replay

    run = replay(path, speed=speed)
    try:
        yield WatchedSource(
            run.hand,
            path.name,
            run.wall_minus_mono_ns,
            lambda stack, stop, tell: stack.enter_context(ReplaySource(run)),
        )
    finally:
        run.log.close()


def _host(options: WatchOptions) -> WatchedSource:
    from skinnode.process import clock

    plan = _plan(options)
    simulation = _simulation(options, plan)

    def start(stack: ExitStack, stop: threading.Event, tell: Callable[[str], None]) -> Source:
        return _running(stack, plan, stop, simulation, tell)

    return WatchedSource(plan, plan.name, clock.time_ns() - clock.monotonic_ns(), start)


def _plan(options: WatchOptions) -> HandConfig:
    """Return the hand to run, with settings that make the host wait for missing patches."""
    from skinnode.config import load_hand
    from skinnode.demo.hand import demo_hand

    if options.hand is not None:
        plan = load_hand(options.hand).on(options.interface, options.channel)
    else:
        plan = demo_hand(_SIMULATED, seed=1)
        # only the "posterior" method computes contact forces
        solver = plan.solver.model_copy(update={"method": "posterior"})
        plan = plan.model_copy(update={"name": "simulated hand", "solver": solver})
    if options.simulate:
        from skinnode.demo.simulated import on_simulated_buses

        plan = on_simulated_buses(plan)
    waiting = plan.bring_up.model_copy(update={"missing": "wait"})
    return plan.model_copy(update={"bring_up": waiting})


def _simulation(options: WatchOptions, plan: HandConfig) -> Callable[[], AbstractContextManager[None]] | None:
    """Return a function that simulates the hand's patches; None if they are not simulated.

    The scene is loaded now, so that an error in it is reported before anything is opened or shown.
    """
    if not options.simulate:
        return None
    from skinnode.demo.simulated import scene_of, simulated

    scene = None if options.scene is None else scene_of(options.scene, plan)
    return lambda: simulated(plan, scene)


def _running(
    stack: ExitStack,
    plan: HandConfig,
    stop: threading.Event,
    simulation: Callable[[], AbstractContextManager[None]] | None,
    tell: Callable[[str], None],
) -> Source:
    """Start a host and return its source; see :class:`WatchedSource`."""
    from skinnode.compiled.jit import is_cold
    from skinnode.host import Host
    from skinnode.host.scan_solver import check_solvable
    from skinnode.monitor.live_source import HostSource
    from skinnode.process.garbage_collection import responsive_threads, without_long_collections
    from skinnode.text.words import counted

    tell("compiling the kernels once" if is_cold() else "preparing the solvers")
    for patch in plan.patches:
        check_solvable(patch, plan.solver, plan.sync.period_s)
    if simulation is not None:
        stack.enter_context(simulation())
    tell(f"bringing up {counted(len(plan.patches), 'patch', 'patches')}")
    stack.enter_context(responsive_threads())
    stack.enter_context(without_long_collections())  # collects garbage now, before the first SYNC
    host = stack.enter_context(Host.from_config(plan, cancelled=stop.is_set))
    return stack.enter_context(HostSource(host))
