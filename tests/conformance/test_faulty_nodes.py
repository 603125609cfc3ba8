"""The suite can fail: nodes with one fault each. The case for it fails, the others run."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from skinnode.conformance import Dut, Report, Verdict, run_cases, select
from skinnode.transport import CanPort, Frame

from .conftest import NODE_ID, bench_on, patch_on

ANSWER, REQUEST, BOOT = 0x580 + NODE_ID, 0x600 + NODE_ID, 0x700 + NODE_ID
Alter = Callable[[int, bytes], bytes | None]


class FaultyPort:
    """Stands between a node and its port: ``alter`` gives the payload to send instead, None for no frame."""

    def __init__(self, port: CanPort, alter: Alter) -> None:
        self._port, self._alter = port, alter
        self.config = port.config

    def send(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        altered = self._alter(can_id, data)
        if altered is not None:
            self._port.send(can_id, altered, remote=remote)

    def recv(self, timeout_s: float) -> Frame | None:
        return self._port.recv(timeout_s)


@contextmanager
def faulty(alter: Alter) -> Iterator[Dut]:
    channel = f"faulty-{uuid.uuid4().hex[:8]}"
    with patch_on(channel, lambda port: FaultyPort(port, alter)), bench_on(channel) as dut:  # type: ignore[arg-type,return-value]
        yield dut


def verdicts(report: Report) -> dict[str, Verdict]:
    return {result.case.id: result.verdict for result in report.results}


def run(alter: Alter, *names: str) -> dict[str, Verdict]:
    with faulty(alter) as dut:
        return verdicts(run_cases(dut, select(names)))


def flip_toggle(can_id: int, data: bytes) -> bytes:
    """Upload segments with the toggle bit the wrong way round."""
    segment = can_id == ANSWER and data[0] & 0xE0 == 0
    return bytes((data[0] ^ 0x10,)) + data[1:] if segment else data


def general_abort(code: int) -> Alter:
    """Every abort carries ``code``."""

    def alter(can_id: int, data: bytes) -> bytes:
        return data[:4] + code.to_bytes(4, "little") if can_id == ANSWER and data[0] == 0x80 else data

    return alter


def wrong_object(can_id: int, data: bytes) -> bytes:
    """Aborts that name another object."""
    return data[:1] + b"\xff\xff" + data[3:] if can_id == ANSWER and data[0] == 0x80 else data


def short_answer(can_id: int, data: bytes) -> bytes:
    """SDO answers of seven bytes."""
    return data[:7] if can_id == ANSWER else data


def other_device_type(can_id: int, data: bytes) -> bytes:
    """0x1000 reads 0x191, the EDS says 0."""
    wanted = can_id == ANSWER and data[:4] == b"\x43\x00\x10\x00"
    return data[:4] + b"\x91\x01\0\0" if wanted else data


def confirms_all(can_id: int, data: bytes) -> bytes:
    """Aborted writes are confirmed instead; reads are aborted as they are."""
    read_only = can_id == ANSWER and data[0] == 0x80 and data[4:] == b"\x02\0\x01\x06"
    return b"\x60" + data[1:4] + bytes(4) if read_only else data


@pytest.mark.parametrize(
    ("alter", "fail", "pass_"),
    [
        (flip_toggle, {"SDO-18", "OD-01"}, {"SDO-01", "SDO-15", "SDO-05"}),
        (general_abort(0x0504_0005), {"SDO-03", "SDO-05", "SDO-06", "SDO-07", "SDO-17", "OD-03"}, {"SDO-18"}),
        (general_abort(0x0800_0000), set(), {"SDO-03", "SDO-05", "SDO-06", "SDO-07", "OD-03"}),
        (wrong_object, {"SDO-03", "SDO-05", "SDO-06"}, {"SDO-01", "SDO-02"}),
        (other_device_type, {"SDO-01"}, {"SDO-02", "OD-01"}),
        (confirms_all, {"SDO-03", "OD-03"}, {"SDO-05", "OD-06"}),
    ],
)
def test_the_case_for_a_fault_fails_and_the_others_go_on(
    alter: Alter, fail: set[str], pass_: set[str]
) -> None:
    found = run(alter, *fail, *pass_)
    assert {name for name, verdict in found.items() if verdict is Verdict.FAILED} == fail
    assert {name for name, verdict in found.items() if verdict is Verdict.PASSED} == pass_


def test_answers_of_a_wrong_length_fail_every_transfer() -> None:
    broken = False

    def alter(can_id: int, data: bytes) -> bytes:
        return short_answer(can_id, data) if broken else data

    with faulty(alter) as dut:
        broken = True
        found = verdicts(run_cases(dut, select(("SDO-01", "SDO-05"))))
    assert set(found.values()) == {Verdict.FAILED}


def test_a_lost_boot_up_message_does_not_stop_the_run() -> None:
    found = run(lambda can_id, data: None if can_id == BOOT else data, "SDO-01", "SDO-02")
    assert set(found.values()) == {Verdict.PASSED}


def test_a_node_that_falls_silent_fails_cases_and_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinnode.conformance.dut.BOOT_S", 0.6)
    heard = 0

    def alter(can_id: int, data: bytes) -> bytes | None:
        nonlocal heard
        heard += can_id == BOOT
        return data if heard <= 3 else None  # power-on, connecting, the first case

    with faulty(alter) as dut:
        report = run_cases(dut, select(("SDO",)))
    first, *others = report.results
    assert first.verdict is Verdict.PASSED
    assert all(result.verdict is Verdict.FAILED for result in others)
    assert [("not run" in result.why) for result in others] == [False] * 3 + [True] * (len(others) - 3)
