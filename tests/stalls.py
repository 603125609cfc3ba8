"""Tests that count frames in real time on a machine that others use too: one that stood still while a test
ran is no witness, and the test runs again. A machine, or code of ours, that always stands still fails it."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Final, Self

TRIES: Final = 3
STALL_S: Final = 0.02
"""Less than one scan period of the tests; a thread that sleeps wakes within a few milliseconds otherwise."""

_NAP_S: Final = 0.004


class StallWatch:
    """Longest time for which a thread that only sleeps was kept from waking."""

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stall watch")

    def _run(self) -> None:
        before_s = time.monotonic()
        while not self._over.wait(_NAP_S):
            now_s = time.monotonic()
            self.worst_s = max(self.worst_s, now_s - before_s - _NAP_S)
            before_s = now_s

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
