"""Draws in a child process of low priority, so that the host keeps its processor and its interpreter lock.

Drawing 16 patches 30 times per second takes a third of a processor core. On a thread of the host, this work
would compete with the host for the interpreter lock, and the host would skip scans.
"""

from __future__ import annotations

import multiprocessing
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Final, Self

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.model.frames import FieldFrame, amended
from skinnode.process.child_processes import starting_children
from skinnode.view.outputs import Target
from skinnode.view.tick import Tick

_NICE: Final = 10
"""Increment of the nice value of the child process."""
_END_S: Final = 8.0
"""Time limit for writing what is pending at the end, s."""


@dataclass(frozen=True, slots=True)
class DrawingOptions:
    """How a hand is drawn; see :class:`~skinnode.view.drawing.HandDrawing`."""

    exaggeration: float
    wall_minus_mono_ns: int
    live: bool


class DrawingProcess:
    """Child process that draws ticks, from construction until :meth:`close`. It also ends with this process.

    Args:
        hand: The hand.
        target: Where the drawing goes; a viewer, a file or both.
        options: How the hand is drawn.

    Raises:
        SkinError: The child process cannot draw.
    """

    def __init__(self, hand: HandConfig, target: Target, options: DrawingOptions) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_run, args=(hand, target, options, theirs), name="drawing")
        with starting_children():
            self._process.start()
        theirs.close()
        try:
            complaint = self._connection.recv()  # the SDK takes a second to load
        except EOFError:
            complaint = "its process ended immediately"
        if complaint:
            self.close()
            raise SkinError(f"drawing: {complaint}")

    def draw(self, tick: Tick) -> None:
        """Pass a tick to the child process; blocks while the process has not read the previous ones.

        Raises:
            SkinError: The child process has ended.
        """
        try:
            self._connection.send(
                replace(tick, fields={name: _slim(each) for name, each in tick.fields.items()})
            )
        except OSError:
            raise SkinError(f"drawing: {self._complaint()}") from None

    def close(self) -> None:
        """Let the child process write what is pending, and end it."""
        self._connection.close()  # makes the child process exit
        self._process.join(_END_S)
        if self._process.is_alive():  # a viewer does not read
            self._process.kill()
            self._process.join()
        self._process.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _complaint(self) -> str:
        """Return why the child process has ended."""
        with suppress(EOFError, OSError):
            if self._connection.poll(1.0):
                return str(self._connection.recv())
        return "its process ended"


def _slim(field: FieldFrame) -> FieldFrame:
    """Return a field without the arrays that are not drawn, because copying them takes time."""
    return amended(field, force_n=None, gain=None, core_std_m=None, data_share=None, by_prior=None, held=None)


def _run(hand: HandConfig, target: Target, options: DrawingOptions, parent: Connection) -> None:
    """Draw ticks until the parent process closes its end of the pipe or exits."""
    import signal

    os.environ.setdefault("RUST_LOG", "off")  # the command reports in its own words that a viewer has gone
    from skinnode.view.drawing import HandDrawing
    from skinnode.view.stream import open_stream

    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the parent, which also receives it, closes the pipe
    os.nice(_NICE)
    try:
        with open_stream(target) as stream:
            drawing = HandDrawing(
                stream,
                hand,
                exaggeration=options.exaggeration,
                wall_minus_mono_ns=options.wall_minus_mono_ns,
                live=options.live,
            )
            parent.send("")
            while True:
                drawing.draw(parent.recv())
    except EOFError:
        return
    except Exception as error:
        with suppress(OSError):
            parent.send(repr(error))
