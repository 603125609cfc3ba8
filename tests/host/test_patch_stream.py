"""A stream under overload and under a defect: newest scan first, everything counted, nothing swallowed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from skinnode.config import HandConfig, PatchConfig
from skinnode.errors import SkinError
from skinnode.host.code_watch import Verdict
from skinnode.host.containment import Defects
from skinnode.host.node_facts import NodeFacts
from skinnode.host.patch_stream import PatchStream, StreamOptions, StreamOutput, StreamStats
from skinnode.host.publish import Publisher
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.sync import Ticks
from skinnode.host.workers import Inline, Job, OnError, Workers
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame, ScanStamp, SolveStats
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.process import clock
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.chunk import pack_scan
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import Scan
from skinnode.protocol.scan_check import check_of_codes
from skinnode.protocol.summary import SummaryFlag, pack_checked_summary, pack_summary
from skinnode.solve.tracker import Tracker

from .conftest import SMALL, eventually

LAYOUT = PatchLayout.preset("staggered", **SMALL)
PROFILE = PatchProfile.from_layout(LAYOUT)
REST_OHM = resistance_ohm(LAYOUT, LAYOUT.upper_m)
MS = 1_000_000


class Stub:
    """Stands for the solver: waits until it is let go, or fails."""

    def __init__(self) -> None:
        self.entered, self.go = clock.event(), clock.event()
        self.error: Exception | None = None
        self.facts = SimpleNamespace(checked=False)

    def solve(self, scan: Scan, stamp: ScanStamp, verdict: Verdict) -> tuple[FieldFrame, int]:
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


def stream_of(
    workers: Workers | Inline,
    publisher: Publisher,
    ticks: Ticks,
    solver: Any,
    defects: Defects | None = None,
    **options: Any,
) -> PatchStream:
    output = StreamOutput(workers, publisher, defects)
    assembler = ScanAssembler(PROFILE, counter_overflow=240)
    stream = PatchStream("thumb", assembler, output, StreamOptions(ticks.find, **options))
    stream.resume(solver, 0, anew=True)
    return stream


@pytest.fixture
def stream(stub: Stub, publisher: Publisher, ticks: Ticks) -> Iterator[PatchStream]:
    with Workers(2, "solve") as workers:
        stream = stream_of(workers, publisher, ticks, stub)
        yield stream
        stub.go.set()
        stream.close()


def all_accounted_for(stats: StreamStats) -> bool:
    return stats.offered == stats.solved + stats.skipped


def feed(stream: PatchStream, counter: int, t_ns: int, ohm: Float = REST_OHM, without: int = -1) -> None:
    """A scan at rest or with the resistances ``ohm``, whole or without one of its chunks."""
    chunks = pack_scan(encode(ohm, REST_OHM, CodeScale()), counter, PROFILE)
    for chunk in chunks[:without] + chunks[without + 1 :] if without >= 0 else chunks:
        stream.on_chunk(chunk, t_ns)
    stream.on_summary(pack_summary(counter, SummaryFlag(0), len(chunks), 1000 * counter), t_ns)


def test_overload_skips_to_the_newest_scan(
    stream: PatchStream, stub: Stub, publisher: Publisher, ticks: Ticks
) -> None:
    fields = publisher.subscribe(10, 10.0, None)
    feed(stream, 1, 0)
    assert stub.entered.wait(10)
    for counter in range(2, 8):
        feed(stream, counter, counter * MS)
    stats = stream.stats()
    assert stats.offered == 7
    stub.go.set()
    numbers = [field.stamp.scan for field in (fields.get(10), fields.get(10)) if field and field.stamp]
    assert numbers == [1, 7]
    assert eventually(lambda: stream.stats().solved == 2)
    stats = stream.stats()
    assert (stats.offered, stats.solved, stats.skipped) == (7, 2, 5)
    assert fields.get(0.05) is None


def test_what_a_replay_leaves_out_is_told_by_its_time_not_its_number(
    stream: PatchStream, stub: Stub, publisher: Publisher, ticks: Ticks
) -> None:
    """After a long pause a counter may come again, and both scans are that of one SYNC."""
    stub.go.set()
    fields = publisher.subscribe(10, 10.0, None)
    ticks.note(5, 0)
    stream.leave_out([1000 * MS + 1500], 2000)
    feed(stream, 5, 0)
    first = fields.get(10)
    feed(stream, 5, 1000 * MS)
    assert fields.get(0.05) is None
    feed(stream, 5, 2000 * MS)
    third = fields.get(10)
    numbers = [field.stamp.scan for field in (first, third) if field and field.stamp]
    assert numbers == [5, 5]
    assert (stream.stats().offered, stream.stats().skipped) == (3, 1)


def test_scan_number_and_time_are_those_of_the_sync(
    stream: PatchStream, stub: Stub, publisher: Publisher, ticks: Ticks
) -> None:
    stub.go.set()
    fields = publisher.subscribe(10, 10.0, None)
    for number in range(239, 243):
        counter = ticks.note(number, 1000 * number)
        feed(stream, counter, number * MS)
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
    with Workers(1, "solve") as workers:
        stream = stream_of(workers, publisher, ticks, stub, partial="withhold")
        feed(stream, 1, 0, without=0)
        feed(stream, 2, 80 * MS)  # ends the torn one
        stream.poll(80 * MS)
        field = fields.get(10)
        assert field is not None
        assert field.stamp is not None
        assert field.stamp.counter == 2
        stats = stream.stats()
        assert (stats.partial, stats.offered, stats.withheld) == (1, 1, 0)
        assert stats.assembler.scans_torn == 1
        stream.close()


def test_scan_with_a_chunk_missing_goes_on_with_a_mask(
    stream: PatchStream, stub: Stub, publisher: Publisher
) -> None:
    stub.go.set()
    feed(stream, 1, 0, without=3)
    assert stream.stats().offered == 0
    stream.poll(100 * MS)
    assert eventually(lambda: stream.stats().solved == 1)
    stats = stream.stats()
    assert (stats.assembler.scans_torn, stats.assembler.chunks_lost, stats.invalid_codes) == (1, 1, 3)


@pytest.mark.parametrize("anew", [False, True])
def test_a_node_known_to_send_checks_is_taken_at_its_word(
    stream: PatchStream, stub: Stub, anew: bool
) -> None:
    """From the first scan on: a summary without a check counts for nothing."""
    stub.go.set()
    stub.facts.checked = True
    stream.resume(stub, stream.withholdings, anew=anew)
    feed(stream, 1, 0)
    stream.poll(100 * MS)
    assembler = stream.stats().assembler
    assert (assembler.bad_form, assembler.scans_unchecked, assembler.scans_complete) == (1, 1, 0)


def test_a_scan_thrown_away_may_have_told_of_a_new_baseline(stream: PatchStream, stub: Stub) -> None:
    """Nobody will ever see its flags: so the baseline is read again."""
    stub.go.set()
    feed(stream, 1, 0)
    assert not stream.doubtful
    codes = encode(REST_OHM, REST_OHM, CodeScale())
    chunks = pack_scan(codes, 2, PROFILE)
    for chunk in chunks:
        stream.on_chunk(chunk, MS)
    wrong = check_of_codes(codes, PROFILE) ^ 1
    stream.on_summary(pack_checked_summary(2, SummaryFlag.BASELINE_CHANGED, len(chunks), 0, wrong), MS)
    assert stream.stats().assembler.scans_corrupt == 1
    assert stream.doubtful


@pytest.mark.parametrize("failing", [ZeroDivisionError("by zero"), MemoryError("no more")])
def test_a_defect_reaches_the_subscriber(
    stream: PatchStream, stub: Stub, publisher: Publisher, failing: Exception
) -> None:
    fields = publisher.subscribe(10, 10.0, None)
    stub.error = failing
    stub.go.set()
    feed(stream, 1, 0)
    with pytest.raises(SkinError) as caught:
        fields.get(10)
    assert str(caught.value) == f"patch 'thumb', scan 1: {type(failing).__name__}: {failing}"
    assert caught.value.__cause__ is failing


class Full(Inline):
    """Takes no job while it is full."""

    def __init__(self) -> None:
        self.full = False

    def submit(self, job: Job, on_error: OnError) -> None:
        if self.full:
            raise MemoryError("no more")
        super().submit(job, on_error)


def test_a_scan_that_no_worker_takes_costs_itself(stub: Stub, publisher: Publisher, ticks: Ticks) -> None:
    workers, fields = Full(), publisher.subscribe(10, 10.0, None)
    stub.go.set()
    stream = stream_of(workers, publisher, ticks, stub)
    workers.full = True
    with pytest.raises(MemoryError, match="no more"):  # whoever handles the frame reports it
        feed(stream, 1, 0)
    workers.full = False
    feed(stream, 2, MS)
    field = fields.get(0)
    assert field is not None
    assert field.stamp is not None
    assert field.stamp.counter == 2


def test_a_worker_that_finds_no_successor_leaves_the_lane_open(publisher: Publisher, ticks: Ticks) -> None:
    """The scan that came while it solved waits, and is overtaken by the next."""
    workers, defects = Full(), Defects("thumb")

    class Slow(Stub):
        def solve(self, scan: Scan, stamp: ScanStamp, verdict: Verdict) -> tuple[FieldFrame, int]:
            if stamp.counter == 1:
                feed(stream, 2, MS)
                workers.full = True
            return super().solve(scan, stamp, verdict)

    slow = Slow()
    slow.go.set()
    stream = stream_of(workers, publisher, ticks, slow, defects)
    feed(stream, 1, 0)
    assert (defects.count, defects.newest) == (1, "solving: MemoryError: no more")
    workers.full = False
    feed(stream, 3, 2 * MS)
    stats = stream.stats()
    assert (stats.offered, stats.solved, stats.skipped) == (3, 2, 1)
    assert defects.count == 1


@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_a_field_is_what_the_method_of_the_hand_makes_of_the_codes(
    make_hand: Callable[..., HandConfig], publisher: Publisher, ticks: Ticks, method: str
) -> None:
    """Against the tracker of that method, given the resistances that were encoded."""
    hand = make_hand(1, solver={"method": method})
    facts = NodeFacts(hand.patches[0], LAYOUT, PROFILE, CodeScale(), REST_OHM, None, 0.25)
    solver = ScanSolver(facts, hand.solver, lambda: 7 * MS)
    pressed_m = LAYOUT.upper_m - [0.0, 0.0, 0.05e-3]
    pressed_ohm = resistance_ohm(LAYOUT, pressed_m)
    stream = stream_of(Inline(), publisher, ticks, solver)
    fields = publisher.subscribe(10, 10.0, None)
    feed(stream, 1, MS, pressed_ohm)
    field = fields.get(0)
    assert field is not None
    assert (field.method, field.trusted, stream.stats().invalid_codes) == (method, True, 0)
    assert field.stamp is not None
    assert (field.stamp.t_receive_ns, field.stamp.t_solved_ns) == (MS, 7 * MS)
    expected = Tracker(LAYOUT, method=method, baseline_ohm=REST_OHM).update(pressed_ohm)
    np.testing.assert_allclose(field.displacement_m, expected.displacement_m, atol=1e-6)


def test_the_field_of_a_moving_skin_belongs_to_the_time_of_its_scan(
    make_hand: Callable[..., HandConfig], publisher: Publisher, ticks: Ticks
) -> None:
    """The third scan is lost, and the upper wires are sampled one after the other."""
    hand, row_s, speed_m_s = make_hand(1, solver={"method": "exact"}), 5e-3, 1e-3
    patch = hand.patches[0].model_copy(update={"row_time_us": 1e6 * row_s})
    facts = NodeFacts(patch, LAYOUT, PROFILE, CodeScale(), REST_OHM, None, 0.25)
    stream = stream_of(Inline(), publisher, ticks, ScanSolver(facts, hand.solver))
    fields = publisher.subscribe(10, 10.0, None)
    for number in (1, 2, 4):
        t_s = 0.08 * number
        sampled_s = t_s + row_s * np.arange(LAYOUT.shape[0])[:, None]
        upper_m = LAYOUT.upper_m.copy()
        upper_m[..., 2] -= speed_m_s * sampled_s
        feed(stream, number, round(1e9 * t_s), resistance_ohm(LAYOUT, upper_m))
        field = fields.get(0)
        assert field is not None
    assert field.trusted
    errors = field.displacement_m[..., 2] + speed_m_s * t_s
    np.testing.assert_allclose(errors, 0.0, atol=0.4 * speed_m_s * row_s)


def test_drift_while_sync_pauses_is_no_touch(
    make_hand: Callable[..., HandConfig], publisher: Publisher, ticks: Ticks
) -> None:
    """For eight hours, in which the skin cools down, so that all resistances rise by 2 %."""
    hand, rng = make_hand(1), np.random.default_rng(5)
    ordinary = PatchConfig(name="thumb", node_id=5).tolerances  # a drift of 2 % contradicts exact ones
    patch = hand.patches[0].model_copy(update={"relative_noise": 1e-3, "tolerances": ordinary})
    facts = NodeFacts(patch, LAYOUT, PROFILE, CodeScale(), REST_OHM, None, 0.25)
    stream = stream_of(Inline(), publisher, ticks, ScanSolver(facts, hand.solver))
    fields, touched = publisher.subscribe(10, 10.0, None), []
    for number in range(1, 61):
        paused = number > 30
        ohm = REST_OHM * (1.02 if paused else 1.0) * (1.0 + 1e-3 * rng.standard_normal(LAYOUT.shape))
        feed(stream, number, (number * 80 + paused * 8 * 3_600_000) * MS, ohm)
        field = fields.get(0)
        assert field is not None
        touched.append(field.touched)
    assert touched == [False] * 60


def test_scans_from_many_turns_are_all_accounted_for(
    stream: PatchStream, stub: Stub, publisher: Publisher
) -> None:
    """However mainline and workers interleave: solved, skipped or waiting, and the token is never lost."""
    stub.go.set()
    for number in range(500):
        feed(stream, number % 240 + 1, number * MS)
        if number % 50 == 0:
            assert eventually(
                lambda: stream.stats().offered == stream.stats().solved + stream.stats().skipped
            )
    assert eventually(lambda: all_accounted_for(stream.stats()))
    assert stream.stats().offered == 500
    newest = publisher.latest("thumb")
    assert newest is not None
    assert newest.stamp is not None
    assert newest.stamp.counter == 499 % 240 + 1


def test_scans_are_withheld_until_somebody_says_how_to_decode_them(
    stream: PatchStream, stub: Stub, publisher: Publisher
) -> None:
    fields = publisher.subscribe(10, 10.0, None)
    stub.go.set()
    feed(stream, 1, 0)
    assert eventually(lambda: stream.stats().solved == 1)
    stream.withhold()
    feed(stream, 2, MS)
    known = stream.withholdings
    stream.withhold()
    stream.resume(stub, known, anew=False)  # what it knows was out of date by then
    feed(stream, 3, 2 * MS)
    stream.resume(stub, stream.withholdings, anew=False)
    feed(stream, 4, 3 * MS)
    assert [field.stamp.counter for field in (fields.get(10), fields.get(10))] == [1, 4]
    assert eventually(lambda: stream.stats().solved == 2)
    assert (stream.stats().withheld, stream.stats().offered) == (2, 2)
