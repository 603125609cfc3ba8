"""Writes to the terminal without blocking, even if it stalls or disappears."""

from __future__ import annotations

import os
import queue
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from textual.drivers.linux_driver import LinuxDriver

if TYPE_CHECKING:
    from textual.app import App

_STDOUT: Final = 1

_MAX_QUEUED: Final = 30
"""Maximum number of writes queued for the terminal, enough for a few screen updates."""

_END_S: Final = 1.0
"""Maximum time (s) to wait at exit for the terminal to accept queued output."""


class _Writer(threading.Thread):
    """Writes text to a file descriptor on a daemon thread.

    The thread bypasses ``sys.stdout``: a blocked write would hold its lock, and the interpreter waits for
    that lock at exit.
    """

    def __init__(self, descriptor: int, gone: threading.Event) -> None:
        super().__init__(daemon=True, name="terminal-output")
        self.queue: queue.Queue[str | None] = queue.Queue(_MAX_QUEUED)
        self._descriptor, self._gone = descriptor, gone

    def run(self) -> None:
        """Write queued text until None is queued."""
        while (text := self.queue.get()) is not None:
            data = text.encode("utf-8", "replace")
            while data and not self._gone.is_set():
                try:
                    data = data[os.write(self._descriptor, data) :]
                except OSError:
                    self._gone.set()

    def end(self) -> None:
        """End the thread once the queue is empty.

        A thread blocked by a stalled terminal ends with the process.
        """
        with suppress(queue.Full):
            self.queue.put_nowait(None)
        self.join(_END_S)


class PatientDriver(LinuxDriver):
    """Textual driver that reports a slow or vanished terminal instead of waiting for it."""

    def __init__(self, app: App[Any], **options: Any) -> None:
        super().__init__(app, **options)
        self._gone = threading.Event()
        self._writer: _Writer | None = None
        self.torn = False
        """Whether the screen must be redrawn because the queue was full and output was discarded."""

    def start_application_mode(self) -> None:
        """Start the writer thread, then enter application mode."""
        self._writer = _Writer(_STDOUT, self._gone)
        self._writer.start()
        super().start_application_mode()  # type: ignore[no-untyped-call]

    def write(self, data: str) -> None:
        """Queue ``data`` for the terminal, or discard it if the queue is full."""
        try:
            if self._writer is not None:
                self._writer.queue.put_nowait(data)
        except queue.Full:
            self.torn = True

    @property
    def busy(self) -> bool:
        """Whether queued output is still waiting for the terminal to accept it."""
        return self._writer is not None and self._writer.queue.qsize() > 0

    @property
    def gone(self) -> bool:
        """Whether the terminal no longer exists."""
        return self._gone.is_set()

    @property
    def deaf(self) -> bool:
        """Whether the terminal no longer exists or did not accept all output before the driver closed."""
        return self.gone or (self._writer is not None and self._writer.is_alive())

    def run_input_thread(self) -> None:
        """Read keys until the application ends. An input error means that the terminal was closed."""
        try:
            super().run_input_thread()
        except OSError:
            self._gone.set()

    def close(self) -> None:
        """End the writer thread, then close Textual's driver."""
        if self._writer is not None:
            self._writer.end()
        super().close()
