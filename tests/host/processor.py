"""How long this process has waited for a processor that others use: time that no deadline should count."""

from __future__ import annotations

from pathlib import Path

_TASKS = Path("/proc/self/task")


class ProcessorWait:
    """Total time that the threads of this process were ready to run and did not run, since creation.

    The sum over threads is an upper bound for the delay of what several threads do one after the other. On
    a machine with nothing else to do it is a few milliseconds per second. Linux only; elsewhere it is 0.
    """

    def __init__(self) -> None:
        self._known: dict[str, int] = {}
        self._total_ns = 0
        self.seconds()
        self._total_ns = 0

    def seconds(self) -> float:
        """Return the total up to now; threads count that ran at two calls or began in between."""
        for thread in _TASKS.glob("*"):
            try:
                waited_ns = int((thread / "schedstat").read_text().split()[1])
            except (OSError, IndexError):
                continue  # it has ended
            self._total_ns += waited_ns - self._known.get(thread.name, 0)
            self._known[thread.name] = waited_ns
        return self._total_ns * 1e-9
