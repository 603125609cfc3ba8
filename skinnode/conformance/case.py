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
    """The device passes, but its behaviour is discouraged by CiA or cannot be handled by some tools."""
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"


class NotApplicable(Exception):
    """Raised if the device does not offer the feature that the case checks.

    The exception text names the object, EDS entry or response that shows that the feature is absent.
    """


class Warned(Exception):
    """Raised if the device passes but its behaviour is doubtful. The exception text explains why."""


@dataclass(frozen=True, slots=True)
class Case:
    """One conformance case.

    ``run`` returns if the device passes; otherwise it raises Failed, NotApplicable or Warned.
    """

    id: str
    """Area and number, such as "SDO-07"."""
    title: str
    clause: str
    """Clause that the case checks, in CiA 301 v4.2.0 unless another document is named."""
    run: Callable[[Dut], None]

    @property
    def area(self) -> str:
        """Area of the case: the part of ``id`` before the number."""
        return self.id.rpartition("-")[0]


@dataclass(frozen=True, slots=True)
class Result:
    """A case and its result."""

    case: Case
    verdict: Verdict
    why: str = ""
    """Reason for the verdict: expected and received data, the doubt, or why the case does not apply; empty
    if the device passed without a doubt."""
    seconds: float = 0.0
    trace: tuple[TraceLine, ...] = field(default=(), repr=False)
    """Frames sent and received during the case."""


def case(id: str, title: str, clause: str) -> Callable[[Callable[[Dut], None]], Case]:
    """Return a decorator that turns a function into a case."""
    return lambda run: Case(id, title, clause, run)
