"""The conversion phase in the summary: whether the codes of a scan are new."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from .conftest import Desk

SUMMARY = 0x284
OVERRUN, SOURCE_FAILED = 0x02, 0x10


@pytest.fixture
def counting(operational: Desk) -> Desk:
    operational.source.conversions = 1_000_000
    return operational


def phases_of(desk: Desk, advance: Callable[[], None], scans: int) -> list[int]:
    """Return bits 6 and 7 of the flags of each scan."""
    found = []
    for counter in range(1, scans + 1):
        advance()
        desk.take()
        desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
        desk.run(50)
        found += [data[1] >> 6 for can_id, data, _ in desk.sent if can_id == SUMMARY]
    return found


def test_the_phase_steps_with_each_new_conversion_and_repeats_without_one(counting) -> None:
    steps = iter([1, 1, 1, 1, 0, 0, 7, 3, 3, 0, 6])  # three conversions a scan are no repetition

    def advance() -> None:
        counting.source.conversions += next(steps)

    assert phases_of(counting, advance, 11) == [1, 2, 3, 1, 1, 1, 2, 3, 1, 1, 2]


def test_a_source_that_does_not_count(operational) -> None:
    assert phases_of(operational, lambda: None, 2) == [0, 0]
    operational.source.conversions = None
    assert phases_of(operational, lambda: None, 2) == [0, 0]


def test_a_mean_of_readings_is_one_step(counting) -> None:
    counting.write(0x2021, 2, 3, 1)
    reads = counting.source.reads

    def advance() -> None:
        counting.source.conversions += 3

    assert phases_of(counting, advance, 4) == [1, 2, 3, 1]
    assert counting.source.reads == reads + 12


def test_a_count_that_is_none_fails_the_source(counting) -> None:
    counting.source.conversions = "many"
    counting.take()
    counting.node.on_frame(0x80, b"\x01", counting.t_ns)
    counting.run(50)
    (flags,) = (data[1] for can_id, data, _ in counting.sent if can_id == SUMMARY)
    assert flags & SOURCE_FAILED
    assert counting.node.source_error.startswith("source.conversions: TypeError: ")
