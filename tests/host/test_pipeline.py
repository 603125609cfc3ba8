"""A lane under overload and under a defect: newest scan first, everything counted, nothing swallowed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from skinnode.errors import SkinError
from skinnode.host.pipeline import Lane
from skinnode.host.publish import Publisher
from skinnode.host.sync import Ticks
from skinnode.host.workers import Workers
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame, ScanStamp, SolveStats
from skinnode.model.layout import PatchLayout
from skinnode.model.status import Status
from skinnode.wire.assembler import Scan, ScanAssembler
from skinnode.wire.codec import CodeScale, SummaryFlag, encode, pack_scan, pack_summary
from skinnode.wire.profile import PatchProfile

from .conftest import SMALL, eventually

LAYOUT = PatchLayout.preset("staggered", **SMALL)
PROFILE = PatchProfile.from_layout(LAYOUT)
REST_OHM = resistance_ohm(LAYOUT, LAYOUT.upper_m)
MS = 1_000_000


class Stub:
    """Stands for the solver: waits until it is let go, or fails."""

    def __init__(self) -> None:
        self.entered, self.go = threading.Event(), threading.Event()
        self.error: Exception | None = None

    def solve(self, scan: Scan, stamp: ScanStamp) -> tuple[FieldFrame, int]:
        self.entered.set()
        self.go.wait(10)
        if self.error is not None:
            raise self.error
        zero = np.zeros_like(LAYOUT.upper_m)
        status = (Status.CONVERGED,) * len(zero)
        field = FieldFrame(zero, zero, status, np.zeros(len(zero)), SolveStats(0, 0, 0, 0.0))
        return replace(field, stamp=stamp), scan.valid.size - np.count_nonzero(scan.valid)


@pytest.fixture
def stub() -> Stub:
    return Stub()


@pytest.fixture
def publisher() -> Publisher:
    return Publisher(("thumb",))


@pytest.fixture
def ticks() -> Ticks:
    return Ticks(240)


@pytest.fixture
def lane(stub: Stub, publisher: Publisher, ticks: Ticks) -> Iterator[Lane]:
    assembler = ScanAssembler(PROFILE, counter_overflow=240)
    with Workers(2, "solve") as workers:
        lane = Lane("thumb", assembler, workers, publisher, ticks.find, lambda t_ns: None)
        lane.resume(stub, 0, anew=True)
        yield lane
        stub.go.set()
        lane.close()


def feed(lane: Lane, counter: int, t_ns: int) -> None:
    """A whole scan at rest."""
    chunks = pack_scan(encode(REST_OHM, REST_OHM, CodeScale()), counter, PROFILE)
    for chunk in chunks:
        lane.on_chunk(chunk, t_ns)
    lane.on_summary(pack_summary(counter, SummaryFlag(0), len(chunks), 1000 * counter), t_ns)


def test_overload_skips_to_the_newest_scan(
    lane: Lane, stub: Stub, publisher: Publisher, ticks: Ticks
) -> None:
    fields = publisher.subscribe(10, 10.0, None)
    feed(lane, 1, 0)
    assert stub.entered.wait(10)
    for counter in range(2, 8):
        feed(lane, counter, counter * MS)
    stats = lane.stats()
    assert stats.offered == 7
    stub.go.set()
    numbers = [field.stamp.scan for field in (fields.get(10), fields.get(10)) if field and field.stamp]
    assert numbers == [1, 7]
    assert eventually(lambda: lane.stats().solved == 2)
    stats = lane.stats()
    assert (stats.offered, stats.solved, stats.skipped) == (7, 2, 5)
    assert fields.get(0.05) is None


def test_what_a_replay_leaves_out_is_told_by_its_time_not_its_number(
    lane: Lane, stub: Stub, publisher: Publisher, ticks: Ticks
) -> None:
    """After a long pause a counter may come again, and both scans are that of one SYNC."""
    stub.go.set()
    fields = publisher.subscribe(10, 10.0, None)
    ticks.note(5, 0)
    lane.leave_out([1000 * MS + 1500], 2000)
    feed(lane, 5, 0)
    first = fields.get(10)
    feed(lane, 5, 1000 * MS)
    assert fields.get(0.05) is None
    feed(lane, 5, 2000 * MS)
    third = fields.get(10)
    numbers = [field.stamp.scan for field in (first, third) if field and field.stamp]
    assert numbers == [5, 5]
    assert (lane.stats().offered, lane.stats().skipped) == (3, 1)


def test_scan_number_and_time_are_those_of_the_sync(
    lane: Lane, stub: Stub, publisher: Publisher, ticks: Ticks
) -> None:
    stub.go.set()
    fields = publisher.subscribe(10, 10.0, None)
    for number in range(239, 243):
        counter = ticks.note(number, 1000 * number)
        feed(lane, counter, number * MS)
        field = fields.get(10)
        assert field is not None
        assert field.stamp is not None
        assert (field.stamp.scan, field.stamp.t_sync_ns) == (number, 1000 * number)
        assert field.stamp.counter == (239, 240, 1, 2)[number - 239]
        assert field.stamp.t_receive_ns == number * MS
        assert field.stamp.device_time_us == 1000 * field.stamp.counter


def test_scan_with_a_chunk_missing_is_withheld_by_policy(
    stub: Stub, publisher: Publisher, ticks: Ticks
) -> None:
    stub.go.set()
    fields = publisher.subscribe(10, 10.0, None)
    assembler = ScanAssembler(PROFILE, counter_overflow=240)
    with Workers(1, "solve") as workers:
        lane = Lane("thumb", assembler, workers, publisher, ticks.find, lambda t_ns: None, "withhold")
        lane.resume(stub, 0, anew=True)
        chunks = pack_scan(encode(REST_OHM, REST_OHM, CodeScale()), 1, PROFILE)
        for chunk in chunks[1:]:
            lane.on_chunk(chunk, 0)
        lane.on_summary(pack_summary(1, SummaryFlag(0), len(chunks), 0), 0)
        feed(lane, 2, 80 * MS)  # ends the torn one
        lane.poll(80 * MS)
        field = fields.get(10)
        assert field is not None
        assert field.stamp is not None
        assert field.stamp.counter == 2
        stats = lane.stats()
        assert (stats.partial, stats.offered, stats.withheld) == (1, 1, 0)
        assert stats.assembler.scans_torn == 1
        lane.close()


def test_scan_with_a_chunk_missing_goes_on_with_a_mask(lane: Lane, stub: Stub, publisher: Publisher) -> None:
    stub.go.set()
    chunks = pack_scan(encode(REST_OHM, REST_OHM, CodeScale()), 1, PROFILE)
    for chunk in chunks[:3] + chunks[4:]:
        lane.on_chunk(chunk, 0)
    lane.on_summary(pack_summary(1, SummaryFlag(0), len(chunks), 0), 0)
    assert lane.stats().offered == 0
    lane.poll(100 * MS)
    assert eventually(lambda: lane.stats().solved == 1)
    stats = lane.stats()
    assert (stats.assembler.scans_torn, stats.assembler.chunks_lost, stats.invalid_codes) == (1, 1, 3)


@pytest.mark.parametrize("failing", [ZeroDivisionError("by zero"), MemoryError("no more")])
def test_a_defect_reaches_the_subscriber(
    lane: Lane, stub: Stub, publisher: Publisher, failing: Exception
) -> None:
    fields = publisher.subscribe(10, 10.0, None)
    stub.error = failing
    stub.go.set()
    feed(lane, 1, 0)
    with pytest.raises(SkinError) as caught:
        fields.get(10)
    assert str(caught.value) == f"patch 'thumb', scan 1: {type(failing).__name__}: {failing}"
    assert caught.value.__cause__ is failing


def test_scans_from_many_turns_are_all_accounted_for(lane: Lane, stub: Stub, publisher: Publisher) -> None:
    """However mainline and workers interleave: solved, skipped or waiting, and the token is never lost."""
    stub.go.set()
    for number in range(500):
        feed(lane, number % 240 + 1, number * MS)
        if number % 50 == 0:
            assert eventually(lambda: lane.stats().offered == lane.stats().solved + lane.stats().skipped)
    assert eventually(lambda: lane.stats().offered == lane.stats().solved + lane.stats().skipped)
    assert lane.stats().offered == 500
    newest = publisher.latest("thumb")
    assert newest is not None
    assert newest.stamp is not None
    assert newest.stamp.counter == 499 % 240 + 1


def test_scans_are_withheld_until_somebody_says_how_to_decode_them(
    lane: Lane, stub: Stub, publisher: Publisher
) -> None:
    fields = publisher.subscribe(10, 10.0, None)
    stub.go.set()
    feed(lane, 1, 0)
    assert eventually(lambda: lane.stats().solved == 1)
    lane.withhold()
    feed(lane, 2, MS)
    known = lane.withholdings
    lane.withhold()
    lane.resume(stub, known, anew=False)  # what it knows was out of date by then
    feed(lane, 3, 2 * MS)
    lane.resume(stub, lane.withholdings, anew=False)
    feed(lane, 4, 3 * MS)
    assert [field.stamp.counter for field in (fields.get(10), fields.get(10))] == [1, 4]
    assert eventually(lambda: lane.stats().solved == 2)
    assert (lane.stats().withheld, lane.stats().offered) == (2, 2)
