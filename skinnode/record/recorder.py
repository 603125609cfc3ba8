"""Records the frames of a running host and, in an MCAP file, also its fields, contacts, health and events.

The host's threads only queue entries, and a separate thread writes them. A slow disk therefore delays only
the recording.
"""

from __future__ import annotations

import datetime
import json
import logging
import queue
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.host.containment import Defects, keep_on
from skinnode.host.events import HealthEvent
from skinnode.host.health import BusHealth, PatchHealth
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.record.journal import Header, facts_table
from skinnode.record.log_files import LogFiles
from skinnode.record.mcap_file import MCAP, McapFile
from skinnode.record.recording_path import ALLOWED, RecordingFormat, is_folder, make_folder, name_in
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import SUFFIXES

_log = logging.getLogger(__name__)

FLUSH_S: Final = 0.25
"""Interval between flushes to the kernel, in s.

If this process crashes, at most the last 0.25 s of the recording are lost.
"""

SYNC_S: Final = 1.0
"""Interval (s) between fsync calls. In a power failure, about the last second of the recording is lost. Each
fsync call blocks the writer thread for about 10 ms."""

CAPACITY: Final = 50_000
"""Maximum number of queued entries with frames or fields, enough for several seconds on four fully loaded
buses."""

_Job = Callable[[], None]


class _Entry(NamedTuple):
    """Job of the recorder's thread, and the numbers of frames and fields that it writes."""

    job: _Job
    frames: int = 0
    fields: int = 0


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """Progress of a recorder."""

    frames: int
    """Number of frames written."""
    dropped: int
    """Number of frames not written: the disk was too slow or failed, or writing raised an exception."""
    failure: str | None
    """One-line reason why recording stopped; None while it continues."""
    fields: int = 0
    """Number of fields written; only an MCAP file contains fields."""
    fields_dropped: int = 0
    """Number of fields not written, for the same reasons."""


class Recorder:
    """Records the traffic of the host to which it is passed as ``tap``, until :meth:`close` is called.

    Example::

        with Recorder(hand, "runs/") as recorder, Host.from_config(hand, tap=recorder) as host:
            ...

    If recording begins before the host starts, a replay reproduces the fields bit for bit. A recording that
    begins while the host is running (:meth:`Host.tap`) lacks the initial state of the solvers. If an
    exception ends the ``with`` block before the first frame has been received, the recording is deleted. If
    the disk fails (OSError), recording ends with a log message and the host continues. If writing an entry
    raises any other exception, the rest of the entry is lost, and its frames are counted in ``dropped``.

    Args:
        hand: The hand.
        path: A file name ending in .log, .blf or .mcap; or a folder, created if needed, for a file named
            after the hand, the date and the time. The journal of a .log or .blf file is written next to it.
        kind: File format if ``path`` is a folder.

    Raises:
        ConfigError: The recording or its journal already exists, a file or folder cannot be created, a layout
            file cannot be used, or the packages for .mcap are not installed.
    """

    def __init__(self, hand: HandConfig, path: Path | str, kind: RecordingFormat = "log") -> None:
        now, asked, path = datetime.datetime.now().astimezone(), str(path), Path(path)
        self._made: Path | None = None
        """Folder that this recorder created; None if the folder already existed or is not used."""
        if asked and (is_folder(path) or path.suffix not in (*SUFFIXES, MCAP)):
            self._made = make_folder(path)
            path = name_in(path, hand, kind, now)
        elif path.suffix not in (*SUFFIXES, MCAP):
            raise ConfigError("recording", asked, ALLOWED)
        offset_ns = clock.time_ns() - clock.monotonic_ns()
        hand = hand.without_layout_files()
        self._mcap = McapFile(path, hand) if path.suffix == MCAP else None
        self._file = LogFiles(path, hand) if self._mcap is None else self._mcap
        self.path = path
        self._hand = hand
        self._offset_ns = offset_ns
        self._at = {bus.name: 0 for bus in hand.buses}
        self._bus_of = {patch.name: patch.bus for patch in hand.patches}
        self._solvers: dict[str, ScanSolver] = {}
        self._lost = self._lost_reported = self._fields_lost = 0
        self._unwritten = self._fields_unwritten = 0  # counted by the recorder's thread
        self._lost_before: list[Callable[[], int]] = []
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
        frames, fields = self._counts()
        fields_lost = self._fields_lost + self._fields_unwritten + sum(lost() for lost in self._lost_before)
        return RecorderStats(frames, self._lost + self._unwritten, self._failure, fields, fields_lost)

    @property
    def records_fields(self) -> bool:
        """Whether the file can contain fields, contacts, health and events."""
        return self._mcap is not None

    # --- methods called by the host's threads

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """Record a batch of received frames."""
        log_ns = clock.monotonic_ns() + self._offset_ns
        self._put(_Entry(lambda: self._write_frames(bus, frames, log_ns, sent=False), len(frames)))

    def sent(self, bus: str, frame: Frame) -> None:
        """Record a sent frame."""
        log_ns = clock.monotonic_ns() + self._offset_ns
        self._put(_Entry(lambda: self._write_frames(bus, (frame,), log_ns, sent=True), 1))

    def numbered(self, bus: str, t_ns: int, number: int) -> None:
        """Record the number of the SYNC sent at monotonic time ``t_ns``."""
        self._put(_Entry(lambda: self._write_event(bus, t_ns, "sync", number=number)))

    def resumed(self, patch: str, solver: ScanSolver, *, anew: bool) -> None:
        """Record that the host starts or resumes decoding a patch's scans."""
        known = self._solvers.get(patch) is solver
        self._solvers[patch] = solver
        facts: dict[str, Any] = {}
        if not known:
            facts["facts"] = facts_table(solver.facts, self._hand.patch(patch).layout.build())
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

    # --- methods for the data that only an MCAP file can contain; see follow()

    def field(self, field: FieldFrame) -> None:
        """Record a field and its contacts; callable from any thread."""
        file, log_ns = self._mcap, clock.monotonic_ns() + self._offset_ns
        if file is None or field.stamp is None:
            return
        solver = self._solvers.get(field.stamp.patch)
        layout = self._hand.patch(field.stamp.patch).layout.build() if solver is None else solver.facts.layout
        job = partial(file.write_field, field, layout.upper_m, self._offset_ns, log_ns)
        self._put(_Entry(job, fields=1))

    def health(self, patches: Mapping[str, PatchHealth], buses: Mapping[str, BusHealth]) -> None:
        """Record the health of all patches and buses; callable from any thread."""
        if self._mcap is not None:
            log_ns = clock.monotonic_ns() + self._offset_ns
            self._put(_Entry(partial(self._mcap.write_health, patches, buses, log_ns)))

    def event(self, event: HealthEvent) -> None:
        """Record an event; callable from any thread."""
        if self._mcap is not None:
            log_ns = clock.monotonic_ns() + self._offset_ns
            self._put(_Entry(partial(self._mcap.write_event, event, self._offset_ns, log_ns)))

    def count_lost_fields(self, lost: Callable[[], int]) -> None:
        """Add a function that returns the number of fields lost before they reached the recorder."""
        self._lost_before.append(lost)

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
        # Delete a recording of a silent bus, because its files would make a retry fail.
        if error is not None and not any(self._at.values()):
            self._file.discard()
            if self._made is not None:
                with suppress(OSError):  # another process may have written to the folder
                    self._made.rmdir()

    def _put(self, entry: _Entry) -> None:
        """Queue an entry, or count it as lost.

        A full queue still accepts journal events, which are few: without them, a replay would decode the
        later scans with an old baseline.
        """
        refused = (entry.frames or entry.fields) and self._queue.qsize() >= CAPACITY
        if self._failure is not None or refused:
            self._lost += entry.frames
            self._fields_lost += entry.fields
        elif self._thread.is_alive():
            self._queue.put(entry)

    def _event(self, patch: str, event: str, *, t_ns: int | None = None, **more: Any) -> None:
        bus, t_ns = self._bus_of[patch], clock.monotonic_ns() if t_ns is None else t_ns
        self._put(_Entry(lambda: self._write_event(bus, t_ns, event, patch=patch, **more)))

    # --- methods called by the recorder's thread

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "recording")
        self._try(lambda: self._write_event("", clock.monotonic_ns(), "ended", frames=self._file.frames))
        try:
            self._file.close()
        except OSError as error:
            self._fail(error)

    def _turn(self) -> bool:
        """Write the next entry if one arrives within a flush interval; return False after the last entry."""
        if self._ended:
            return False
        with suppress(queue.Empty):
            entry = self._queue.get(timeout=FLUSH_S)
            self._ended = entry is None
            if entry is not None:
                self._write(entry)
        now_s = clock.monotonic()
        if now_s >= self._flush_s + FLUSH_S or self._ended:
            to_disk = now_s >= self._sync_s + SYNC_S
            self._try(lambda: self._flush(to_disk=to_disk))
            self._flush_s, self._sync_s = now_s, now_s if to_disk else self._sync_s
        return True

    def _write(self, entry: _Entry) -> None:
        """Write an entry; count any frames and fields that could not be written."""
        before = self._counts()
        self._try(entry.job)
        frames, fields = self._counts()
        self._unwritten += entry.frames - (frames - before[0])
        self._fields_unwritten += entry.fields - (fields - before[1])

    def _counts(self) -> tuple[int, int]:
        """Return the numbers of frames and fields in the file."""
        return self._file.frames, 0 if self._mcap is None else self._mcap.fields

    def _try(self, job: _Job) -> None:
        if self._failure is not None:
            return
        try:
            job()
        except OSError as error:
            self._fail(error)
        except Exception as error:
            self._defects.report("recording", error)

    def _fail(self, error: OSError) -> None:
        """End the recording because of a disk error; only the first error is reported."""
        if self._failure is None:
            self._failure = (
                f"{self.path}: recording ended, because writing to the disk failed ({error.strerror})"
            )
            _log.warning("%s", self._failure)

    def _flush(self, *, to_disk: bool) -> None:
        """Write and flush all data recorded so far."""
        lost = self._lost + self._unwritten
        if lost != self._lost_reported:
            new, self._lost_reported = lost - self._lost_reported, lost
            self._write_event("", clock.monotonic_ns(), "dropped", frames=new)
        self._file.flush(to_disk=to_disk)

    def _begin(self, header: Header) -> None:
        """Write and flush the header, so that the recording is readable even if the process is killed."""
        self._file.write_line(header.line(), clock.monotonic_ns() + self._offset_ns)
        self._file.flush_journal()

    def _write_frames(self, bus: str, frames: Sequence[Frame], log_ns: int, *, sent: bool) -> None:
        file, offset_ns = self._file, self._offset_ns
        for frame in frames:
            file.write(bus, frame._replace(t_ns=frame.t_ns + offset_ns), sent=sent, log_ns=log_ns)
            self._at[bus] += not sent

    def _write_event(self, bus: str, t_ns: int, event: str, **more: Any) -> None:
        place = {"bus": bus, "at": self._at.get(bus, 0), "t_ns": t_ns, "event": event}
        self._file.write_line(json.dumps({**place, **more}), clock.monotonic_ns() + self._offset_ns)
