"""A conformance case and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from skinnode.conformance.tester import TraceLine

if TYPE_CHECKING:
    from skinnode.conformance.dut import Dut


class Verdict(StrEnum):
    """Result of a case in one word."""

    PASSED = "passed"
    WARNING = "warning"
    """The device passes, but does something that CiA advises against or that some tools cannot handle."""
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"


class NotApplicable(Exception):
    """The device does not offer what the case checks.

    The text names the object, the EDS entry or the answer on the bus that shows it.
    """


class Warned(Exception):
    """The device passes, but something is doubtful; the text says what."""


@dataclass(frozen=True, slots=True)
class Case:
    """One case.

    ``run`` returns if the device passes; otherwise it raises Failed, NotApplicable or Warned.
    """

    id: str
    """Area and number: "SDO-07"."""
    title: str
    clause: str
    """Clause of CiA 301 v4.2.0, or of the document named, that the case checks."""
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
    """What was expected and received, what is doubtful, or why the case does not apply; empty if the
    device passed."""
    seconds: float = 0.0
    trace: tuple[TraceLine, ...] = field(default=(), repr=False)
    """The frames of the case."""


def case(id: str, title: str, clause: str) -> Callable[[Callable[[Dut], None]], Case]:
    """Return a decorator that makes a case of a function."""
    return lambda run: Case(id, title, clause, run)
