"""Frames to a file through python-can's writers: candump's text (``.log``) and Vector's BLF.

Both keep what was written before the last :meth:`FrameLog.flush` whatever happens to the process after it.
A ``.log`` only grows. python-can's BLF writer keeps up to 128 kB of frames for itself, and a file header that
it corrects at its end: so a flush ends the writer and opens another that appends, which leaves a whole BLF
file each time.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final, Literal, NamedTuple, TextIO

import can

from skinnode.errors import ConfigError
from skinnode.transport.frame import Frame

LogFormat = Literal["log", "blf"]
SUFFIXES: Final = (".log", ".blf")

_CONTAINER_BYTES: Final = 1 << 20
"""Most of a BLF container, uncompressed: more than is written between two flushes, so that no frame lies in
two of them."""


class LoggedFrame(NamedTuple):
    """A frame as a log holds it: ``t_ns`` of the frame is of the wall clock, to 1 µs."""

    frame: Frame
    channel: str
    """Name of the channel; in BLF, where channels are numbers, its number from 0 on."""
    sent: bool
    """By whoever recorded."""


class FrameLog:
    """A log that is being written. Owned by one thread.

    ``channels`` are the names that frames will come with; BLF numbers them in this order. Raises ConfigError
    for a file that is there already or cannot be made. The other methods raise OSError where the disk does
    not take what is written.
    """

    def __init__(self, path: Path, channels: tuple[str, ...]) -> None:
        if path.suffix not in SUFFIXES:
            raise ConfigError("recording", str(path), "a file ending in .log or .blf")
        self.path = path
        self._numbers = {name: number for number, name in enumerate(channels)}
        self._is_blf = path.suffix == ".blf"
        self._file = create(path)
        self._writer: can.CanutilsLogWriter | can.BLFWriter | None = None
        self._begun = False
        self.frames = 0
        """Frames written."""

    def write(self, logged: LoggedFrame) -> None:
        """Write a frame; it is safe after the next :meth:`flush`."""
        frame = logged.frame
        if self._writer is None:
            self._writer = self._open()
        self._writer.on_message_received(
            can.Message(
                timestamp=frame.t_ns * 1e-9,
                arbitration_id=frame.can_id,
                is_extended_id=frame.extended,
                is_remote_frame=frame.remote,
                is_error_frame=frame.error,
                channel=self._numbers[logged.channel] if self._is_blf else logged.channel,
                data=frame.data,
                is_fd=frame.fd,
                bitrate_switch=frame.fd,
                is_rx=not logged.sent,
            )
        )
        self.frames += 1

    def flush(self, *, to_disk: bool) -> None:
        """Hand what was written to the kernel, which keeps it if this process is killed; ``to_disk``: and
        from there to the disk, which keeps it if the machine is."""
        if self._is_blf:
            self._end_blf()
        else:
            self._file.flush()
        if to_disk:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """End the file. Does not raise: what could not be written has been complained of by then."""
        with contextlib.suppress(OSError):
            self.flush(to_disk=True)
        with contextlib.suppress(OSError):
            self._file.close()

    def _open(self) -> can.CanutilsLogWriter | can.BLFWriter:
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
            with contextlib.suppress(OSError):  # of a disk that is full, a second time
                writer.file.close()


def create(path: Path) -> TextIO:
    """A new text file. Raises ConfigError where there is one already, or none can be made."""
    try:
        return path.open("x", encoding="ascii")
    except FileExistsError:
        raise ConfigError(
            "recording", str(path), "a new file; this one exists and is not written over"
        ) from None
    except OSError as error:
        raise ConfigError("recording", str(path), f"a file that can be made ({error.strerror})") from None
