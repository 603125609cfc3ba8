"""Contain exceptions in the host's threads.

Exceptions are recorded in :class:`Defects`; each patch and each bus has its own record. An exception that
concerns one patch, bus or subscriber does not affect the others. The failed operation is retried. The table
in :mod:`skinnode.host` lists the effects of an exception in each thread.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.errors import SkinError
from skinnode.host.retry_pause import Pause
from skinnode.process import clock

_log = logging.getLogger(__name__)

_BRIEF_S: Final = 0.001
_LONGEST_BRIEF_S: Final = 0.02
"""First and longest pause (s) after an exception in a loop that serves several patches or buses. The pauses
are short because a failure of one patch or bus must not delay the others.
"""

_COMPLAINTS: Final = 64
"""Maximum number of logged messages that a record remembers. After this number of distinct messages, an
earlier message may be logged again.
"""


def one_line(error: BaseException | None) -> str:
    """Return an exception's type and message as one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


@dataclass(frozen=True, slots=True)
class DefectStats:
    """Statistics of the exceptions in a :class:`Defects` record."""

    count: int
    newest: str | None
    """Operation that failed most recently and its exception, in one line; None before the first exception."""


class Defects:
    """Thread-safe record of the exceptions that concern ``subject``, for example a patch or a bus.

    The first exception with a given message is passed to ``on_new``, logged as one line at level WARNING, and
    logged with its traceback at level DEBUG.
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
        """Operation that failed most recently and its exception, in one line; None if nothing has failed."""
        return self._newest

    def stats(self) -> DefectStats:
        """Return the statistics of the exceptions reported so far."""
        return DefectStats(self._count, self._newest)

    def report(self, doing: str, error: Exception) -> None:
        """Count and log ``error``, which was raised by the operation ``doing``. Never raises."""
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
        with contextlib.suppress(Exception):  # the application's log handlers may raise exceptions
            _log.warning("%s: %s; retrying", self.subject, text)
            _log.debug("%s: %s", self.subject, text, exc_info=error)
        failure = SkinError(f"{self.subject}: {text}")
        failure.__cause__ = error
        with contextlib.suppress(Exception):
            self._on_new(failure)


def keep_on(turn: Callable[[], bool], defects: Defects, doing: str) -> None:
    """Call ``turn`` repeatedly until it returns False.

    After a call that raises an exception, the function pauses for 1 to 20 ms.
    """
    pause = Pause(_BRIEF_S, _LONGEST_BRIEF_S)
    while True:
        try:
            if not turn():
                return
        except Exception as error:
            defects.report(doing, error)
            clock.sleep(pause.next_s())
