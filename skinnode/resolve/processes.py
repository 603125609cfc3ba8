"""Runs units in child processes on this computer.

A killed process is replaced, and its unit runs again. The standard ``ProcessPoolExecutor`` would abandon all
units instead.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Final

from skinnode.errors import SkinError
from skinnode.process.child_processes import starting_children
from skinnode.process.closing import Closing
from skinnode.resolve.identity import identity
from skinnode.resolve.units import Unit, run_unit
from skinnode.resolve.workers import MOST_DEATHS

_END_S: Final = 5.0


@dataclass(slots=True)
class _Child:
    process: SpawnProcess
    connection: Connection
    unit: Unit | None = None


class Processes(Closing):
    """Workers in child processes, which are started on demand.

    Args:
        count: Maximum number of processes.
        folder: The work folder.
    """

    def __init__(self, count: int, folder: Path) -> None:
        self._count, self._folder = count, folder
        self._identity = identity()
        self._waiting: deque[Unit] = deque()
        self._children: list[_Child] = []
        self._deaths: Counter[str] = Counter()

    @property
    def count(self) -> int:
        """Number of units that can run at the same time."""
        return self._count

    def submit(self, unit: Unit) -> None:
        """Run a unit as soon as a process is free."""
        self._waiting.append(unit)
        self._hand_out()

    def finished(self, timeout_s: float) -> Sequence[str]:
        """Wait for finished units; see :meth:`Workers.finished`."""
        keys = []
        for ready in wait([child.connection for child in self._children], timeout_s):
            child = next(each for each in self._children if each.connection is ready)
            unit, child.unit = child.unit, None
            try:
                outcome = child.connection.recv()
            except (EOFError, OSError):
                self._bury(child, unit)
                continue
            if isinstance(outcome, SkinError):
                raise outcome
            keys.append(outcome)
        self._hand_out()
        return keys

    def close(self) -> None:
        """Kill the processes; no unfinished parts are kept."""
        for child in self._children:
            child.process.kill()
        for child in self._children:
            child.process.join(_END_S)
            child.connection.close()
        self._children = []

    def _hand_out(self) -> None:
        while self._waiting:
            child = next((each for each in self._children if each.unit is None), None)
            if child is None and len(self._children) < self._count:
                child = self._start()
            if child is None:
                return
            child.unit = self._waiting.popleft()
            with suppress(OSError):  # the process has ended; finished() detects this
                child.connection.send(child.unit)

    def _start(self) -> _Child:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(
            target=_work, args=(theirs, str(self._folder), self._identity), name="resolve", daemon=True
        )
        with starting_children():
            process.start()
        theirs.close()
        child = _Child(process, ours)
        self._children.append(child)
        return child

    def _bury(self, child: _Child, unit: Unit | None) -> None:
        """Remove a process that has ended and queue its unit again."""
        child.process.join(_END_S)
        status = child.process.exitcode
        child.connection.close()
        self._children.remove(child)
        if unit is None:
            return
        self._deaths[unit.key] += 1
        if self._deaths[unit.key] >= MOST_DEATHS:
            raise SkinError(
                f"{unit}: its process ended {MOST_DEATHS} times (exit status {status}); "
                "if memory is short, use fewer --processes"
            )
        self._waiting.appendleft(unit)


def _work(parent: Connection, folder: str, expected: dict[str, str]) -> None:
    """Run units until the parent process exits or closes its end of the pipe."""
    import signal

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    worker = f"process {os.getpid()}"
    with suppress(EOFError, OSError):
        while True:
            unit = parent.recv()
            try:
                outcome: str | SkinError = run_unit(unit, folder, expected, worker)
            except Exception as error:
                outcome = SkinError(f"{unit}: {one_line_of(error)}")
            parent.send(outcome)


def one_line_of(error: Exception) -> str:
    """Return the message of a skinnode exception, or the type and message of any other exception."""
    text = str(error) if isinstance(error, SkinError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())
