"""The suite can fail: nodes that mishear, and nodes that hardly answer at all."""

from __future__ import annotations

import pytest

from skinnode.conformance import Verdict, run_cases, select
from skinnode.transport import Frame

from .faulty import ANSWER, BAD, CHUNK, ERROR_CONTROL, OK, SYNC, Hear, expected, faulty, found

pytestmark = pytest.mark.usefixtures("impatient")


def deaf_to(*commands: int) -> Hear:
    """NMT commands that change nothing."""

    def hear(frame: Frame) -> list[tuple[int, bytes]] | None:
        return None if frame.can_id == 0 and frame.data[:1] in [bytes((c,)) for c in commands] else []

    return hear


def pdo_at_every_sync(frame: Frame) -> list[tuple[int, bytes]]:
    """Whatever the state, and whatever the type."""
    return [(CHUNK, bytes(8))] if frame.can_id == SYNC else []


def answers_every_guard(frame: Frame) -> list[tuple[int, bytes]]:
    """Remote frames for other nodes, too, and though the heartbeat runs."""
    return [(ERROR_CONTROL, b"\x7f")] if frame.remote and frame.can_id > 0x700 else []


def starts_by_itself(frame: Frame) -> list[tuple[int, bytes]]:
    """A second boot-up message after each reset."""
    return [(ERROR_CONTROL, b"\0")] if frame.can_id == 0 and frame.data[0] in (129, 130) else []


@pytest.mark.parametrize(
    ("hear", "fail", "pass_"),
    [
        (deaf_to(2), "TRANS-04 STATE-04", "SDO-01 STATE-02"),
        (deaf_to(130), "TRANS-01 GUARD-03", "TRANS-03 GUARD-02"),
        (pdo_at_every_sync, "PDO-12 PDO-13 PDO-18 PDO-19 STATE-04", "PDO-10 PDO-16 SYNC-01"),
        (answers_every_guard, "GUARD-04 HBVG-05 HBVG-07", "HBVG-04 HBVG-06"),
        (starts_by_itself, "STATE-01", "SDO-01 TRANS-03"),
    ],
)
def test_what_is_heard(hear: Hear, fail: str, pass_: str) -> None:
    with faulty(hear=hear) as dut:
        assert found(dut, *fail.split(), *pass_.split()) == expected(fail, pass_)


@pytest.mark.parametrize(("name", "kind"), [("SYNC-03", 10), ("PDO-22", 1)])
def test_a_transmission_type_that_a_node_does_not_have_is_no_failure(name: str, kind: int) -> None:
    request = b""

    def hear(frame: Frame) -> list[tuple[int, bytes]]:
        nonlocal request
        request = frame.data if frame.can_id == ANSWER + 0x80 else request
        return []

    def alter(can_id: int, data: bytes) -> bytes:
        asked = can_id == ANSWER and request[0] == 0x2F and request[2:5] == bytes((0x18, 2, kind))
        return b"\x80" + request[1:4] + b"\x30\0\x09\x06" if asked else data

    with faulty(alter, hear) as dut:
        assert found(dut, name) == {name: Verdict.NOT_APPLICABLE}


# --- nodes that do not answer as a node should at all


def test_answers_of_a_wrong_length_fail_every_transfer() -> None:
    broken = False

    def alter(can_id: int, data: bytes) -> bytes:
        return data[:7] if broken and can_id == ANSWER else data

    with faulty(alter) as dut:
        broken = True
        assert found(dut, "SDO-01", "SDO-05") == expected("SDO-01 SDO-05", "")


def test_a_node_that_falls_silent_fails_cases_and_ends_the_run() -> None:
    boots = 0

    def alter(can_id: int, data: bytes) -> bytes | None:
        nonlocal boots
        boots += can_id == ERROR_CONTROL
        return data if boots <= 3 else None  # power-on, connecting, the first case

    with faulty(alter) as dut:
        report = run_cases(dut, select(("SDO",)))
    first, *others = report.results
    assert first.verdict is OK
    assert all(result.verdict is BAD for result in others)
    assert [("not run" in result.why) for result in others] == [False] * 3 + [True] * (len(others) - 3)
