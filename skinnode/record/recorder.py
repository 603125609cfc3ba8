"""Records the frames of a running host.

The host's threads only queue entries, and a separate thread writes them. A slow disk therefore delays only
the recording.
"""

from __future__ import annotations

import datetime
import json
import logging
import queue
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.host.containment import Defects, keep_on
from skinnode.host.scan_solver import ScanSolver
from skinnode.process import clock
from skinnode.record.journal import SUFFIX, Header, facts_table
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import SUFFIXES, FrameLog, LogFormat, LoggedFrame, create

_log = logging.getLogger(__name__)

FLUSH_S: Final = 0.25
"""Interval between flushes to the kernel, s.

A crash of this process costs the recording at most its last 0.25 s.
"""

SYNC_S: Final = 1.0
"""Interval between fsync calls, s. A power failure costs the recording about its last second. Each fsync call
blocks the writer thread for about 10 ms."""

CAPACITY: Final = 50_000
"""Maximum number of queued batches of frames, enough for several seconds on four fully loaded buses."""

_ALLOWED: Final = "a folder (created if needed), or a file ending in .log or .blf"

_Entry = Callable[[], None]


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """Progress of a recorder."""

    frames: int
    """Number of frames written."""
    dropped: int
    """Number of frames not written because the disk was too slow or failed."""
    failure: str | None
    """One-line reason why recording stopped; None while it continues."""


def name_in(folder: Path, hand: HandConfig, kind: LogFormat, now: datetime.datetime) -> Path:
    """Return a path in ``folder`` for a recording, composed of the hand's name, the date and the time."""
    name = "".join(c if c.isalnum() or c in "-_" else "-" for c in hand.name)
    return folder / f"{name}-{now:%Y%m%d-%H%M%S}.{kind}"


def make_folder(path: Path) -> Path | None:
    """Create the folder ``path`` and its parents; return ``path``, or None if the folder already existed.

    Raises ConfigError if the folder cannot be created, or if its name has a suffix and is thus probably a
    misspelt file name.
    """
    if path.is_dir():
        return None
    if path.suffix or path.exists():
        raise ConfigError("recording", str(path), _ALLOWED)
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise ConfigError(
            "recording", str(path), f"a folder that can be created ({error.strerror})"
        ) from error
    return path


def _is_folder(path: Path) -> bool:
    """Return whether ``path`` is a folder. Raises ConfigError if the path is not valid."""
    try:
        return path.is_dir()
    except OSError as error:
        raise ConfigError("recording", str(path), f"{_ALLOWED} ({error.strerror})") from error


class Recorder:
    """Records the traffic of the host to which it is passed as ``tap``, until :meth:`close` is called.

    Example::

        with Recorder(hand, "runs/") as recorder, Host.from_config(hand, tap=recorder) as host:
            ...

    If recording begins before the host starts, a replay reproduces the fields bit for bit. A recording that
    begins while the host is running (:meth:`Host.tap`) lacks the initial state of the solvers. If an
    exception ends the ``with`` block before the first frame, the empty recording is deleted. If the disk
    fails (OSError), recording ends with a log message and the host continues. If writing an entry raises any
    other exception, the entry is lost and counted in ``dropped``.

    Args:
        hand: The hand.
        path: A file name ending in .log or .blf; or a folder, created if needed, for a file named after the
            hand, the date and the time. The journal is written next to the file.
        kind: File format if ``path`` is a folder.

    Raises:
        ConfigError: The log or journal already exists, or a file or folder cannot be created.
    """

    def __init__(self, hand: HandConfig, path: Path | str, kind: LogFormat = "log") -> None:
        now, asked, path = datetime.datetime.now().astimezone(), str(path), Path(path)
        self._made: Path | None = None
        """Folder that this recorder created; None if the folder already existed or is not used."""
        if asked and (_is_folder(path) or path.suffix not in SUFFIXES):
            self._made = make_folder(path)
            path = name_in(path, hand, kind, now)
        elif path.suffix not in SUFFIXES:
            raise ConfigError("recording", asked, _ALLOWED)
        self._channels = channels(hand)
        offset_ns = clock.time_ns() - clock.monotonic_ns()
        self._log = FrameLog(path, tuple(self._channels.values()))
        try:
            self._journal = create(path.with_suffix(SUFFIX))
        except ConfigError:
            self._log.close()
            path.unlink()
            raise
        self.path = path
        self._offset_ns = offset_ns
        self._at = dict.fromkeys(self._channels, 0)
        self._bus_of = {patch.name: patch.bus for patch in hand.patches}
        self._solvers: dict[str, ScanSolver] = {}
        self._lost = self._lost_reported = 0
        self._defects = Defects(str(path))
        self._flush_s = self._sync_s = clock.monotonic()
        self._ended = False
        self._failure: str | None = None
        self._queue: queue.SimpleQueue[_Entry | None] = clock.simple_queue()
        self._try(lambda: self._begin(Header(hand, now.isoformat(timespec="seconds"), offset_ns)))
        self._thread = clock.thread(target=self._run, name="record")
        self._thread.start()

    def stats(self) -> RecorderStats:
        """Return the number of frames recorded and lost so far."""
        return RecorderStats(self._log.frames, self._lost, self._failure)

    # --- methods that the host's threads call

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """Record a batch of received frames."""
        self._put(lambda: self._write_frames(bus, frames, sent=False), len(frames))

    def sent(self, bus: str, frame: Frame) -> None:
        """Record a sent frame."""
        self._put(lambda: self._write_frames(bus, (frame,), sent=True), 1)

    def resumed(self, patch: str, solver: ScanSolver, *, anew: bool) -> None:
        """Record that the host starts or resumes decoding a patch's scans."""
        known = self._solvers.get(patch) is solver
        self._solvers[patch] = solver
        facts: dict[str, Any] = {} if known else {"facts": facts_table(solver.facts)}
        self._event(patch, "resumed", anew=anew, **facts)

    def withheld(self, patch: str) -> None:
        """Record that the host stops decoding a patch's scans."""
        self._event(patch, "withheld")

    def polled(self, patch: str, t_ns: int) -> None:
        """Record that an incomplete scan timed out."""
        self._event(patch, "polled", t_ns=t_ns)

    def overtaken(self, patch: str, scan: int, t_receive_ns: int) -> None:
        """Record that a scan was skipped in favour of a newer one."""
        self._event(patch, "overtaken", scan=scan, received_ns=t_receive_ns)

    def close(self) -> None:
        """Write all queued entries, stop the thread and close the files; later entries are ignored."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        # Delete an empty recording, because its files would make a retry fail.
        if error is not None and not self._log.frames:
            self.path.unlink(missing_ok=True)
            self.path.with_suffix(SUFFIX).unlink(missing_ok=True)
            if self._made is not None:
                with suppress(OSError):  # another process may have written to the folder
                    self._made.rmdir()

    def _put(self, entry: _Entry, frames: int) -> None:
        if self._failure is not None or self._queue.qsize() >= CAPACITY:
            self._lost += frames
        elif self._thread.is_alive():
            self._queue.put(entry)

    def _event(self, patch: str, event: str, *, t_ns: int | None = None, **more: Any) -> None:
        bus, t_ns = self._bus_of[patch], clock.monotonic_ns() if t_ns is None else t_ns
        self._put(lambda: self._write_event(bus, t_ns, event, patch=patch, **more), 0)

    # --- methods that the recorder's thread calls

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "recording")
        self._try(lambda: self._write_event("", clock.monotonic_ns(), "ended", frames=self._log.frames))
        with suppress(OSError):
            self._journal.close()
        self._log.close()

    def _turn(self) -> bool:
        """Write the next entry if one arrives within a flush interval; return False after the last entry."""
        if self._ended:
            return False
        with suppress(queue.Empty):
            entry = self._queue.get(timeout=FLUSH_S)
            self._ended = entry is None
            if entry is not None:
                self._try(entry)
        now_s = clock.monotonic()
        if now_s >= self._flush_s + FLUSH_S or self._ended:
            to_disk = now_s >= self._sync_s + SYNC_S
            self._try(lambda: self._flush(to_disk=to_disk))
            self._flush_s, self._sync_s = now_s, now_s if to_disk else self._sync_s
        return True

    def _try(self, job: _Entry) -> None:
        if self._failure is not None:
            return
        try:
            job()
        except OSError as error:
            self._failure = (
                f"{self.path}: recording ended, because writing to the disk failed ({error.strerror})"
            )
            _log.warning("%s", self._failure)
        except Exception as error:
            self._lost += 1
            self._defects.report("recording", error)

    def _flush(self, *, to_disk: bool) -> None:
        """Flush the journal and then the log, so that the journal on disk is never the older of the two."""
        if self._lost != self._lost_reported:
            lost, self._lost_reported = self._lost - self._lost_reported, self._lost
            self._write_event("", clock.monotonic_ns(), "dropped", frames=lost)
        self._journal.flush()
        self._log.flush(to_disk=to_disk)

    def _begin(self, header: Header) -> None:
        """Write and flush the header, so that the recording is readable even if the process is killed."""
        self._write_line(header.line())
        self._journal.flush()

    def _write_line(self, line: str) -> None:
        self._journal.write(line + "\n")

    def _write_frames(self, bus: str, frames: Sequence[Frame], *, sent: bool) -> None:
        channel, offset_ns = self._channels[bus], self._offset_ns
        for frame in frames:
            self._log.write(LoggedFrame(frame._replace(t_ns=frame.t_ns + offset_ns), channel, sent))
        if not sent:
            self._at[bus] += len(frames)

    def _write_event(self, bus: str, t_ns: int, event: str, **more: Any) -> None:
        place = {"bus": bus, "at": self._at.get(bus, 0), "t_ns": t_ns, "event": event}
        self._write_line(json.dumps({**place, **more}))


def channels(hand: HandConfig) -> dict[str, str]:
    """Return the channel of each bus in the log: its name if candump accepts it, otherwise bus0, bus1, …."""
    names = {}
    for number, bus in enumerate(hand.buses):
        plain = bus.name.isascii() and bus.name.isalnum() and not bus.name.isdigit() and len(bus.name) < 16
        names[bus.name] = bus.name if plain else f"bus{number}"
    return names
