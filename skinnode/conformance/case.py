"""A conformance case, its verdict and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from skinnode.conformance.tester import TraceLine

if TYPE_CHECKING:
    from skinnode.conformance.dut import Dut


class Verdict(StrEnum):
    """Verdict on a conformance case."""

    PASSED = "passed"
    WARNING = "warning"
    """The device passes, but its behaviour is discouraged by CiA or unsupported by some tools."""
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"


class NotApplicable(Exception):
    """Raised if the device does not have the feature that the case checks.

    The message states the evidence, such as a missing EDS entry or the device's response.
    """


class Warned(Exception):
    """Raised if the device passes with a warning; the message explains the warning."""


@dataclass(frozen=True, slots=True)
class Case:
    """One conformance case.

    ``run`` returns normally if the verdict is "passed". For the other verdicts, it raises Failed,
    NotApplicable or Warned.
    """

    id: str
    """Area and number of the case, such as ``SDO-07``."""
    title: str
    clause: str
    """Clause that the case checks; from CiA 301 v4.2.0 unless another document is named."""
    run: Callable[[Dut], None]

    @property
    def area(self) -> str:
        """Area of the case: the part of ``id`` before the number."""
        return self.id.rpartition("-")[0]


@dataclass(frozen=True, slots=True)
class Result:
    """Result of one conformance case."""

    case: Case
    verdict: Verdict
    why: str = ""
    """Reason for the verdict; empty if the device passed.

    For a failure, the text says what was expected and what was received.
    """
    seconds: float = 0.0
    trace: tuple[TraceLine, ...] = field(default=(), repr=False)
    """Most recent frames sent and received during the case."""


def case(id: str, title: str, clause: str) -> Callable[[Callable[[Dut], None]], Case]:
    """Return a decorator that turns a function into a conformance case."""
    return lambda run: Case(id, title, clause, run)
