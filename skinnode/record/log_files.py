"""Writes a recording as a candump log or a BLF file, with the journal in a separate file next to it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from itertools import count
from pathlib import Path

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.files.whole_file import discard
from skinnode.record.journal import new_journal_of
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import FrameLog, LoggedFrame, create


class LogFiles:
    """Log and journal of a recording. Only one thread may write to it.

    All write methods raise OSError if writing fails.

    Args:
        path: Path of the new log.
        hand: The hand.
        journal: Whether to write a journal.

    Raises:
        ConfigError: The log or the journal already exists or cannot be created.
    """

    def __init__(self, path: Path, hand: HandConfig, *, journal: bool = True) -> None:
        self.path = path
        self._channels = channels(hand)
        self._log = FrameLog(path, tuple(self._channels.values()))
        self._journal, self._journal_path = None, new_journal_of(path)
        try:
            if journal:
                self._journal = create(self._journal_path)
        except ConfigError:
            self._log.close()
            path.unlink()
            raise

    @property
    def frames(self) -> int:
        """Number of frames written."""
        return self._log.frames

    def write(self, bus: str, frame: Frame, *, sent: bool, log_ns: int) -> None:
        """Write a frame. The frame's ``t_ns`` is a Unix time; the format cannot store ``log_ns``."""
        self._log.write(LoggedFrame(frame, self._channels[bus], sent))

    def write_line(self, line: str, log_ns: int) -> None:
        """Write a journal line."""
        if self._journal is not None:
            self._journal.write(line + "\n")

    def begin_journal(self, lines: Iterable[str]) -> None:
        """Give a log without a journal its own journal, which begins with ``lines``.

        If a journal already exists, nothing changes.

        Raises:
            ConfigError: The journal cannot be created.
        """
        if self._journal is None:
            self._journal = create(self._journal_path)
            self._journal.writelines(line + "\n" for line in lines)

    def flush(self, *, to_disk: bool) -> None:
        """Flush the journal before the log, so that the journal on disk is never older than the log."""
        if self._journal is not None:
            self._journal.flush()
        self._log.flush(to_disk=to_disk)

    def flush_journal(self) -> None:
        """Flush the journal."""
        if self._journal is not None:
            self._journal.flush()

    def close(self) -> None:
        """Close both files, even if writing fails."""
        try:
            if self._journal is not None:
                self._journal.close()
        finally:
            self._log.close()

    def discard(self) -> None:
        """Close and delete the files."""
        with contextlib.suppress(Exception):  # the files may already be closed
            self.close()
        discard(self.path)
        if self._journal is not None:
            discard(self._journal_path)


def channels(hand: HandConfig) -> dict[str, str]:
    """Return each bus's channel in the log: the bus name if candump accepts it, otherwise bus0, bus1, ….

    No two buses have the same channel.
    """
    names = {bus.name: bus.name for bus in hand.buses if _is_plain(bus.name)}
    for number, bus in enumerate(hand.buses):
        if bus.name not in names:
            free = (name for n in count(number) if (name := f"bus{n}") not in names.values())
            names[bus.name] = next(free)
    return {bus.name: names[bus.name] for bus in hand.buses}


def _is_plain(name: str) -> bool:
    """Return whether candump accepts ``name`` as a channel."""
    return name.isascii() and name.isalnum() and not name.isdigit() and len(name) < 16
