"""Check that a host's counters add up: every frame and every scan must be accounted for.

The counters of a running host are read one after another, so the sums agree only if the host is idle or
closed.
"""

from __future__ import annotations

from skinnode.host.dispatcher import BusStats
from skinnode.host.host import HostStats
from skinnode.host.patch_stream import StreamStats
from skinnode.protocol.scan import AssemblerStats
from skinnode.text.words import counted


def discrepancies(stats: HostStats) -> list[str]:
    """Return one line for each host counter that differs from the sum of its parts.

    ===========  ==========================================================================================
    bus          frames read = received + ignored + error frames + dropped + waiting
    bus          received = foreign + handled; the PDOs of its patches are among the handled frames
    bus          malformed = PDOs, SDO responses, heartbeats and EMCY messages with a wrong length or format
    patch        frames = accepted + duplicates + conflicts + late + wrong length, index, counter or format
    patch        assembled scans (complete, torn or unchecked) = offered + withheld + partial
    patch        offered = solved + failed + skipped
    ===========  ==========================================================================================
    """
    found: list[str] = []
    for name, bus in stats.buses.items():
        found += [f"{name}: {text}" for text in _of_bus(bus)]
    for name, stream in stats.patches.items():
        found += [f"{name}: {text}" for text in _of_stream(stream)]
    handled = sum(bus.received - bus.foreign for bus in stats.buses.values())
    pdos = sum(stream.frames for stream in stats.patches.values())
    if pdos > handled:
        found.append(f"got {pdos} PDOs, must be at most the {handled} frames that were handled")
    assemblers = [stream.assembler for stream in stats.patches.values()]
    rejected = sum(each.bad_length + each.bad_form for each in assemblers)
    malformed = sum(bus.malformed for bus in stats.buses.values())
    if rejected > malformed:
        found.append(
            f"got {rejected} PDOs of wrong length or format, must be at most the {malformed} malformed frames"
        )
    return found


def losses_of_bus(bus: BusStats) -> dict[str, str]:
    """Return a phrase for each of a bus's nonzero loss and error counters, keyed by counter name."""
    counts = (
        ("dropped", "frame dropped", "frames dropped"),
        ("kernel_dropped", "frame dropped by the kernel", "frames dropped by the kernel"),
        ("outages", "interface outage", "interface outages"),
        ("bus_offs", "time bus-off", "times bus-off"),
        ("error_frames", "error frame", "error frames"),
    )
    return {name: counted(count, *words) for name, *words in counts if (count := getattr(bus, name))}


def losses_of_stream(stream: StreamStats) -> dict[str, str]:
    """Return a phrase for each of a patch's nonzero loss counters, keyed by counter name."""
    assembler = stream.assembler
    counts = (
        ("scans_torn", "scan torn", "scans torn"),
        ("scans_missed", "scan missed", "scans missed"),
        ("scans_mixed", "scan discarded as mixed", "scans discarded as mixed"),
        ("scans_corrupt", "scan discarded by the check", "scans discarded by the check"),
        ("chunks_lost", "chunk lost", "chunks lost"),
        ("summaries_lost", "summary lost", "summaries lost"),
    )
    return {name: counted(count, *words) for name, *words in counts if (count := getattr(assembler, name))}


def frames_counted(assembler: AssemblerStats) -> int:
    """Return the number of frames that an assembler has accepted or rejected."""
    return (
        assembler.chunks_accepted
        + assembler.summaries_accepted
        + assembler.duplicates
        + assembler.conflicts
        + assembler.late
        + assembler.bad_length
        + assembler.bad_index
        + assembler.bad_counter
        + assembler.bad_form
    )


def _of_bus(bus: BusStats) -> list[str]:
    counted_frames = bus.received + bus.ignored + bus.error_frames + bus.dropped + bus.waiting
    return _unless_equal("frames read", bus.read, "counted", counted_frames)


def _of_stream(stream: StreamStats) -> list[str]:
    assembler = stream.assembler
    return [
        *_unless_equal("frames", stream.frames, "counted", frames_counted(assembler)),
        *_unless_equal(
            "scans offered or withheld",
            stream.offered + stream.withheld + stream.partial,
            "assembled",
            assembler.scans_complete + assembler.scans_torn + assembler.scans_unchecked,
        ),
        *_unless_equal(
            "scans offered",
            stream.offered,
            "solved, failed or skipped",
            stream.solved + stream.failed + stream.skipped,
        ),
    ]


def _unless_equal(what: str, got: int, other: str, must: int) -> list[str]:
    return [] if got == must else [f"{what}: got {got}, must equal the {must} {other}"]
