"""Streams whose summaries carry a check: what is complete, what is thrown away, and which time it was."""

from __future__ import annotations

import dataclasses

import pytest

from skinnode.errors import CodecError
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.summary import SummaryFlag, pack_checked_summary, pack_summary

from ..scan_crc import check_of_scan
from .test_assembler import (
    GRACE,
    PERIOD,
    PROFILES,
    Frame,
    ModelNode,
    assert_from_one_scan,
    changed,
    frames_counted,
    receive,
)

WRAP_US = 1 << 22


@pytest.fixture(params=PROFILES, ids=["u16", "u24", "fd"])
def node(request: pytest.FixtureRequest) -> ModelNode:
    return ModelNode(request.param, 240, checked=True)


@pytest.fixture
def assembler(node: ModelNode) -> ScanAssembler:
    return ScanAssembler(node.profile, counter_overflow=240, period_ns=PERIOD, grace_ns=GRACE)


def wrong_code(node: ModelNode, frames: list[Frame], chunk: int = 1) -> list[Frame]:
    """The frames with another code in one of the chunks."""
    at = node.profile.chunk_head_bytes
    return [changed(f, at, 0x10) if i == chunk else f for i, f in enumerate(frames)]


def test_a_scan_whose_check_passes_is_complete(node: ModelNode, assembler: ScanAssembler) -> None:
    published = receive(assembler, [*node.scan(7), *node.scan(8, [1]), *node.scan(9, [])])
    assert [(scan.counter, scan.complete, bool(scan.valid.all())) for scan in published] == [
        (7, True, True),
        (8, True, True),
        (9, True, True),
    ]
    for scan in published:
        assert_from_one_scan(scan, node)
    assert {scan.flags for scan in published} == {0x20, 0x21}
    assert [scan.device_time_us for scan in published] == [80_000 * number for number in (7, 8, 9)]


def test_a_scan_with_a_wrong_code_is_thrown_away_and_nothing_of_it_is_inherited(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    """Nobody can tell which chunk is wrong: all is unknown until it is sent again."""
    doubts: list[None] = []
    assembler.on_discarded = lambda: doubts.append(None)
    n = node.profile.n_chunks
    receive(assembler, node.scan(7))
    assert receive(assembler, wrong_code(node, node.scan(8))) == []
    stats = assembler.stats
    assert (stats.scans_complete, stats.scans_corrupt, stats.scans_torn, stats.chunks_lost) == (1, 1, 0, 0)
    assert frames_counted(stats) == 2 * (n + 1)
    assert stats.chunks_accepted == 2 * n
    assert len(doubts) == 1
    one, all_but_one, last = receive(
        assembler, [*node.scan(9, [1]), *node.scan(10, range(1, n)), *node.scan(11, [0])]
    )
    assert [scan.complete for scan in (one, all_but_one, last)] == [False, False, True]
    assert [int(scan.valid.all()) for scan in (one, all_but_one, last)] == [0, 0, 1]
    assert (assembler.stats.scans_unchecked, assembler.stats.scans_torn) == (2, 0)
    for scan in (one, all_but_one, last):
        assert_from_one_scan(scan, node)


def test_a_changed_chunk_with_a_wrong_code_is_found_in_the_whole_matrix(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    receive(assembler, node.scan(7))
    assert receive(assembler, wrong_code(node, node.scan(8, [1]), 0)) == []
    assert assembler.stats.scans_corrupt == 1
    (healed,) = receive(assembler, node.scan(9))
    assert healed.complete


@pytest.mark.parametrize("known", [False, True])
def test_a_lost_summary_costs_the_completeness(
    node: ModelNode, assembler: ScanAssembler, known: bool
) -> None:
    """Where the node is known to send checks, or has sent one."""
    if known:
        assembler.expect_check()
    else:
        receive(assembler, node.scan(7))
    (scan,) = receive(assembler, node.scan(8)[:-1], until_ns=12 * PERIOD)
    assert not scan.complete
    assert scan.valid.all()
    stats = assembler.stats
    assert (stats.scans_unchecked, stats.scans_torn, stats.summaries_lost) == (1, 0, 1)


@pytest.mark.parametrize("known", [False, True])
def test_a_summary_without_a_check_is_rejected_in_a_checked_stream(node: ModelNode, known: bool) -> None:
    told: list[CodecError] = []
    assembler = ScanAssembler(
        node.profile, counter_overflow=240, period_ns=PERIOD, node_id=5, on_reject=told.append
    )
    if known:
        assembler.reset(checked=True)
    else:
        receive(assembler, node.scan(7))
    *chunks, summary = node.scan(8)
    old = dataclasses.replace(summary, data=pack_summary(8, 0, node.profile.n_chunks, 8))
    (scan,) = receive(assembler, [*chunks, old], until_ns=12 * PERIOD)
    assert (scan.complete, scan.device_time_us) == (False, None)
    assert (assembler.stats.bad_form, assembler.stats.scans_unchecked) == (1, 1)
    assert frames_counted(assembler.stats) == (1 if known else 2) * (node.profile.n_chunks + 1)
    assert str(told[0]).endswith("allowed: a scan summary with a check (flag 0x20)")


def test_old_summaries_are_read_until_a_check_has_passed(node: ModelNode, assembler: ScanAssembler) -> None:
    """A flag turned on by damage makes no checked stream of an old one."""
    old = dataclasses.replace(node, checked=False)
    assert [scan.complete for scan in receive(assembler, old.scan(7))] == [True]
    *chunks, summary = old.scan(8)
    assert receive(assembler, [*chunks, changed(summary, 1, 0x20)]) == []
    assert assembler.stats.scans_corrupt == 1
    assert [scan.complete for scan in receive(assembler, old.scan(9))] == [True]
    node.codes = old.codes
    assert [scan.complete for scan in receive(assembler, node.scan(10))] == [True]
    (scan,) = receive(assembler, old.scan(11), until_ns=15 * PERIOD)
    assert not scan.complete
    assembler.reset()  # another node, or other software in it
    (scan,) = receive(assembler, old.scan(20))
    assert (scan.complete, scan.device_time_us) == (True, 20)


def test_an_overrun_is_torn_whatever_its_check_says(node: ModelNode, assembler: ScanAssembler) -> None:
    receive(assembler, node.scan(7))
    (scan,) = receive(assembler, node.scan(8, [0], overrun=True), until_ns=12 * PERIOD)
    assert not scan.complete
    *chunks, _ = node.scan(9)
    head = 9, SummaryFlag.OVERRUN, 1
    summary = pack_checked_summary(*head, 0, 0x1234)
    received = receive(assembler, [chunks[0], dataclasses.replace(chunks[1], data=summary, is_summary=True)])
    assert [scan.complete for scan in received] == [False]
    assert (assembler.stats.scans_torn, assembler.stats.scans_corrupt) == (2, 0)


def test_a_scan_without_a_reading_is_torn(node: ModelNode, assembler: ScanAssembler) -> None:
    receive(assembler, node.scan(7))
    summary = pack_checked_summary(8, SummaryFlag.SOURCE_FAILED, 0, 8 * 80_000, 0x1234)
    published = receive(assembler, [Frame(summary, 8 * PERIOD, True, 8)], until_ns=9 * PERIOD)
    assert [(scan.complete, scan.flags) for scan in published] == [(False, 0x30)]
    assert not published[0].valid.any()


def test_changed_chunks_taken_up_late_are_complete_when_all_are_known(node: ModelNode) -> None:
    assembler = ScanAssembler(node.profile, counter_overflow=240, period_ns=PERIOD, under_way=True)
    node.scan(6)
    n = node.profile.n_chunks
    frames = [*node.scan(7, [0, 1])[1:], *node.scan(8, [0]), *node.scan(9, []), *node.scan(10, range(1, n))]
    published = receive(assembler, frames)
    assert [(scan.counter, scan.complete) for scan in published] == [(8, False), (9, False), (10, True)]
    stats = assembler.stats
    assert (stats.scans_joined, stats.scans_unchecked, stats.scans_torn) == (1, 2, 0)


@pytest.mark.parametrize(
    ("flags", "doubted"), [(0, 0), (SummaryFlag.BASELINE_CHANGED, 1), (None, 1)], ids=["none", "new", "lost"]
)
def test_a_new_baseline_told_by_a_scan_that_nobody_sees_is_doubted(
    node: ModelNode, flags: int | None, doubted: int
) -> None:
    """Of a scan under way when the stream was taken up."""
    assembler = ScanAssembler(node.profile, counter_overflow=240, period_ns=PERIOD, under_way=True)
    doubts: list[None] = []
    assembler.on_discarded = lambda: doubts.append(None)
    *chunks, last = node.scan(7)
    if flags is not None:
        summary = node.summary(7, flags, node.profile.n_chunks)
        chunks.append(dataclasses.replace(last, data=summary))
    assert receive(assembler, chunks[1:], until_ns=12 * PERIOD) == []
    assert (assembler.stats.scans_joined, len(doubts)) == (1, doubted)


# --- device time


class Clock:
    """A node's clock beside the host's, and scans of one chunk that tell of it."""

    def __init__(self, node_us: int, drift: float = 0.0) -> None:
        self._node = ModelNode(PROFILES[0], 0, checked=True)
        self._assembler = ScanAssembler(PROFILES[0], period_ns=PERIOD)
        self._node_us, self._drift = node_us, drift
        self._number = 0

    def scan(self, t_s: float) -> tuple[int, int]:
        """Device time of a scan that ends at ``t_s``, as the node knows it and as the host does."""
        self._number += 1
        true_us = self._node_us + round(t_s * 1e6 * (1.0 + self._drift))
        node, n = self._node, PROFILES[0].n_chunks
        *chunks, _ = node.scan(self._number)
        end_ns = round(t_s * 1e9)
        for frame in chunks:
            self._assembler.on_chunk(frame.data, end_ns)
        head = pack_checked_summary(node.counter(self._number), 0, n, true_us, 0)[:6]
        check = check_of_scan(node.truth[self._number], 16, head)
        published = self._assembler.on_summary(head + check.to_bytes(2, "little"), end_ns)
        assert published is not None
        assert published.complete
        assert published.device_time_us is not None
        return true_us, published.device_time_us


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
@pytest.mark.parametrize("gap_s", [0.08, 4.1, 4.2, 60.0, 3600.0, 4 * 3600.0])
def test_device_time_goes_on_over_any_gap(gap_s: float, drift: float) -> None:
    """With clocks that are 100 ppm apart, and through the end of the 32 bits after 71 minutes."""
    clock = Clock((1 << 32) - 30_000_000, drift)
    true_us, got_us = clock.scan(50.0)
    off = (got_us - true_us) % (1 << 32)  # what the upper 10 bits began with
    assert 0 <= (-off) % WRAP_US < 64
    t_s = 50.0
    for _ in range(5):
        t_s += gap_s
        true_us, got_us = clock.scan(t_s)
        assert 0 <= (true_us // 64 * 64 + off + 63) % (1 << 32) - got_us < 64


@pytest.mark.parametrize("late_us", [0, 30_000, 3_000_000])
def test_device_time_of_a_clock_shared_with_the_host_is_the_time_itself(late_us: int) -> None:
    """However long after its SYNC the first scan ends: on a loaded machine that may be seconds."""
    clock = Clock(-late_us)
    for t_s in (100.0, 100.08, 5000.0, 7000.0):
        true_us, got_us = clock.scan(t_s)
        assert got_us == true_us // 64 * 64 % (1 << 32)
