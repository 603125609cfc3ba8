"""Writes down a host as it runs. The host's threads leave what they have in a queue; a thread of the
recorder's own writes, so that a slow disk costs nobody but the recording anything.
"""

from __future__ import annotations

import datetime
import json
import logging
import queue
import threading
import time
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
from skinnode.record.journal import SUFFIX, Header, facts_table
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import SUFFIXES, FrameLog, LogFormat, LoggedFrame, create

_log = logging.getLogger(__name__)

FLUSH_S: Final = 0.25
"""What was written longer ago is the kernel's, and survives this process."""

SYNC_S: Final = 1.0
"""What was written longer ago is on the disk. An fsync takes about 10 ms, of the writing thread alone."""

CAPACITY: Final = 50_000
"""Batches that wait for the disk, at most: some seconds of four full buses."""

_ALLOWED: Final = "a folder (created if needed), or a file ending in .log or .blf"

_Entry = Callable[[], None]


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """What a recorder has done so far."""

    frames: int
    """Written."""
    dropped: int
    """Not written, because the disk was too slow or failed."""
    failure: str | None
    """Why nothing is written any more, in one line; None while all is well."""


def name_in(folder: Path, hand: HandConfig, kind: LogFormat, now: datetime.datetime) -> Path:
    """A file named after the hand, date and time."""
    name = "".join(c if c.isalnum() or c in "-_" else "-" for c in hand.name)
    return folder / f"{name}-{now:%Y%m%d-%H%M%S}.{kind}"


def make_folder(path: Path) -> Path | None:
    """Create the folder ``path`` with its parents, and return it; None if it existed already.

    A name with a suffix is taken for a misspelt recording. Raises ConfigError for such a name, or if the
    folder cannot be created.
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
    """Return whether ``path`` is a folder. Raises ConfigError if it cannot be a file or a folder, such as a
    name that is too long.
    """
    try:
        return path.is_dir()
    except OSError as error:
        raise ConfigError("recording", str(path), f"{_ALLOWED} ({error.strerror})") from error


class Recorder:
    """A recording under way, from construction to :meth:`close`; the host's ``tap``::

        with Recorder(hand, "runs/") as recorder, Host.from_config(hand, tap=recorder) as host:
            ...

    ``path`` is a file ending in .log or .blf, or a folder, created if needed, in which the file is named
    after the hand, date and time; the journal is written beside it. Raises ConfigError if one of the files
    exists, or if one of them or the folder cannot be created.
    A ``with`` block that fails before the first frame leaves neither behind.
    If the disk fails, the recording ends, one log line says so, and the host continues. An entry that raises
    any other exception is lost, and counted in ``dropped``.

    A recording that begins before the host does replays bit by bit; one that is begun while the host runs
    (:meth:`Host.tap`) lacks what the solvers had in memory.
    """

    def __init__(self, hand: HandConfig, path: Path | str, kind: LogFormat = "log") -> None:
        now, asked, path = datetime.datetime.now().astimezone(), str(path), Path(path)
        self._made: Path | None = None
        """Folder that this recorder created; None if it existed."""
        if asked and (_is_folder(path) or path.suffix not in SUFFIXES):
            self._made = make_folder(path)
            path = name_in(path, hand, kind, now)
        elif path.suffix not in SUFFIXES:
            raise ConfigError("recording", asked, _ALLOWED)
        self._channels = channels(hand)
        offset_ns = time.time_ns() - time.monotonic_ns()
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
        self._lost = self._lost_told = 0
        self._defects = Defects(str(path))
        self._flush_s = self._sync_s = time.monotonic()
        self._ended = False
        self._failure: str | None = None
        self._queue: queue.SimpleQueue[_Entry | None] = queue.SimpleQueue()
        self._try(lambda: self._begin(Header(hand, now.isoformat(timespec="seconds"), offset_ns)))
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)
        self._thread.start()

    def stats(self) -> RecorderStats:
        return RecorderStats(self._log.frames, self._lost, self._failure)

    # --- of the host's threads

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        self._put(lambda: self._write_frames(bus, frames, sent=False), len(frames))

    def sent(self, bus: str, frame: Frame) -> None:
        self._put(lambda: self._write_frames(bus, (frame,), sent=True), 1)

    def resumed(self, patch: str, solver: ScanSolver, *, anew: bool) -> None:
        known = self._solvers.get(patch) is solver
        self._solvers[patch] = solver
        facts: dict[str, Any] = {} if known else {"facts": facts_table(solver.facts)}
        self._event(patch, "resumed", anew=anew, **facts)

    def withheld(self, patch: str) -> None:
        self._event(patch, "withheld")

    def polled(self, patch: str, t_ns: int) -> None:
        self._event(patch, "polled", t_ns=t_ns)

    def overtaken(self, patch: str, scan: int, t_receive_ns: int) -> None:
        self._event(patch, "overtaken", scan=scan, received_ns=t_receive_ns)

    def close(self) -> None:
        """Write what is waiting, end and join the thread, close the files. What comes later is ignored."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if error is not None and not self._log.frames:  # nothing worth keeping, and in the way of a retry
            self.path.unlink(missing_ok=True)
            self.path.with_suffix(SUFFIX).unlink(missing_ok=True)
            if self._made is not None:
                with suppress(OSError):  # another process may use it by now
                    self._made.rmdir()

    def _put(self, entry: _Entry, frames: int) -> None:
        if self._failure is not None or self._queue.qsize() >= CAPACITY:
            self._lost += frames
        elif self._thread.is_alive():
            self._queue.put(entry)

    def _event(self, patch: str, event: str, *, t_ns: int | None = None, **more: Any) -> None:
        bus, t_ns = self._bus_of[patch], time.monotonic_ns() if t_ns is None else t_ns
        self._put(lambda: self._write_event(bus, t_ns, event, patch=patch, **more), 0)

    # --- of its own thread

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "recording")
        self._try(lambda: self._write_event("", time.monotonic_ns(), "ended", frames=self._log.frames))
        with suppress(OSError):
            self._journal.close()
        self._log.close()

    def _turn(self) -> bool:
        """Wait briefly for the next entry and write it. Returns whether there may be more."""
        if self._ended:
            return False
        with suppress(queue.Empty):
            entry = self._queue.get(timeout=FLUSH_S)
            self._ended = entry is None
            if entry is not None:
                self._try(entry)
        now_s = time.monotonic()
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
            self._failure = f"{self.path}: recording ended, the disk does not take it ({error.strerror})"
            _log.warning("%s", self._failure)
        except Exception as error:
            self._lost += 1
            self._defects.report("recording", error)

    def _flush(self, *, to_disk: bool) -> None:
        """The journal first: it must not know less than the log."""
        if self._lost != self._lost_told:
            lost, self._lost_told = self._lost - self._lost_told, self._lost
            self._write_event("", time.monotonic_ns(), "dropped", frames=lost)
        self._journal.flush()
        self._log.flush(to_disk=to_disk)

    def _begin(self, header: Header) -> None:
        """At once, so that a recording that is killed at any moment can be read."""
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
    """The channel in a log of each bus: its name, where candump could have written it."""
    names = {}
    for number, bus in enumerate(hand.buses):
        plain = bus.name.isascii() and bus.name.isalnum() and not bus.name.isdigit() and len(bus.name) < 16
        names[bus.name] = bus.name if plain else f"bus{number}"
    return names
