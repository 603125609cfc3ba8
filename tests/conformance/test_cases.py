"""Our patch against every case of the conformance suite: one test a case, `pytest -k SDO-07` runs one."""

from __future__ import annotations

import pytest

from skinnode.conformance import CASES, Case, Dut, Verdict, run_case

NOT_APPLICABLE = {
    "SDO-04": "no object with access wo",
    "SDO-29": "no SDO server beyond the default one",
    "SDO-30": "no SDO client",
    "OD-04": "no object with access wo",
    "OD-05": "no object answers at sub-index 0xFF",
}
"""What a patch does not have, and the words it is said with. Everything else has to pass."""

PENDING = {"OD-02", "OD-08"}
"""Cases of services that the node is still to get: restoring defaults."""


@pytest.mark.parametrize("case", [c for c in CASES if c.id not in PENDING], ids=lambda case: case.id)
def test_patch(case: Case, dut: Dut) -> None:
    result = run_case(dut, case)
    if case.id in NOT_APPLICABLE:
        assert result.verdict is Verdict.NOT_APPLICABLE, result.why
        assert NOT_APPLICABLE[case.id] in result.why
    else:
        frames = "\n".join(map(str, result.trace))
        assert result.verdict is Verdict.PASSED, f"{case.title}: {result.why}\n{frames}"
