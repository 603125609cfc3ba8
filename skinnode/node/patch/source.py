"""The analogue port of a patch: where a converter, or the simulator, is plugged in."""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

from skinnode.model.layout import Float, require_array


class ResistanceSource(Protocol):
    """Whatever measures the resistances between upper and lower wires."""

    def read(self, t_ns: int) -> Float:
        """(U, K) wire-to-wire resistances at ``t_ns`` (monotonic), ohm: infinite where a wire is open, 0
        where it is shorted. The array is only read, and not kept beyond the call. An exception is a failure
        of the source: the node says so and asks again at the next scan."""
        ...


class SourceFault(IntEnum):
    """What was wrong with a reading: the first byte of the emergency message."""

    RAISED = 1
    WRONG_ARRAY = 2
    """Not an array of numbers, or not one of the patch's shape."""


class SourceFailed(Exception):
    """A reading that could not be had. Never leaves the node."""

    def __init__(self, fault: SourceFault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


def read_source(source: ResistanceSource, shape: tuple[int, int], t_ns: int) -> Float:
    """A reading of ``source``, as (U, K) float64, copied. Raises SourceFailed, with one line, whatever it
    did."""
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
