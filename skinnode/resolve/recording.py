"""Identifies a recording and opens it with the hand of a variant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from skinnode.config import HandConfig
from skinnode.errors import ConfigError, SkinError
from skinnode.record.journal import Header, journal_of
from skinnode.record.mcap_file import MCAP
from skinnode.record.open_recording import OpenRecording, open_log, open_recording


@dataclass(frozen=True, slots=True)
class Recording:
    """Recording, and the state of its files when the command started."""

    path: Path
    """Absolute path."""
    foreign: bool
    """Whether this is a log made by another master, without a journal."""
    state: tuple[tuple[int, int], ...]
    """Size (bytes) and modification time (ns) of each of its files."""

    def opened(self, hand: HandConfig) -> OpenRecording:
        """Open the recording with another hand.

        Args:
            hand: The hand, with the same buses and patches as the recording's hand.

        Raises:
            ConfigError: The recording cannot be read.
            SkinError: The files have changed since the command started.
        """
        if _state(self.path, foreign=self.foreign) != self.state:
            raise SkinError(
                f"{self.path}: is not the file that the command started with; run the command again, "
                "or make the file available to all workers under this path"
            )
        if self.foreign:
            return open_log(self.path, hand)
        recording = open_recording(self.path)
        own = recording.header
        same = {patch.name for patch in hand.patches if patch.layout == own.hand.patch(patch.name).layout}
        header = replace(own, hand=hand, layoutless=own.layoutless & same)
        lines = [Header(hand, header.started, header.wall_minus_mono_ns).line(), *recording.lines[1:]]
        return replace(recording, header=header, lines=lines)


def recording_at(path: Path, hand: HandConfig | None) -> tuple[Recording, HandConfig]:
    """Return a recording and its hand.

    Args:
        path: The file.
        hand: Hand for a log without a journal; None for a recording made by skinnode.

    Raises:
        ConfigError: The recording cannot be read.
    """
    opened = open_recording(path) if hand is None else open_log(path, hand)
    opened.frames.close()
    path = path.resolve()
    recording = Recording(path, hand is not None, _state(path, foreign=hand is not None))
    return recording, opened.header.hand if hand is None else hand


def _state(path: Path, *, foreign: bool) -> tuple[tuple[int, int], ...]:
    files = [path] if foreign or path.suffix == MCAP else [path, journal_of(path)]
    try:
        return tuple((file.stat().st_size, file.stat().st_mtime_ns) for file in files)
    except OSError as error:
        allowed = f"a file that can be read ({error.strerror})"
        raise ConfigError("recording", str(error.filename), allowed) from None
