"""Compares the host's counters with the numbers of frames of each kind sent and dropped in a soak test."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skinnode.host import HostStats
from skinnode.host.scan_solver import ScanSolver
from skinnode.transport import Frame
from vcan_sim.faults import Injected
from vcan_sim.fleet import Fleet
from vcan_sim.tally import Kind, kind_of


class FrameCounter:
    """Counts the frames that a host receives and sends, by bus and kind.

    Implements :class:`~skinnode.host.tap.HostTap`.
    """

    def __init__(self, buses: Sequence[str]) -> None:
        self.received_on: dict[str, Counter[Kind]] = {bus: Counter() for bus in buses}
        self.sent_on: dict[str, Counter[Kind]] = {bus: Counter() for bus in buses}
        self._counting = threading.Lock()  # several threads send frames

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """Count a batch of received frames."""
        counter = self.received_on[bus]
        for frame in frames:
            if not (frame.error or frame.extended):
                counter[kind_of(frame.can_id, frame.data, frame.remote)] += 1

    def sent(self, bus: str, frame: Frame) -> None:
        """Count a sent frame."""
        with self._counting:
            self.sent_on[bus][kind_of(frame.can_id, frame.data, frame.remote)] += 1

    def numbered(self, bus: str, t_ns: int, number: int) -> None:
        """Count nothing."""

    def resumed(self, patch: str, solver: ScanSolver, *, anew: bool) -> None:
        """Count nothing."""

    def withheld(self, patch: str) -> None:
        """Count nothing."""

    def polled(self, patch: str, t_ns: int) -> None:
        """Count nothing."""

    def overtaken(self, patch: str, scan: int, t_receive_ns: int) -> None:
        """Count nothing."""


@dataclass(frozen=True, slots=True)
class KindSums:
    """Counts of one kind of frame over a complete soak test."""

    kind: str
    wanted: int
    """Number of frames to send, including those added by faults."""
    dropped: int
    """Number of frames dropped in transit by a fault."""
    held_back: int
    """Number of frames that a node did not send or receive because it was silent, unplugged, deaf or
    bus-off."""
    arrived: int


def of_nodes(fleet: Fleet) -> list[KindSums]:
    """Count the frames from the nodes to the host, by kind."""
    sums = []
    for kind in Kind:
        tallies = [fleet.tally(patch.name) for patch in fleet.hand.patches]
        wanted = sum(tally.handed[kind] for tally in tallies)
        if wanted:
            held = sum(tally.silenced[kind] + tally.refused[kind] + tally.waiting[kind] for tally in tallies)
            dropped = sum(tally.lost[kind] for tally in tallies)
            sums.append(KindSums(kind, wanted, dropped, held, sum(tally.emitted[kind] for tally in tallies)))
    return sums


def of_host(fleet: Fleet) -> list[KindSums]:
    """Count the frames from the host to the nodes, by kind.

    A frame is counted once for each node on its bus.
    """
    sums = []
    for kind in Kind:
        wanted = dropped = held = arrived = 0
        for bus in fleet.hand.buses:
            tallies = [fleet.tally(patch.name) for patch in fleet.hand.patches_on(bus.name)]
            missed = len(tallies) * fleet.passed(bus.name).missed[kind]
            wanted += missed + sum(tally.heard[kind] for tally in tallies)
            dropped += sum(tally.lost_in[kind] for tally in tallies)
            held += missed + sum(tally.unheard[kind] for tally in tallies)
            arrived += sum(tally.taken[kind] for tally in tallies)
        if wanted:
            sums.append(KindSums(kind, wanted, dropped, held, arrived))
    return sums


def received_otherwise(fleet: Fleet, counter: FrameCounter, before: Mapping[str, Counter[Kind]]) -> list[str]:
    """Compare the counts of frames from the nodes to the host; return one line of text per mismatch.

    All nodes must be silent during the call.

    Args:
        fleet: Simulated nodes.
        counter: Counter attached to the host.
        before: Number of frames of each kind that each bus had carried before the host opened it.
    """
    found = []
    for bus in fleet.hand.buses:
        tallies = [fleet.tally(patch.name) for patch in fleet.hand.patches_on(bus.name)]
        for kind in Kind:
            emitted = sum(tally.emitted[kind] for tally in tallies)
            sent, received = fleet.passed(bus.name).sent[kind], counter.received_on[bus.name][kind]
            if not emitted == sent == received + before[bus.name][kind]:
                found.append(
                    f"{bus.name}: {kind} frames: the nodes sent {emitted}, the bus carried {sent}, "
                    f"the host received {received}"
                )
    return found


def sent_otherwise(fleet: Fleet, counter: FrameCounter) -> list[str]:
    """Compare the counts of frames from the host to the nodes; return one line of text per mismatch.

    The host must be closed and the nodes stopped before the call.
    """
    found = []
    for bus in fleet.hand.buses:
        passed = fleet.passed(bus.name)
        for kind in Kind:
            sent, heard = counter.sent_on[bus.name][kind], passed.heard[kind] + passed.missed[kind]
            if sent != heard:
                found.append(
                    f"{bus.name}: {kind} frames: the host sent {sent}, the nodes' interface received {heard}"
                )
            found += [
                f"{patch.name}: {kind} frames: {passed.heard[kind]} at the interface, {of_node} at the node"
                for patch in fleet.hand.patches_on(bus.name)
                if (of_node := fleet.tally(patch.name).heard[kind]) != passed.heard[kind]
            ]
    for patch in fleet.hand.patches:
        found += [f"{patch.name}: {text}" for text in fleet.tally(patch.name).discrepancies()]
    return found


def injected_otherwise(stats: HostStats, injected: Mapping[str, Injected]) -> list[str]:
    """Compare the host's counters with the injected faults; return one line of text per mismatch."""
    found = [
        f"{name}: the host counted {stats.patches[name].frames} chunks and summaries, {each.pdos} were sent"
        for name, each in injected.items()
        if stats.patches[name].frames != each.pdos
    ]
    streams, buses = stats.patches.values(), stats.buses.values()
    short = sum(stream.assembler.bad_length for stream in streams)
    unchecked = sum(stream.assembler.bad_form for stream in streams)
    for what, got, name in (
        ("remote frames", sum(bus.ignored for bus in buses), "remote"),
        ("short chunks", short, "short"),
        ("long heartbeats", sum(bus.malformed for bus in buses) - short - unchecked, "long"),
        ("frames of foreign COB-IDs", sum(bus.foreign for bus in buses), "babbled"),
        ("frames lost in the host's own queue", sum(bus.dropped for bus in buses), None),
    ):
        must = sum(getattr(each, name) for each in injected.values()) if name else 0
        if got != must:
            found.append(f"{what}: the host counted {got}, {must} were injected")
    return found
