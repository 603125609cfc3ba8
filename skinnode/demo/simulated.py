"""Simulated patches for a command that shows a host at work: beside the demo, the one place of the package
that knows the simulator. They run in a process of their own, as the nodes of a real hand do: they share
neither interpreter nor fate with the host, and its figures are its own."""

from __future__ import annotations

import multiprocessing
import random
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.process.child_processes import starting_children


def on_simulated_buses(hand: HandConfig) -> HandConfig:
    """The same hand on buses that cross processes on this machine and that nobody else uses: simulated nodes
    have no business among real ones."""
    groups = random.sample(range(1 << 16), len(hand.buses))
    buses = tuple(
        bus.model_copy(
            update={
                "interface": "udp_multicast",
                "channel": f"239.74.{group >> 8}.{group & 255}",
                "options": {},
            }
        )
        for bus, group in zip(hand.buses, groups, strict=True)
    )
    return hand.model_copy(update={"buses": buses})


@contextmanager
def simulated(hand: HandConfig) -> Iterator[None]:
    """The patches of a hand as nodes on its buses, in a process that ends with this one. Raises SkinError
    where it does not start."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_be_nodes, args=(hand, theirs), name="simulated patches")
    with starting_children():
        process.start()
    theirs.close()
    try:
        try:
            complaint = ours.recv()
        except EOFError:
            complaint = "they ended at once"
        if complaint:
            raise SkinError(f"simulated patches: {complaint}")
        yield
    finally:
        ours.close()  # which tells them
        process.join()


def _be_nodes(hand: HandConfig, parent: Connection) -> None:
    """Be the nodes until the parent closes its end, which it does even where it is killed."""
    import signal

    from vcan_sim.fleet import Fleet

    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # sent to the whole group: the parent ends us
    try:
        with Fleet(hand):
            parent.send("")
            with suppress(EOFError, OSError):
                parent.recv()
    except SkinError as error:
        with suppress(OSError):
            parent.send(str(error))
