"""A patch with PDOs over CAN FD is held against what a classic one is."""

from __future__ import annotations

import uuid

import pytest

from skinnode.conformance import Verdict, run_cases, select

from .conftest import bench_on, patch_on


@pytest.mark.long
def test_its_pdos_states_and_dictionary_pass() -> None:
    channel = f"conformance-{uuid.uuid4().hex[:8]}"
    with patch_on(channel, fd=True), bench_on(channel, fd=True) as dut:
        report = run_cases(dut, select(["PDO", "STATE", "OD", "EDS"]))
    failed = [f"{r.case.id}: {r.why}" for r in report.results if r.verdict is Verdict.FAILED]
    assert failed == []
    passed = sum(r.verdict is Verdict.PASSED for r in report.results)
    assert passed == len(report.results) - 2  # OD-04 and OD-05 apply to no patch


@pytest.mark.system_time  # two kinds of controllers cannot meet on the timed bus
def test_a_tester_of_classic_frames_misses_its_chunks() -> None:
    channel = f"conformance-{uuid.uuid4().hex[:8]}"
    with patch_on(channel, fd=True), bench_on(channel) as dut:
        report = run_cases(dut, select(["PDO-21"]))
    assert [r.verdict for r in report.results] == [Verdict.FAILED]
