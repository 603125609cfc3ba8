"""A terminal that may stall, as over a slow line, or go away: neither holds up who draws, or the end."""

from __future__ import annotations

import os
import queue
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from textual.drivers.linux_driver import LinuxDriver

if TYPE_CHECKING:
    from textual.app import App

_LAST_WORDS_S: Final = 1.0
"""How long the end waits for a terminal to take what is still to be written."""


class _Output:
    """Standard output as a file that never raises: python's own would keep a lock while the terminal stalls,
    and the end of the interpreter would wait for it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.gone = threading.Event()

    def write(self, text: str) -> None:
        data = text.encode("utf-8", "replace")
        while data and not self.gone.is_set():
            try:
                data = data[os.write(self._descriptor, data) :]
            except OSError:
                self.gone.set()

    def flush(self) -> None:
        """Nothing is kept."""

    def fileno(self) -> int:
        return self._descriptor


class PatientDriver(LinuxDriver):
    """Textual's driver, which can say that the terminal has not taken the last picture yet, or is gone."""

    def __init__(self, app: App[Any], **options: Any) -> None:
        super().__init__(app, **options)
        self._output = _Output(1)
        self._file: Any = self._output
        self.torn = False
        """Something was not written since too much waited; the picture has to be drawn anew."""

    def write(self, data: str) -> None:
        """Never waits: what finds the line full is thrown away."""
        writer = self._writer_thread
        if writer is None or writer._queue.full():
            self.torn = True
        else:
            writer.write(data)

    @property
    def busy(self) -> bool:
        """Whether something is still to be written: a new picture would only wait behind it."""
        writer = self._writer_thread
        return writer is not None and writer._queue.qsize() > 0

    @property
    def gone(self) -> bool:
        """Whether the terminal does not exist any more."""
        return self._output.gone.is_set()

    @property
    def deaf(self) -> bool:
        """Whether what is written now would wait for a terminal that stalls, or find none."""
        writer = self._writer_thread
        return self.gone or (writer is not None and writer.is_alive())

    def _run_input_thread(self) -> None:
        try:
            self.run_input_thread()
        except OSError:
            self._output.gone.set()

    def close(self) -> None:
        """End the writing thread; one that waits for a stalled terminal is left to end with the process."""
        writer = self._writer_thread
        if writer is not None:
            with suppress(queue.Full):
                writer._queue.put_nowait(None)
            writer.join(_LAST_WORDS_S)
