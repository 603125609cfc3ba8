"""Runs simulated patches in a separate process, for commands that demonstrate the host.

In a single process, the patches and the host would compete for the interpreter lock, and the host's
performance figures would include the cost of the simulation.
"""

from __future__ import annotations

import multiprocessing
import random
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from skinnode.config import HandConfig
from skinnode.config.patches import TolerancesConfig
from skinnode.errors import SkinError
from skinnode.process.child_processes import starting_children

if TYPE_CHECKING:
    from vcan_sim.scenes import SceneConfig


def on_simulated_buses(hand: HandConfig) -> HandConfig:
    """Return a copy of the hand for simulated patches.

    All buses are replaced with virtual buses (UDP multicast), because simulated nodes must never send on a
    bus with real nodes. Their frames stay on this machine (``hop_limit`` 0). All tolerances are set to
    "exact", because simulated patches match their layouts exactly.
    """
    exact = TolerancesConfig.model_validate("exact")
    patches = tuple(patch.model_copy(update={"tolerances": exact}) for patch in hand.patches)
    groups = random.sample(range(1 << 16), len(hand.buses))
    buses = tuple(
        bus.model_copy(
            update={
                "interface": "udp_multicast",
                "channel": f"239.74.{group >> 8}.{group & 255}",
                "options": {"hop_limit": 0},
            }
        )
        for bus, group in zip(hand.buses, groups, strict=True)
    )
    return hand.model_copy(update={"buses": buses, "patches": patches})


def scene_of(scene: Path, hand: HandConfig) -> SceneConfig:
    """Load a scene for :func:`simulated`.

    Args:
        scene: Path of the file, or name of a shipped scene.
        hand: The hand on which the scene is played.

    Raises:
        ConfigError: The scene cannot be read, or does not fit the hand.
    """
    from vcan_sim.scenes import load_scene
    from vcan_sim.scenes.library import scene_file

    return load_scene(scene_file(scene), hand)


@contextmanager
def simulated(hand: HandConfig, scene: SceneConfig | None = None) -> Iterator[None]:
    """Simulate the patches of a hand in a child process during the ``with`` block.

    The child process exits even if this process is killed.

    Args:
        hand: The hand to simulate.
        scene: Scene to play; None for a sphere that presses on each patch.

    Raises:
        SkinError: The child process cannot run the patches.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_run_nodes, args=(hand, scene, theirs), name="simulated patches")
    with starting_children():
        process.start()
    theirs.close()
    try:
        try:
            complaint = ours.recv()
        except EOFError:
            complaint = "their process ended immediately"
        if complaint:
            raise SkinError(f"simulated patches: {complaint}")
        yield
    finally:
        ours.close()  # makes the child process exit
        process.join()


def _run_nodes(hand: HandConfig, scene: SceneConfig | None, parent: Connection) -> None:
    """Run the nodes until the parent process closes its end of the pipe or exits."""
    import signal

    from vcan_sim.fleet import Fleet

    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the parent also receives SIGTERM and closes the pipe
    try:
        with Fleet(hand, scene=scene):
            parent.send("")
            with suppress(EOFError, OSError):
                parent.recv()
    except SkinError as error:
        with suppress(OSError):
            parent.send(str(error))
