"""Writes CAN frames to a candump log (``.log``), a Vector BLF file or a Vector ASC file.

If the process is killed, no frame written before the last :meth:`FrameLog.flush` is lost. python-can's BLF
writer buffers up to 128 kB, and completes the file header only when it stops. Flushing a BLF file therefore
stops the writer, and a new writer appends the next frame.

An ASC file contains its start time as local time without a time zone, and the time of each frame relative to
the start. The start time written here is a whole second, because python-can's writer and reader disagree
about fractions of a second. An ASC file does not contain the identifiers or data of error frames.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, TextIO

import can

from skinnode.errors import ConfigError
from skinnode.transport.frame import Frame

SUFFIXES: Final = (".log", ".blf")
"""Suffixes of log formats suitable for recording: if the process is killed, the file is readable up to the
last flush."""
WRITABLE: Final = (*SUFFIXES, ".asc")
"""Suffixes of logs that can be written."""

_CONTAINER_BYTES: Final = 1 << 20
"""Maximum size of a BLF container before compression, in bytes. The data written between two flushes is
smaller, so no frame is split between containers."""


class LoggedFrame(NamedTuple):
    """CAN frame in a log file. Its ``t_ns`` is a wall-clock time with a resolution of 1 µs."""

    frame: Frame
    channel: str
    """Name of the channel or, if read from a BLF or ASC file, its number, counted from 0."""
    sent: bool
    """Whether the recording program itself sent the frame."""


class FrameLog:
    """Log file to which CAN frames are written. Only one thread may use it.

    :meth:`write`, :meth:`flush` and :meth:`close` raise OSError if writing fails.

    Args:
        path: Path of the new file, ending in ``.log``, ``.blf`` or ``.asc``.
        channels: Names of the channels. In BLF and ASC files, they are numbered in this order.

    Raises:
        ConfigError: if the suffix is wrong, or if the file already exists or cannot be created.
    """

    def __init__(self, path: Path, channels: tuple[str, ...]) -> None:
        if path.suffix not in WRITABLE:
            raise ConfigError("recording", str(path), "a file ending in .log, .blf or .asc")
        self.path = path
        self._numbers = {name: number for number, name in enumerate(channels)}
        self._is_blf, self._is_asc = path.suffix == ".blf", path.suffix == ".asc"
        self._file = create(path)
        self._writer: can.CanutilsLogWriter | can.BLFWriter | can.ASCWriter | None = None
        self._begun = False
        self.frames = 0
        """Number of frames written."""

    def write(self, logged: LoggedFrame) -> None:
        """Write a frame. If the process is killed before the next :meth:`flush`, the frame may be lost."""
        frame = logged.frame
        if self._writer is None:
            self._writer = self._open(frame.t_ns)
        numbered = self._is_blf or self._is_asc
        self._writer.on_message_received(
            can.Message(
                timestamp=frame.t_ns * 1e-9,
                arbitration_id=frame.can_id,
                is_extended_id=frame.extended,
                is_remote_frame=frame.remote,
                is_error_frame=frame.error,
                channel=self._numbers[logged.channel] if numbered else logged.channel,
                data=frame.data,
                is_fd=frame.fd,
                bitrate_switch=frame.fd,
                is_rx=not logged.sent,
            )
        )
        self.frames += 1

    def flush(self, *, to_disk: bool) -> None:
        """Pass all frames to the operating system, so that they survive if the process is killed.

        Args:
            to_disk: Whether to wait until the frames are on the disk, so that they survive a power failure.
        """
        if self._is_blf:
            self._end_blf()
        else:
            self._file.flush()
        if to_disk:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Write all frames to disk and close the file, even if writing fails."""
        try:
            if self._is_asc and self._writer is not None:
                self._file.write("End TriggerBlock\n")
            self.flush(to_disk=True)
        finally:
            self._file.close()

    def _open(self, t_ns: int) -> can.CanutilsLogWriter | can.BLFWriter | can.ASCWriter:
        if self._is_asc:
            writer = can.ASCWriter(self._file)
            writer.log_event("Start of recording", t_ns // 1_000_000_000)
            return writer
        if not self._is_blf:
            return can.CanutilsLogWriter(self._file)
        self._begun, append = True, self._begun
        return can.BLFWriter(self.path, append=append, max_container_size=_CONTAINER_BYTES)

    def _end_blf(self) -> None:
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.stop()
        finally:
            with contextlib.suppress(OSError):  # if the disk is full, close() fails again
                writer.file.close()


def create(path: Path) -> TextIO:
    """Create a new text file.

    Raises:
        ConfigError: if the file already exists or cannot be created.
    """
    with _errors_of(path):
        return path.open("x", encoding="ascii")


def create_binary(path: Path) -> BinaryIO:
    """Create a new binary file.

    Raises:
        ConfigError: if the file already exists or cannot be created.
    """
    with _errors_of(path):
        return path.open("xb")


@contextlib.contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    """Convert errors raised while opening a new file to ConfigError."""
    try:
        yield
    except FileExistsError:
        raise ConfigError(
            "recording", str(path), "a new file; this one already exists and is not overwritten"
        ) from None
    except OSError as error:
        raise ConfigError("recording", str(path), f"a file that can be created ({error.strerror})") from None
