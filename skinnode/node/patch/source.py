"""The analogue port of a patch: the interface of a converter, or of the simulator."""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

from skinnode.model.layout import Float, require_array


class ResistanceSource(Protocol):
    """Measures the resistances between upper and lower wires."""

    def read(self, t_ns: int) -> Float:
        """Return (U, K) wire-to-wire resistances, ohm: infinite if a wire is open, 0 if it is shorted.

        The node copies the array. An exception is a failure of the source: the node reports it and reads
        again at the next scan.

        Args:
            t_ns: present time, ns of the monotonic clock.
        """
        ...


class SourceFault(IntEnum):
    """Kind of a failed reading: the first byte of the emergency message."""

    RAISED = 1
    """The source raised an exception."""
    WRONG_ARRAY = 2
    """The source returned no array of numbers, or one of another shape."""


class SourceFailed(Exception):
    """A failed reading. Never leaves the node."""

    def __init__(self, fault: SourceFault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


def read_source(source: ResistanceSource, shape: tuple[int, int], t_ns: int) -> Float:
    """Read a source.

    Args:
        source: the source.
        shape: (U, K).
        t_ns: present time, ns.

    Returns:
        (U, K) float64, ohm; a copy.

    Raises:
        SourceFailed: if the source raises anything or returns no array of that shape; the message is one
            line.
    """
    try:
        reading = source.read(t_ns)
    except (Exception, SystemExit) as error:  # a source does not end the thread that reads it
        what = " ".join(str(error).split())
        raise SourceFailed(
            SourceFault.RAISED, f"source.read(): {type(error).__name__}: {what}".rstrip(": ")
        ) from error
    try:
        return require_array("source.read()", reading, shape, finite=False).copy()  # it may be overwritten
    except ValueError as error:
        raise SourceFailed(SourceFault.WRONG_ARRAY, str(error)) from None
