"""The worker pool: threads that do the jobs they are handed, in order, as soon as one is free.

A job leaves the mainline in half a microsecond: no result object, no lock but that of the queue. A job must
not raise; what goes wrong in it is the job's own to report.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

Job = Callable[[], None]


class Workers:
    """``count`` threads, from construction to :meth:`close`."""

    def __init__(self, count: int, name: str) -> None:
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()  # None: end
        self._threads = [
            threading.Thread(target=self._run, name=f"{name} {i}", daemon=True) for i in range(count)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, job: Job) -> None:
        """Have ``job`` done by the next thread that is free."""
        self._jobs.put(job)

    def close(self) -> None:
        """Do the jobs that were handed in, end and join the threads."""
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads:
            thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()


class Inline:
    """In place of :class:`Workers`: each job is done when it is handed in, by the thread that does so."""

    def submit(self, job: Job) -> None:
        job()
