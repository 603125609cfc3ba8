"""Opens recordings and logs from other masters for replay or conversion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.host.hand_files import load_baseline
from skinnode.host.node_facts import NodeFacts
from skinnode.model.forward import resistance_ohm
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from skinnode.record.journal import Header, facts_table, journal_of, parse_journal, read_journal
from skinnode.record.log_files import channels
from skinnode.record.mcap_file import MCAP
from skinnode.record.mcap_reader import McapReader
from skinnode.transport.frame_log import LoggedFrame
from skinnode.transport.frame_log_reader import READABLE, Damage, FrameLogReader

FRAME_FILES: Final = (*READABLE, MCAP)
"""Suffixes of files that can contain CAN frames."""
ALLOWED: Final = f"a file ending in {', '.join(FRAME_FILES[:-1])} or {FRAME_FILES[-1]}"


class Frames(Protocol):
    """Iterable over a file's frames; skips damaged parts."""

    path: Path

    @property
    def damages(self) -> list[Damage]:
        """Damaged parts found so far; only the first few are kept."""

    @property
    def damaged(self) -> int:
        """Number of damaged parts found so far."""

    def __iter__(self) -> Iterator[LoggedFrame]:
        """Yield the frames."""

    def close(self) -> None:
        """Close the file."""


class ChannelMap:
    """Maps the channels in a file to buses.

    Args:
        bus_of: Bus name of each channel.
        only: Bus assigned to the first frame's channel if that channel is unknown; no other channel then
            belongs to a bus. If None, unknown channels never belong to a bus.
    """

    def __init__(self, bus_of: dict[str, str], only: str | None = None) -> None:
        self._bus_of, self._only = bus_of, only

    def bus(self, channel: str) -> str | None:
        """Return the name of a channel's bus; None if the channel belongs to none of the hand's buses."""
        only, self._only = self._only, None
        if only is not None and channel not in self._bus_of:
            self._bus_of = {channel: only}
        return self._bus_of.get(channel)


@dataclass(frozen=True, slots=True)
class OpenRecording:
    """Open recording: its frames and journal."""

    frames: Frames
    header: Header
    events: list[dict[str, Any]]
    complaints: list[str]
    """One-line message for each unreadable part of the journal."""
    lines: list[str]
    """Journal lines; empty if there is no journal."""
    journal: str
    """Name of the file that contains the journal."""
    channels: ChannelMap
    foreign: bool = False
    """Whether the header and the events were created from a hand file because there is no journal."""
    notes: tuple[str, ...] = ()
    """Assumptions made because there is no journal."""


def open_recording(path: Path) -> OpenRecording:
    """Open a recording and its journal.

    Args:
        path: A .mcap file, or a .log, .blf or .asc file whose journal is in the same folder.

    Raises:
        ConfigError: The recording or its journal cannot be read.
    """
    if path.suffix not in FRAME_FILES:
        raise ConfigError("recording", str(path), ALLOWED)
    if path.suffix == MCAP:
        reader = McapReader(path)
        raw = list(reader.journal())
        if not raw:
            allowed = "a skinnode recording; for other MCAP files with CAN frames, also give --hand"
            raise ConfigError("recording", str(path), allowed)
        header, events, complaints = parse_journal(str(path), f"{path.name} journal", raw)
        frames: Frames = reader
        name, buses = f"{path.name} journal", {bus.name: bus.name for bus in header.hand.buses}
    else:
        journal = journal_of(path)
        frames = FrameLogReader(path)  # before the journal: if both are missing, the error names the log
        try:
            header, events, complaints, raw = read_journal(journal)
        except ConfigError:
            frames.close()
            raise
        name, buses = journal.name, _channels_in(path, header.hand)
    lines = [line.decode("utf-8", "replace").rstrip("\n") for line in raw]
    return OpenRecording(frames, header, events, complaints, lines, name, ChannelMap(buses))


def open_log(path: Path, hand: HandConfig) -> OpenRecording:
    """Open a log without a journal, such as a candump log from a bus with another master.

    The patches are decoded with the layouts, code widths and baselines from the hand file. A patch without a
    baseline file is assumed to have the resistances of its undeformed layout at rest.

    Args:
        path: File with CAN frames.
        hand: The hand. The log's channels are matched with its bus names and channels.

    Raises:
        ConfigError: The log or a baseline file cannot be read, or the log has a journal.
    """
    if path.suffix not in FRAME_FILES:
        raise ConfigError("recording", str(path), ALLOWED)
    _require_no_journal(path)
    frames: Frames = McapReader(path) if path.suffix == MCAP else FrameLogReader(path)
    guests = tuple(bus.model_copy(update={"role": "guest"}) for bus in hand.buses)
    hand = hand.model_copy(update={"buses": guests})
    events: list[dict[str, Any]] = []
    notes = []
    for patch in hand.patches:
        profile = PatchProfile.from_config(patch, hand.bus(patch.bus))
        layout = patch.layout.build()
        if patch.baseline is None:
            baseline_ohm = resistance_ohm(layout, layout.upper_m)
            notes.append(f"{patch.name}: no baseline file in the hand file; assumed the undeformed layout")
        else:
            baseline_ohm = load_baseline(patch.baseline, profile)
        scale = CodeScale(patch.code_bits)
        facts = NodeFacts(patch, layout, profile, scale, baseline_ohm, None, hand.bring_up.heartbeat_s)
        events.append(
            {
                "bus": patch.bus,
                "at": 0,
                "t_ns": 0,
                "event": "resumed",
                "patch": patch.name,
                "facts": facts_table(facts, layout),
                "line": 1 + len(events),
            }
        )
    buses = _channels_in(path, hand)
    if path.suffix != ".blf":
        buses = {bus.channel: bus.name for bus in hand.buses} | {b.name: b.name for b in hand.buses} | buses
    return OpenRecording(
        frames=frames,
        header=Header(hand, "", 0),
        events=events,
        complaints=[],
        lines=[],
        journal="hand file",
        channels=ChannelMap(buses, hand.buses[0].name if len(hand.buses) == 1 else None),
        foreign=True,
        notes=tuple(notes),
    )


def _require_no_journal(path: Path) -> None:
    """Raise ConfigError if a log has a journal, whose hand and events would otherwise be ignored."""
    if path.suffix == MCAP:
        found, where = any(McapReader(path).journal()), path.name
    else:
        found, where = journal_of(path).exists(), journal_of(path).name
    if found:
        raise ConfigError("--hand", path.name, f"only for a log without a journal; {where} contains the hand")


def _channels_in(path: Path, hand: HandConfig) -> dict[str, str]:
    """Return the bus name of each channel in a log; in BLF and ASC files, channels are numbered."""
    if path.suffix in (".blf", ".asc"):
        return {str(number): bus.name for number, bus in enumerate(hand.buses)}
    return {channel: bus for bus, channel in channels(hand).items()}
