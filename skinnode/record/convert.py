"""Converts recordings between file formats and computes field tables from recordings.

The file suffixes determine the formats. A conversion between two frame files copies every frame and the
journal, so a replay of the result computes the same fields. An MCAP target also receives the fields, contacts
and poses computed by a replay. A field table contains the results of a replay and the resistances.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.model.frames import FieldFrame, ResistanceFrame
from skinnode.model.layout import Float
from skinnode.record.copy_mcap import copy_mcap
from skinnode.record.field_rows import FieldRow, row_of
from skinnode.record.journal import journal_of, new_journal_of, repaired_line
from skinnode.record.keeping_solver import KeepingSolver
from skinnode.record.log_files import LogFiles
from skinnode.record.mcap_file import MCAP, McapFile
from skinnode.record.new_file import NewFile, kept_if_complete
from skinnode.record.npz_file import NpzFile, read_npz
from skinnode.record.open_recording import FRAME_FILES, Frames, OpenRecording, open_log, open_recording
from skinnode.record.parquet_file import ParquetFile, read_parquet
from skinnode.record.replay import Replay
from skinnode.transport.frame_log import WRITABLE, LoggedFrame
from skinnode.transport.frame_log_reader import Damage

PARQUET, NPZ = ".parquet", ".npz"
TABLES: Final = (PARQUET, NPZ)
TARGETS: Final = (*FRAME_FILES, *TABLES)

_FLUSH_FRAMES: Final = 5_000
"""Number of frames between two flushes. A BLF container must not overflow between two flushes."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """Result of a conversion."""

    frames: int
    """Number of CAN frames written."""
    fields: int
    """Number of fields written."""
    faults: tuple[str, ...]
    """Messages about missing or unreadable parts of the source."""
    notes: tuple[str, ...]
    """Messages about assumptions made and about data that the target cannot store."""


class FieldTable(NewFile, Protocol):
    """New field table."""

    def write(self, row: FieldRow) -> None:
        """Write a row."""


def convert(
    source: Path, target: Path, *, hand: HandConfig | None = None, frames_only: bool = False
) -> Conversion:
    """Convert a recording or a field table. If the conversion fails, the target is deleted.

    Args:
        source: Existing file.
        target: New file.
        hand: Hand for a log without a journal; see :func:`skinnode.record.open_recording.open_log`.
        frames_only: Whether to omit the fields from an MCAP file. If the source is also an MCAP file, its
            contacts, poses, health and events are also omitted.

    Raises:
        ConfigError: The source cannot be read, the target exists or cannot be written, the conversion is not
            supported, or the packages for a format are not installed.
        OSError: The target cannot be written, for example because the disk is full.
    """
    _check(source, target, hand)
    if source.suffix in TABLES:
        return _copy_table(source, target)
    if source.suffix == target.suffix == MCAP and hand is None:
        return _copy_mcap(source, target, frames_only=frames_only)
    recording = open_recording(source) if hand is None else open_log(source, hand)
    with closing(recording.frames):
        if target.suffix in TABLES:
            return _tabulate(recording, target)
        return _copy_frames(recording, target, fields=target.suffix == MCAP and not frames_only)


def _check(source: Path, target: Path, hand: HandConfig | None) -> None:
    """Raise ConfigError if the conversion is unsupported or a file to be created exists."""
    if source.suffix not in TARGETS:
        raise ConfigError("source", str(source), ending_in(TARGETS))
    allowed = TABLES if source.suffix in TABLES else TARGETS
    if target.suffix not in allowed:
        why = "; a field table contains no frames" if source.suffix in TABLES else ""
        raise ConfigError("target", str(target), ending_in(allowed) + why)
    if source.suffix in TABLES and hand is not None:
        raise ConfigError("--hand", "a hand file", "only with a source that contains frames")
    taken = [target]
    if target.suffix in WRITABLE and not _share_journal(source, target):
        taken.append(new_journal_of(target))
    new_file = "a new file; this one already exists and is not overwritten"
    for path in taken:
        if path.exists():
            raise ConfigError("target", str(path), new_file)
    if not target.parent.is_dir():
        raise ConfigError("target", str(target), "a file in an existing folder")


def _share_journal(source: Path, target: Path) -> bool:
    """Return whether both files are logs with the same name and folder, and therefore share a journal."""
    both_logs = {source.suffix, target.suffix} <= set(WRITABLE)
    return both_logs and journal_of(source) == journal_of(target)


def ending_in(suffixes: tuple[str, ...]) -> str:
    """Return a list of the allowed file suffixes for an error message."""
    return f"a file ending in {', '.join(suffixes[:-1])} or {suffixes[-1]}"


def _copy_mcap(source: Path, target: Path, *, frames_only: bool) -> Conversion:
    frames, fields, faults = copy_mcap(source, target, frames_only=frames_only)
    notes = (f"{target.name} contains only the frames and the journal",) if frames_only else ()
    return Conversion(frames, fields, tuple(faults), notes)


def _copy_table(source: Path, target: Path) -> Conversion:
    hand, rows = read_parquet(source) if source.suffix == PARQUET else read_npz(source)
    lost = f"{target.name} cannot contain contacts or faults" if target.suffix == NPZ else None
    if source.suffix == NPZ and target.suffix == PARQUET:
        lost = f"{source.name} contains no contacts or faults"
    fields = _write_table(target, hand, rows)
    return Conversion(0, fields, (), () if lost is None or source.suffix == target.suffix else (lost,))


def _tabulate(recording: OpenRecording, target: Path) -> Conversion:
    kept: deque[ResistanceFrame] = deque()
    run = Replay(recording, solver=lambda facts, hand, now: KeepingSolver(facts, hand, now, kept))
    fields = _write_table(target, recording.lines[0] if recording.lines else "", _rows(run, kept))
    lost = "frames, journal, health and events; it cannot be converted back to a recording"
    if target.suffix == NPZ:
        lost = f"contacts, faults, {lost}"
    return Conversion(0, fields, tuple(run.flaws), (*run.notes, f"{target.name} cannot contain {lost}"))


def _rows(run: Replay, kept: deque[ResistanceFrame]) -> Iterator[FieldRow]:
    for field in run:
        yield row_of(field, kept.popleft(), run.wall_minus_mono_ns)


def _write_table(target: Path, hand: str, rows: Iterator[FieldRow]) -> int:
    new: FieldTable = ParquetFile(target, hand) if target.suffix == PARQUET else NpzFile(target, hand)
    count = 0
    with kept_if_complete(new) as table:
        for row in rows:
            table.write(row)
            count += 1
    return count


def _copy_frames(recording: OpenRecording, target: Path, *, fields: bool) -> Conversion:
    hand = recording.header.hand
    new = (
        McapFile(target, hand)
        if target.suffix == MCAP
        else LogFiles(
            target,
            hand,
            journal=not (recording.foreign or _share_journal(recording.frames.path, target)),
        )
    )
    with kept_if_complete(new) as file:
        tee = CopiedFrames(recording, file)
        run = Replay(replace(recording, frames=tee))
        if fields and isinstance(file, McapFile):
            for field in run:
                assert field.stamp is not None
                rest_m = run.layout(field.stamp.patch).upper_m
                write_computed_field(file, field, rest_m, run.wall_minus_mono_ns)
        else:
            for _ in run.frames():
                pass
        tee.mark_damage()
    written = file.fields if isinstance(file, McapFile) else 0
    return Conversion(file.frames, written, tuple(run.flaws), (*run.notes, *_losses(recording, target, tee)))


def write_computed_field(file: McapFile, field: FieldFrame, rest_m: Float, offset_ns: int) -> None:
    """Write a field computed from a recording; the log time is the time of the scan's last frame.

    Args:
        file: The file.
        field: The field; must have a stamp.
        rest_m: (U, N, 3) electrode positions at rest, in m.
        offset_ns: Unix time minus time on the stamp's clock, in ns.
    """
    assert field.stamp is not None
    file.write_field(field, rest_m, offset_ns, field.stamp.t_receive_ns + offset_ns)


class CopiedFrames:
    """Iterable over a recording's frames that also writes each frame to a file.

    Args:
        recording: The recording; the constructor writes its journal to the file.
        file: The file.
    """

    def __init__(self, recording: OpenRecording, file: LogFiles | McapFile) -> None:
        offset_ns = recording.header.wall_minus_mono_ns
        for number, line in enumerate(recording.lines):
            at_ns = recording.events[0]["t_ns"] if recording.events and number else 0
            file.write_line(line, at_ns + offset_ns)
        file.flush_journal()
        self._frames, self._file, self._channels = recording.frames, file, recording.channels
        self.path = recording.frames.path
        self.errors = 0
        """Number of error frames."""
        self._lines = recording.lines
        self._damaged = 0  # damaged parts before the newest frame
        self._newest_ns = 0

    @property
    def damages(self) -> list[Damage]:
        return self._frames.damages

    @property
    def damaged(self) -> int:
        return self._frames.damaged

    def __iter__(self) -> Iterator[LoggedFrame]:
        for number, logged in enumerate(self._frames, 1):
            self._damaged, self._newest_ns = self._frames.damaged, logged.frame.t_ns
            frame, bus = logged.frame, self._channels.bus(logged.channel)
            if bus is not None:
                self._file.write(bus, frame, sent=logged.sent, log_ns=frame.t_ns)
                self.errors += frame.error
            if number % _FLUSH_FRAMES == 0:
                self._file.flush(to_disk=False)
            yield logged

    def mark_damage(self) -> None:
        """If frames before the last one were lost, note in the journal that this is a repaired recording.

        The frame counts in the journal do not match such a copy. A log that would share the journal of the
        source gets its own journal.
        """
        if not (self._damaged and self._lines):
            return
        if isinstance(self._file, LogFiles):
            self._file.begin_journal(self._lines)
        self._file.write_line(repaired_line(self._file.frames, self._damaged), self._newest_ns)

    def close(self) -> None:
        self._frames.close()


def _losses(recording: OpenRecording, target: Path, tee: CopiedFrames) -> list[str]:
    """Return at most one line describing the data that the target cannot store."""
    lost = []
    from_mcap = recording.frames.path.suffix == MCAP
    if from_mcap and target.suffix != MCAP:
        lost += ["recorded fields, contacts, health and events (a replay computes the fields and contacts)"]
        lost += ["times finer than 1 µs"]
    if target.suffix == ".asc":
        lost += ["the time zone"]
        lost += ["the identifiers and data of error frames"] if tee.errors else []
    return [f"{target.name} cannot contain {'; '.join(lost)}"] if lost else []


__all__ = ["NPZ", "PARQUET", "TABLES", "TARGETS", "Conversion", "Frames", "convert"]
