"""Analogue front end of a patch: interface to a resistance source, such as a converter or the simulator."""

from __future__ import annotations

import operator
from enum import IntEnum
from typing import Protocol

from skinnode.model.layout import Float, require_array


class ResistanceSource(Protocol):
    """Source of the resistances between the upper and the lower wires of a patch.

    A source can also have an integer attribute ``conversions``: the number of times that the converter has
    measured all crossings. The node reads this attribute after calling :meth:`read` and indicates in the
    summary whether its value has changed. The host can then detect a stopped converter immediately. If the
    attribute is missing or None, the host must rely on the codes to detect a stopped converter.

    The conversions must be counted by the converter itself, not by :meth:`read`, and the converter must
    measure all crossings at least once per scan. Otherwise, the source must not have this attribute.
    """

    def read(self, t_ns: int) -> Float:
        """Return (U, K) resistances in ohms; infinite for an open crossing, 0 for a shorted crossing.

        The node copies the array. If this method raises an exception, the node reports a source failure and
        tries again at the next scan.

        Args:
            t_ns: Current time on the monotonic clock, in ns.
        """
        ...


def conversions_of(source: ResistanceSource) -> int | None:
    """Return a source's conversion count, or None if the source does not count conversions.

    Raises:
        SourceFailed: If the attribute raises an exception or is not an integer.
    """
    try:
        count = getattr(source, "conversions", None)
        return None if count is None else operator.index(count)
    except (Exception, SystemExit) as error:  # an error in a source must not end the thread that reads it
        what = " ".join(str(error).split())
        text = f"source.conversions: {type(error).__name__}: {what}".rstrip(": ")
        raise SourceFailed(SourceFault.RAISED, text) from error


class SourceFault(IntEnum):
    """Type of source failure; sent as the first manufacturer-specific byte of the emergency message."""

    RAISED = 1
    """The source raised an exception."""
    WRONG_ARRAY = 2
    """The source did not return a (U, K) array of numbers."""


class SourceFailed(Exception):
    """A source returned no valid reading."""

    def __init__(self, fault: SourceFault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


def read_source(source: ResistanceSource, shape: tuple[int, int], t_ns: int) -> Float:
    """Read a source and check the reading.

    Args:
        source: Source to read.
        shape: Shape of the reading, (U, K).
        t_ns: Current time, in ns.

    Returns:
        Copy of the resistances in ohms, (U, K) float64.

    Raises:
        SourceFailed: If the source raises an exception or does not return an array of numbers with the
            required shape. The message is a single line.
    """
    try:
        reading = source.read(t_ns)
    except (Exception, SystemExit) as error:  # an error in a source must not end the thread that reads it
        what = " ".join(str(error).split())
        raise SourceFailed(
            SourceFault.RAISED, f"source.read(): {type(error).__name__}: {what}".rstrip(": ")
        ) from error
    try:
        return require_array(
            "source.read()", reading, shape, finite=False
        ).copy()  # the source may reuse its array
    except ValueError as error:
        raise SourceFailed(SourceFault.WRONG_ARRAY, str(error)) from None
