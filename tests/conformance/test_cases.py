"""Our patch against every case of the conformance suite: one test a case, `pytest -k SDO-07` runs one."""

from __future__ import annotations

import uuid
from collections import Counter

import pytest

from skinnode.conformance import CASES, Case, Dut, Verdict, run_cases
from tests.lanes import some_long

from .conftest import bench_on, patch_on

NOT_APPLICABLE = {
    "SDO-04": "no object with access wo",
    "SDO-29": "no additional SDO server",
    "SDO-30": "no SDO client",
    "OD-04": "no object with access wo",
    "OD-05": "no object has the optional sub-index 0xFF",
}
"""What a patch does not have, and the words it is said with. Everything else has to pass."""

PLAN = {
    "EDS": 1,
    "SDO": 30,
    "PDO": 33,
    "OD": 9,
    "EMCY": 6,
    "SYNC": 10,
    "GUARD": 6,
    "HB": 7,
    "HBVG": 7,
    "OTHER": 10,
    "STATE": 4,
    "TRANS": 4,
}
"""Number of cases in each area of a CiA conformance plan. No other file contains these numbers."""


FIRST = {case.id.partition("-")[0]: case for case in reversed(CASES)}
"""The first case of each area, which a plain run has, beside one that does not apply."""


@pytest.mark.parametrize(
    "case",
    some_long(CASES, *FIRST.values(), *(case for case in CASES if case.id == "SDO-04")),
    ids=lambda case: case.id,
)
def test_patch(case: Case, dut: Dut) -> None:
    report = run_cases(dut, [case])
    (result,) = report.results
    assert report.problems == ()
    if case.id in NOT_APPLICABLE:
        assert result.verdict is Verdict.NOT_APPLICABLE, result.why
        assert NOT_APPLICABLE[case.id] in result.why
    else:
        frames = "\n".join(map(str, result.trace))
        assert result.verdict is Verdict.PASSED, f"{case.title}: {result.why}\n{frames}"


def test_the_cases_are_those_of_the_plan() -> None:
    ids = [f"{area}-{number:02}" for area, count in PLAN.items() for number in range(1, count + 1)]
    assert [case.id for case in CASES] == ids
    assert Counter(case.area for case in CASES) == PLAN


def test_at_least_105_apply_to_a_patch() -> None:
    assert len(CASES) - len(NOT_APPLICABLE) >= 105


@pytest.mark.long
def test_a_patch_without_memory_fails_nothing() -> None:
    """What asks it to store does not apply; that its sheet says that it stores is a warning."""
    channel = f"no-memory-{uuid.uuid4().hex[:8]}"
    with patch_on(channel, stores=False), bench_on(channel) as dut:
        report = run_cases(dut, [case for case in CASES if case.area in ("OD", "SYNC", "SDO", "OTHER")])
    verdicts = {result.case.id: result for result in report.results}
    failed = [name for name, result in verdicts.items() if result.verdict is Verdict.FAILED]
    assert failed == []
    assert [name for name, result in verdicts.items() if result.verdict is Verdict.WARNING] == ["OD-02"]
    assert "0x1010:01" in verdicts["OD-02"].why
    for name in ("SYNC-08", "SYNC-10", *(f"OTHER-{number:02}" for number in range(1, 10))):
        assert verdicts[name].verdict is Verdict.NOT_APPLICABLE
        assert "bit 0" in verdicts[name].why
