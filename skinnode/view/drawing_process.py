"""Draws in a low-priority child process, to leave the CPU and the interpreter lock to the host.

Drawing 16 patches 30 times per second takes a third of a CPU core. In a thread of the host process, this work
would compete with the host for the interpreter lock, and the host would skip scans.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.model.frames import FieldFrame, SolveStats, amended
from skinnode.process.child_processes import starting_children
from skinnode.process.closing import Closing
from skinnode.view.outputs import Target
from skinnode.view.tick import Tick

_NICE: Final = 10
"""Increment added to the child process's nice value."""
_END_S: Final = 8.0
"""Time limit for writing the pending data on closing, in s."""

_NOT_DRAWN: Final[dict[str, Any]] = {
    **dict.fromkeys(("force_n", "gain", "core_std_m", "data_share", "by_prior", "held")),
    **dict.fromkeys(("residual", "wires_trusted"), np.empty(0)),  # the same object is pickled once
    "stats": SolveStats(0, 0, 0, 0.0),
    "status": (),
}
"""Attributes of a field that the child process does not need, and their values there."""


@dataclass(frozen=True, slots=True)
class DrawingOptions:
    """Drawing options; see :class:`~skinnode.view.drawing.HandDrawing`."""

    exaggeration: float
    wall_minus_mono_ns: int
    live: bool


class DrawingProcess(Closing):
    """Child process that draws ticks from construction until :meth:`close`, or until this process exits.

    Args:
        hand: The hand.
        target: Destination of the drawing: a viewer, a file or both.
        options: Drawing options.

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
        """Pass a tick to the child process; block while the pipe is full of unread ticks.

        Raises:
            SkinError: The child process has ended.
        """
        slim = replace(tick, fields={name: _slim(each) for name, each in tick.fields.items()})
        try:  # Connection.send() pickles with an older protocol, which copies the arrays once more
            self._connection.send_bytes(pickle.dumps(slim, pickle.HIGHEST_PROTOCOL))
        except OSError:
            raise SkinError(f"drawing: {self._complaint()}") from None

    def close(self) -> None:
        """Let the child process write its pending data, then end it."""
        self._connection.close()  # makes the child process exit
        self._process.join(_END_S)
        if self._process.is_alive():  # the viewer may have stopped reading
            self._process.kill()
            self._process.join()
        self._process.close()

    def _complaint(self) -> str:
        """Return the reason why the child process ended."""
        with suppress(EOFError, OSError):
            if self._connection.poll(1.0):
                return str(self._connection.recv())
        return "its process ended"


def _slim(field: FieldFrame) -> FieldFrame:
    """Return the field with only what is drawn, because pickling it holds the interpreter lock."""
    return amended(field, **_NOT_DRAWN)


def _run(hand: HandConfig, target: Target, options: DrawingOptions, parent: Connection) -> None:
    """Draw ticks until the parent process closes its end of the pipe or exits."""
    import signal

    os.environ.setdefault("RUST_LOG", "off")  # the command itself reports that the viewer has closed
    from skinnode.view.drawing import HandDrawing
    from skinnode.view.stream import open_stream

    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the parent also receives SIGTERM and closes the pipe
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
