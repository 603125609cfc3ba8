"""Groups findings by root cause.

For example, an overloaded bus causes torn scans, missing scans and emergency messages at every patch on it.
All these findings are correct, but only the overload needs to be fixed. A rule therefore names a cause and
the findings that it can explain, either at the same patch or, for a cause that affects the whole bus, at all
of its patches. Where the text of a finding is not specific enough, the rule also tests the evidence: an
overload explains emergency messages only if all of them report an overrun.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from skinnode.diagnose.checks.run import run_checks
from skinnode.diagnose.facts import BusFacts, Finding, Sure

_RANK: Final = {sure: rank for rank, sure in enumerate(Sure)}


@dataclass(frozen=True, slots=True)
class Group:
    """A root cause and its consequences."""

    cause: Finding
    consequences: tuple[Finding, ...] = ()

    @property
    def rank(self) -> int:
        """Rank of the most certain finding in the group; 0 means certain."""
        return min(_RANK[finding.sure] for finding in (self.cause, *self.consequences))


@dataclass(frozen=True, slots=True)
class Rule:
    """A cause and its possible consequences, as regular expressions for the start of a finding's text."""

    cause: str
    follow: tuple[str, ...]
    evidence: Mapping[str, str]
    """Regular expressions for the evidence, by pattern in ``follow``. A finding is a consequence only if
    every part of its evidence matches; parts are separated by semicolons."""


_HOLES: Final = ("incomplete scans", "whole scans are missing")
_LATE: Final = (*_HOLES, "scans end after the next scan has begun")
_OF_SYNC: Final = ("SYNCs are missing", "SYNC is irregular")
_ERRORS: Final = ("emergency messages received during the check", "the node reports an error")
_CONFIGURED_BY_OTHERS: Final = (
    "the (chunk|summary) PDO .* is not at its COB-ID",
    "chunks are not event-driven",
    "the inhibit time differs from the host's setting",
    "the heartbeat period differs from the hand file",
    "no heartbeat: a failure of the node would go unnoticed",
    "the patch scans on its own timer",
)
_UNEXPLAINED: Final = "^error register 0x|^last: none reported$"
"""Pattern for evidence that reports an error without giving its cause."""
_OVERRUN: Final = dict.fromkeys(_ERRORS, f"overrun|{_UNEXPLAINED}")
_WIRE: Final = dict.fromkeys(_ERRORS, f"wire open or shorted|overrun|{_UNEXPLAINED}")
_RESTARTED: Final = dict.fromkeys(_ERRORS, f"SYNC of unexpected length|heartbeat|overrun|{_UNEXPLAINED}")
_COLLISION: Final = dict.fromkeys(_ERRORS, f"collision|{_UNEXPLAINED}")
_CONTROLLER: Final = dict.fromkeys(_ERRORS, f"passive|bus-off|{_UNEXPLAINED}")
_ANYTHING: Final[Mapping[str, str]] = {}

# The first matching rule applies. Rules about a patch come before rules about a bus. A rule whose cause can
# explain the cause of another rule comes before that rule.
RULES: Final = (
    Rule(
        "two nodes have the patch's node-ID",
        (
            "two different chunks with the same number",
            "frames that are not chunks of this patch",
            "the serial number differs from the hand file",
            *_LATE,
            *_ERRORS,
        ),
        _COLLISION,
    ),
    Rule(
        "the node restarts by itself",
        (
            *_LATE,
            *_CONFIGURED_BY_OTHERS,
            "the node is .* while other nodes are operational",
            "the node is .* and does not answer",
            "some objects of the node could not be read",
            *_ERRORS,
        ),
        _RESTARTED,
    ),
    Rule("(upper|lower) wires (open|shorted|out of range)", (*_ERRORS, "noise on .* wire"), _WIRE),
    Rule(
        "the controller is",
        ("error frames on the bus", "none of the hand's nodes answers", *_LATE),
        _ANYTHING,
    ),
    Rule(
        "the bit rate of the interface differs",
        ("error frames on the bus", "none of the hand's nodes answers", "the controller is", *_LATE),
        _ANYTHING,
    ),
    Rule(
        "the interface failed during the check",
        (
            *_LATE,
            *_OF_SYNC,
            "the node is .* and does not answer",
            "some objects of the node could not be read",
        ),
        _ANYTHING,
    ),
    Rule(
        "two SYNC producers",
        (
            "two masters send the same heartbeat",
            "another device sends NMT commands",
            "the SYNC period differs",
            "the heartbeat period differs from the hand file",
            *_LATE,
            *_OF_SYNC,
            *_ERRORS,
        ),
        _OVERRUN,
    ),
    Rule("two masters send the same heartbeat", ("another device sends NMT commands", *_OF_SYNC), _ANYTHING),
    Rule(
        "the bus load exceeds the planning limit",
        (
            *_LATE,
            *_OF_SYNC,
            "this machine dropped frames",
            "some objects of the node could not be read",
            *_ERRORS,
        ),
        _OVERRUN,
    ),
    Rule("this machine dropped frames", (*_HOLES, *_OF_SYNC), _ANYTHING),
    Rule("error frames on the bus", (*_HOLES, *_OF_SYNC, *_ERRORS), _CONTROLLER),
    Rule(
        "a scan takes longer than a SYNC period",
        (*_LATE, *_ERRORS),
        _OVERRUN,
    ),
    Rule("the SYNC period differs", (*_LATE, *_ERRORS), _OVERRUN),
    Rule(
        ".*crossings? have no baseline|.*crossing has no baseline", (".*crossings? out of range",), _ANYTHING
    ),
    Rule(
        "the layout differs",
        ("the code width differs from the hand file", "the EDS in the hand file"),
        _ANYTHING,
    ),
    Rule("SYNCs are missing", ("whole scans are missing", "SYNC is irregular"), _ANYTHING),
    Rule(
        "the node reports an error",
        ("emergency messages received during the check", "the node is .* while other nodes are operational"),
        _ANYTHING,
    ),
)


def grouped(buses: Sequence[BusFacts]) -> list[Group]:
    """Run all checks on the facts and group the findings by root cause.

    Groups are sorted by the certainty of their most certain finding, then by the number of consequences.
    """
    groups = [group for facts in buses for group in _of_bus(facts.name, run_checks(facts))]
    return sorted(groups, key=lambda group: (group.rank, -len(group.consequences)))


def merged(findings: Sequence[Finding]) -> list[tuple[Finding, tuple[str, ...]]]:
    """Merge findings with the same text, and list the places where each occurred."""
    places: dict[str, list[Finding]] = {}
    for finding in findings:
        places.setdefault(finding.what, []).append(finding)
    return [(same[0], tuple(each.where for each in same)) for same in places.values()]


def _of_bus(bus: str, findings: list[Finding]) -> list[Group]:
    """Group the findings about one bus by root cause."""
    cause_of: dict[int, int] = {}
    for rule in RULES:
        for at, cause in enumerate(findings):
            if at in cause_of or re.match(rule.cause, cause.what) is None:
                continue
            for number, finding in enumerate(findings):
                near = cause.where in (bus, finding.where)
                if number != at and number not in cause_of and near and _follows(finding, rule):
                    cause_of[number] = at
    groups = []
    for at, finding in enumerate(findings):
        if at not in cause_of:
            below = [item for number, item in enumerate(findings) if _root(number, cause_of) == at != number]
            groups.append(Group(finding, tuple(sorted(below, key=lambda item: _RANK[item.sure]))))
    return groups


def _root(number: int, cause_of: Mapping[int, int]) -> int:
    for _ in range(len(cause_of)):
        number = cause_of.get(number, number)
    return number


def _follows(finding: Finding, rule: Rule) -> bool:
    for pattern in rule.follow:
        if re.match(pattern, finding.what):
            needed = rule.evidence.get(pattern)
            return needed is None or all(re.search(needed, part) for part in finding.evidence.split("; "))
    return False
