"""Analogue port of a patch: the interface of a resistance source, such as a converter or the simulator."""

from __future__ import annotations

import operator
from enum import IntEnum
from typing import Protocol

from skinnode.model.layout import Float, require_array


class ResistanceSource(Protocol):
    """Source of the resistances between a patch's upper and lower wires.

    A source may also have an integer attribute ``conversions``, which counts how often the converter has
    measured all crossings. The node reads ``conversions`` after :meth:`read`. Each summary indicates whether
    the number has changed, so the host detects a stopped converter immediately. If the attribute
    ``conversions`` is missing or None, the host must detect a stopped converter from the codes.

    The conversions must be counted in the converter itself, not in :meth:`read`. A source may have the
    attribute ``conversions`` only if its converter measures all crossings at least once per scan.
    """

    def read(self, t_ns: int) -> Float:
        """Return (U, K) resistances in ohms: infinite for an open crossing, 0 for a shorted crossing.

        The node copies the returned array. If this method raises an exception, the node reports a failure of
        the source, and reads the source again at the next scan.

        Args:
            t_ns: current time on the monotonic clock, ns.
        """
        ...


def conversions_of(source: ResistanceSource) -> int | None:
    """Return a source's number of completed conversions; None if the source does not count conversions.

    Raises:
        SourceFailed: if the attribute raises an exception or is not an integer.
    """
    try:
        count = getattr(source, "conversions", None)
        return None if count is None else operator.index(count)
    except (Exception, SystemExit) as error:  # an error in a source must not end the thread that reads it
        what = " ".join(str(error).split())
        text = f"source.conversions: {type(error).__name__}: {what}".rstrip(": ")
        raise SourceFailed(SourceFault.RAISED, text) from error


class SourceFault(IntEnum):
    """Type of source failure, which is the first detail byte of the emergency message."""

    RAISED = 1
    """The source raised an exception."""
    WRONG_ARRAY = 2
    """The source returned something other than an array of numbers with shape (U, K)."""


class SourceFailed(Exception):
    """Error raised if a source cannot be read."""

    def __init__(self, fault: SourceFault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


def read_source(source: ResistanceSource, shape: tuple[int, int], t_ns: int) -> Float:
    """Read a source and check the shape of the reading.

    Args:
        source: the source.
        shape: (U, K).
        t_ns: current time, ns.

    Returns:
        (U, K) float64, ohm; a copy.

    Raises:
        SourceFailed: if the source raises an exception, or returns something other than an array of numbers
            with the required shape. The error message is a single line.
    """
    try:
        reading = source.read(t_ns)
    except (Exception, SystemExit) as error:  # an error in a source must not end the thread that reads it
        what = " ".join(str(error).split())
        raise SourceFailed(
            SourceFault.RAISED, f"source.read(): {type(error).__name__}: {what}".rstrip(": ")
        ) from error
    try:
        return require_array("source.read()", reading, shape, finite=False).copy()  # may be reused
    except ValueError as error:
        raise SourceFailed(SourceFault.WRONG_ARRAY, str(error)) from None
