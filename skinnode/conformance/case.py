"""Conformance case and its result."""

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
    """The device passes, but CiA discourages its behaviour or some tools cannot handle it."""
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"


class NotApplicable(Exception):
    """Raised if the device does not offer the feature that the case checks.

    The exception text gives the evidence: a missing object, a missing EDS entry or the device's response.
    """


class Warned(Exception):
    """Raised if the device passes but its behaviour is doubtful. The exception text explains why."""


@dataclass(frozen=True, slots=True)
class Case:
    """One conformance case.

    ``run`` returns if the device passes without a warning. Otherwise, it raises Failed, NotApplicable or
    Warned.
    """

    id: str
    """Identifier of the case: its area and number, such as "SDO-07"."""
    title: str
    clause: str
    """Clause that the case checks: a clause of CiA 301 v4.2.0 unless another document is named."""
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
    """Reason for the verdict; empty if the device passed without a warning.

    The reason gives the expected and received data, the cause of a warning, or why the case does not apply.
    """
    seconds: float = 0.0
    trace: tuple[TraceLine, ...] = field(default=(), repr=False)
    """Frames sent and received during the case."""


def case(id: str, title: str, clause: str) -> Callable[[Callable[[Dut], None]], Case]:
    """Return a decorator that turns a function into a case."""
    return lambda run: Case(id, title, clause, run)
