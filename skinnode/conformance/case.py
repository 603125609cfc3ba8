"""What a conformance case is, and what comes out of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from skinnode.conformance.tester import TraceLine

if TYPE_CHECKING:
    from skinnode.conformance.dut import Dut


class Verdict(StrEnum):
    """What a case found."""

    PASSED = "passed"
    WARNING = "warning"
    """The device passes, but does something that CiA advises against or that some tools cannot handle."""
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"


class NotApplicable(Exception):
    """The device does not offer what the case is about. The text names the object, the entry of the EDS or
    the answer on the bus that says so.
    """


class Warned(Exception):
    """The device passes, but something is doubtful; the text says what."""


@dataclass(frozen=True, slots=True)
class Case:
    """One case. ``run`` returns if the device passes; otherwise it raises Failed, NotApplicable or Warned."""

    id: str
    """Area and number: "SDO-07"."""
    title: str
    clause: str
    """Where CiA 301 v4.2.0 (or the document named) asks for it."""
    run: Callable[[Dut], None]

    @property
    def area(self) -> str:
        """What comes before the number."""
        return self.id.rpartition("-")[0]


@dataclass(frozen=True, slots=True)
class Result:
    """A case and what it found."""

    case: Case
    verdict: Verdict
    why: str = ""
    """What was expected and what was received, what is doubtful, or why the case does not apply; empty if
    the device passed."""
    seconds: float = 0.0
    trace: tuple[TraceLine, ...] = field(default=(), repr=False)
    """The frames of the case."""


def case(id: str, title: str, clause: str) -> Callable[[Callable[[Dut], None]], Case]:
    """Make a case of the function below."""
    return lambda run: Case(id, title, clause, run)
