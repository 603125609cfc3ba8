"""A pool of worker threads that run submitted jobs in order.

Submitting a job costs the mainline only half a microsecond, because, unlike ThreadPoolExecutor, this pool has
no result objects and no lock except the queue's. An exception in a job is passed to the function submitted
with the job, and the thread continues with the next job.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from types import TracebackType
from typing import Self

from skinnode.host.containment import Defects, keep_on
from skinnode.process import clock

Job = Callable[[], None]
OnError = Callable[[Exception], object]
"""Called with the exception raised by a job, on the thread that ran the job; must not raise."""


class Workers:
    """A pool of ``count`` threads, from construction to :meth:`close`.

    Threads: any thread may submit. Exceptions raised outside jobs are reported to ``defects``.
    """

    def __init__(self, count: int, name: str, defects: Defects | None = None) -> None:
        self._jobs: queue.SimpleQueue[tuple[Job, OnError] | None] = clock.simple_queue()  # None: end
        self._defects = Defects(name) if defects is None else defects
        self._threads = [clock.thread(target=self._run, name=f"{name} {i}") for i in range(count)]
        for thread in self._threads:
            thread.start()

    def submit(self, job: Job, on_error: OnError) -> None:
        """Run ``job`` on the next free thread; ``on_error`` receives its exception."""
        self._jobs.put((job, on_error))

    def close(self) -> None:
        """Run the jobs already submitted, then end and join the threads."""
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
        keep_on(self._turn, self._defects, "taking a job")

    def _turn(self) -> bool:
        """Wait for the next job and run it. Returns False when the thread must end."""
        task = self._jobs.get()
        if task is None:
            return False
        job, on_error = task
        try:
            job()
        except Exception as error:
            on_error(error)
        return True


class Inline:
    """Stand-in for :class:`Workers` that runs each job at once, on the submitting thread."""

    def submit(self, job: Job, on_error: OnError) -> None:
        """Run ``job``; ``on_error`` receives its exception."""
        try:
            job()
        except Exception as error:
            on_error(error)
