"""Analogue port of a patch, implemented by a converter or by the simulator."""

from __future__ import annotations

import operator
from enum import IntEnum
from typing import Protocol

from skinnode.model.layout import Float, require_array


class ResistanceSource(Protocol):
    """Source of the resistances between upper and lower wires.

    A source may also have an attribute ``conversions``: the number of conversions of the whole matrix that
    the converter has completed, an integer of any size. The node reads it after :meth:`read`, and tells the
    host in each summary whether the number has changed, so that the host detects a stopped converter at once.
    Without this attribute, or while it is None, the host must infer that from the codes. A source must count
    in the converter itself, not in :meth:`read`, and only if the converter completes at least one conversion
    per scan.
    """

    def read(self, t_ns: int) -> Float:
        """Return (U, K) wire-to-wire resistances, ohm: infinite if a wire is open, 0 if it is shorted.

        The node copies the array. An exception counts as a failure of the source; the node reports the
        failure and reads again at the next scan.

        Args:
            t_ns: current time on the monotonic clock, ns.
        """
        ...


def conversions_of(source: ResistanceSource) -> int | None:
    """Return the number of conversions that a source has completed; None if the source does not count.

    Raises:
        SourceFailed: if the attribute raises an exception or is not an integer.
    """
    try:
        count = getattr(source, "conversions", None)
        return None if count is None else operator.index(count)
    except (Exception, SystemExit) as error:  # a source must not end the thread that reads it
        what = " ".join(str(error).split())
        text = f"source.conversions: {type(error).__name__}: {what}".rstrip(": ")
        raise SourceFailed(SourceFault.RAISED, text) from error


class SourceFault(IntEnum):
    """Type of reading failure, sent as the first detail byte of the emergency message."""

    RAISED = 1
    """The source raised an exception."""
    WRONG_ARRAY = 2
    """The source returned something other than an array of numbers, or an array of the wrong shape."""


class SourceFailed(Exception):
    """Error raised if a reading fails. This error never leaves the node."""

    def __init__(self, fault: SourceFault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


def read_source(source: ResistanceSource, shape: tuple[int, int], t_ns: int) -> Float:
    """Read a source.

    Args:
        source: the source.
        shape: (U, K).
        t_ns: current time, ns.

    Returns:
        (U, K) float64, ohm; a copy.

    Raises:
        SourceFailed: if the source raises an exception or returns anything but an array of that shape; the
            message is one line.
    """
    try:
        reading = source.read(t_ns)
    except (Exception, SystemExit) as error:  # a source must not end the thread that reads it
        what = " ".join(str(error).split())
        raise SourceFailed(
            SourceFault.RAISED, f"source.read(): {type(error).__name__}: {what}".rstrip(": ")
        ) from error
    try:
        return require_array("source.read()", reading, shape, finite=False).copy()  # may be reused
    except ValueError as error:
        raise SourceFailed(SourceFault.WRONG_ARRAY, str(error)) from None
