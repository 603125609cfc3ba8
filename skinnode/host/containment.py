"""Contain exceptions in the host's threads.

An exception in one patch, bus or subscriber does not affect the others, and the failed operation is retried.
Each patch and each bus has its own record of exceptions, :class:`Defects`. The table in :mod:`skinnode.host`
lists the effect of an exception in each thread.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from skinnode.errors import SkinError
from skinnode.host.retry_pause import Pause
from skinnode.process import clock

_log = logging.getLogger(__name__)

_BRIEF_S: Final = 0.001
_LONGEST_BRIEF_S: Final = 0.02
"""Initial and maximum pause (s) after an exception in a loop. The pauses are short, because a loop may serve
several patches or buses.
"""

_COMPLAINTS: Final = 64
"""Maximum number of logged messages that a record remembers. A full record is cleared, so an earlier message
may be logged again.
"""


def one_line(error: BaseException | None) -> str:
    """Return the type and the message of an exception on one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


@dataclass(frozen=True, slots=True)
class DefectStats:
    """Summary of a :class:`Defects` record."""

    count: int
    newest: str | None
    """Last operation that raised an exception, and the exception, on one line; None if there is none."""


class Defects:
    """Record of the exceptions for one ``subject``, such as a patch or a bus. Thread-safe.

    An exception with a new message is logged on one line at level WARNING, logged with its traceback at level
    DEBUG, and passed to ``on_new``.
    """

    def __init__(self, subject: str, on_new: Callable[[SkinError], object] = lambda error: None) -> None:
        self.subject, self._on_new = subject, on_new
        self._lock = clock.lock()
        self._count = 0
        self._newest: str | None = None
        self._logged: set[str] = set()

    @property
    def count(self) -> int:
        """Number of exceptions reported so far."""
        return self._count

    @property
    def newest(self) -> str | None:
        """Last operation that raised an exception, and the exception, on one line; None if there is none."""
        return self._newest

    def stats(self) -> DefectStats:
        """Return the number of exceptions reported so far, and the newest one."""
        return DefectStats(self._count, self._newest)

    def report(self, doing: str, error: Exception) -> None:
        """Count and log ``error``, raised by the operation ``doing``. Never raises."""
        text = f"{doing}: {one_line(error)}"
        with self._lock:
            self._count += 1
            self._newest = text
            known = text in self._logged
            if len(self._logged) >= _COMPLAINTS:
                self._logged.clear()
            self._logged.add(text)
        if known:
            return
        with contextlib.suppress(Exception):  # an application's log handler may raise an exception
            _log.warning("%s: %s; retrying", self.subject, text)
            _log.debug("%s: %s", self.subject, text, exc_info=error)
        failure = SkinError(f"{self.subject}: {text}")
        failure.__cause__ = error
        with contextlib.suppress(Exception):
            self._on_new(failure)


def stats_by_subject(records: Iterable[Defects]) -> dict[str, DefectStats]:
    """Return the statistics of records by subject. Records of a patch and a bus with one name are added."""
    found: dict[str, DefectStats] = {}
    for record in records:
        stats, other = record.stats(), found.get(record.subject, DefectStats(0, None))
        found[record.subject] = DefectStats(other.count + stats.count, stats.newest or other.newest)
    return found


def keep_on(turn: Callable[[], bool], defects: Defects, doing: str) -> None:
    """Call ``turn`` until it returns False.

    An exception is reported to ``defects``. ``turn`` is called again after a pause of 1 to 20 ms.
    """
    pause = Pause(_BRIEF_S, _LONGEST_BRIEF_S)
    while True:
        try:
            if not turn():
                return
        except Exception as error:
            defects.report(doing, error)
            clock.sleep(pause.next_s())
