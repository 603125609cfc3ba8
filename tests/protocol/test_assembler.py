"""The assembler against a model that knows which scan every code was sampled in.

Each code on the model's wire is unique to the scan in which it was sampled and to its place, so that a
published scan shows by itself what it was made of. Frames are then lost, repeated, delayed and so reordered,
whole stretches are blacked out, and whatever comes out must be a part of what exactly one scan was. Where the
node sends a check, frames are falsified too, and what is published as complete must be the scan itself.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skinnode.errors import CodecError, ConfigError
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.chunk import pack_chunk
from skinnode.protocol.codes import MISSING
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import AssemblerStats, Scan
from skinnode.protocol.summary import SummaryFlag, pack_summary

from ..scan_crc import check_of_scan

PERIOD = 80_000_000
GRACE = 5_000_000
PACE = PERIOD // 20
STEPS_64US = PERIOD // 64_000
PROFILES = [
    PatchProfile(2, 5, 1, 1, 16),
    PatchProfile(2, 5, 1, 1, 24),
    PatchProfile(2, 21, 1, 1, 24, bus="fd"),
]
"""10 codes in 4 and in 5 chunks; the last chunk is not full. Over CAN FD 2 chunks a wire, of 11 and 10."""


def owners(profile: PatchProfile) -> NDArray[np.int64]:
    """The chunk of each code of a scan."""
    place = np.arange(profile.n_codes)
    if profile.bus == "fd":
        return np.where(place % 21 < 11, 0, 1) + 2 * (place // 21)
    return place // (6 // (profile.code_bits // 8))


def payload(profile: PatchProfile, chunk: int, counter: int, codes: Sequence[int]) -> bytes:
    """A chunk with ``codes``, of which the last of a wire or a scan may have fewer."""
    if profile.bus == "fd":
        body = b"".join(code.to_bytes(3, "little") for code in codes)
        return struct.pack("<BBH", chunk // 2, counter, chunk % 2 * 11) + body.ljust(44, b"\0")
    return pack_chunk(chunk, counter, codes, profile.code_bits)


@dataclass(frozen=True)
class Frame:
    data: bytes
    t_ns: int
    is_summary: bool
    sample: int
    """The scan it truly belongs to, as no receiver could know."""


@dataclass
class ModelNode:
    """What a node sends, and what it had sampled."""

    profile: PatchProfile
    counter_overflow: int
    checked: bool = False
    truth: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    sent: dict[int, tuple[int, ...]] = field(default_factory=dict)
    codes: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.codes = np.zeros(self.profile.n_codes, dtype=np.int64)

    def counter(self, sample: int) -> int:
        n = self.counter_overflow
        return (sample - 1) % n + 1 if n else sample % 256

    def scan(self, sample: int, chunks: Iterable[int] | None = None, *, overrun: bool = False) -> list[Frame]:
        """Sample, with new codes in ``chunks`` (None: in all, and a full scan), and send these in order."""
        n, owner = self.profile.n_chunks, owners(self.profile)
        chosen = tuple(range(n)) if chunks is None else tuple(sorted(chunks))
        flags = 0 if chunks is None else SummaryFlag.CHANGED_ONLY
        place = np.arange(self.profile.n_codes)
        changed = np.isin(owner, range(n) if overrun else chosen)
        self.codes = np.where(changed, sample * self.profile.n_codes + place, self.codes)
        self.truth[sample], self.sent[sample] = self.codes, chosen
        if overrun:
            flags |= SummaryFlag.OVERRUN
        t, counter = sample * PERIOD, self.counter(sample)
        frames = []
        for chunk in chosen:
            data = payload(self.profile, chunk, counter, self.codes[owner == chunk].tolist())
            frames.append(Frame(data, t := t + PACE, False, sample))
        summary = self.summary(sample, flags, len(chosen))
        return [*frames, Frame(summary, t + PACE, True, sample)]

    def summary(self, sample: int, flags: int, chunks: int) -> bytes:
        """With the true number for a device time, or in steps of 64 µs, with a check, the true time."""
        counter = self.counter(sample)
        if not self.checked:
            return pack_summary(counter, flags, chunks, sample)
        head = struct.pack("<BBHH", counter, flags | 0x20, chunks, sample * STEPS_64US & 0xFFFF)
        check = check_of_scan(self.truth[sample], self.profile.code_bits, head)
        return head + struct.pack("<H", check)


def receive(
    assembler: ScanAssembler, frames: Iterable[Frame], *, polled: bool = True, until_ns: int = 0
) -> list[Scan]:
    """Feed frames; where ``polled``, poll when the assembler asks for it and after each frame."""
    published: list[Scan | None] = []

    def poll(t_ns: int) -> None:
        while polled and (deadline := assembler.next_deadline_ns()) is not None and deadline <= t_ns:
            before = assembler.stats
            published.append(assembler.poll(deadline))
            assert published[-1] is not None or thrown_away(assembler.stats) > thrown_away(before), "in vain"

    for frame in frames:
        poll(frame.t_ns)
        take = assembler.on_summary if frame.is_summary else assembler.on_chunk
        published.append(take(frame.data, frame.t_ns))
        poll(frame.t_ns)
    poll(until_ns)
    return [scan for scan in published if scan is not None]


def thrown_away(stats: AssemblerStats) -> int:
    return stats.scans_mixed + stats.scans_joined + stats.scans_corrupt


def origin(scan: Scan, node: ModelNode) -> int:
    """The true number of the scan that ``scan`` claims to be. Of the 16 bits of a device time, which are all
    that a node sends, it is told apart from the 32,768 scans next to it."""
    if scan.device_time_us is not None:
        if not node.checked:
            return scan.device_time_us
        low = scan.device_time_us // 64 & 0xFFFF
        (sample,) = (number for number in node.truth if number * STEPS_64US & 0xFFFF == low)
        return sample
    known = scan.codes[scan.codes != MISSING]
    return int(known.max()) // node.profile.n_codes


def assert_from_one_scan(scan: Scan, node: ModelNode) -> None:
    sample = origin(scan, node)
    truth = node.truth[sample].reshape(scan.codes.shape)
    known = scan.codes != MISSING
    np.testing.assert_array_equal(scan.codes[known], truth[known], err_msg=f"scan {sample} is mixed")
    np.testing.assert_array_equal(scan.valid, known)
    assert scan.counter == node.counter(sample)
    assert scan.chunks_received <= len(node.sent[sample])
    if scan.complete:
        assert scan.chunks_received == len(node.sent[sample])


def frames_counted(stats: AssemblerStats) -> int:
    return (
        stats.chunks_accepted
        + stats.summaries_accepted
        + stats.duplicates
        + stats.conflicts
        + stats.late
        + stats.bad_length
        + stats.bad_index
        + stats.bad_counter
        + stats.bad_form
    )


# --- any channel


@st.composite
def worlds(draw: st.DrawFn) -> tuple[ModelNode, list[Frame]]:
    """A node's frames as they arrive over a channel that loses, repeats, delays and is cut for long times.

    Frames are as old on arrival as the assembler's promise allows, and no older: see its module.
    """
    overflow = draw(st.sampled_from([2, 3, 5, 8, 240, 0]))
    counters = overflow or 256
    node = ModelNode(draw(st.sampled_from(PROFILES)), overflow, draw(st.booleans()))
    timeout = PERIOD * min(3, max(1, (counters - 1) // 2))
    duration = (node.profile.n_chunks + 1) * PACE
    longest = min(counters * PERIOD - timeout - duration, 40 * PERIOD) - 1
    delays = st.one_of(
        st.just(0),
        st.just(0),
        st.sampled_from([PACE, 3 * PACE, PERIOD, PERIOD + PACE, 2 * PERIOD, longest]),
        st.integers(0, longest),
    ).map(lambda delay: min(delay, longest))
    copies = st.one_of(st.just([0]), st.just([0]), st.lists(delays, max_size=3))
    gaps = st.sampled_from([1, 1, 1, 1, 2, counters // 2, counters - 1, counters, counters + 1, 2 * counters])
    chunks = st.none() | st.sets(st.integers(0, node.profile.n_chunks - 1))
    arrivals: list[Frame] = []
    sample = draw(st.integers(1, counters))
    for _ in range(draw(st.integers(1, 8))):
        changed = draw(chunks)
        clean = draw(st.booleans())
        overrun = (
            changed is not None and len(changed) < node.profile.n_chunks and draw(st.integers(0, 5)) == 0
        )
        for frame in node.scan(sample, changed, overrun=overrun):
            delays_ns = [0] if clean else draw(copies)
            arrivals += [dataclasses.replace(frame, t_ns=frame.t_ns + delay) for delay in delays_ns]
        gap = draw(gaps)
        for lost in range(sample + 1, min(sample + gap, sample + 2)):  # changes that nobody sees
            node.scan(lost)
        sample += gap
    arrivals.sort(key=lambda frame: frame.t_ns)
    return node, arrivals


def no_scan_is_ever_mixed_from_two(world: tuple[ModelNode, list[Frame]], polled: bool) -> None:
    node, frames = world
    assembler = ScanAssembler(
        node.profile, counter_overflow=node.counter_overflow, period_ns=PERIOD, grace_ns=GRACE
    )
    published = receive(
        assembler, frames, polled=polled, until_ns=frames[-1].t_ns + 4 * PERIOD if frames else 0
    )
    for scan in published:
        assert_from_one_scan(scan, node)
    numbers = [scan.scan for scan in published]
    assert numbers == sorted(set(numbers))
    counters = node.counter_overflow or 256
    assert all((scan.scan - scan.counter) % counters == 0 for scan in published)
    stats = assembler.stats
    assert frames_counted(stats) == len(frames)
    assert (stats.scans_complete, stats.scans_torn + stats.scans_unchecked) == (
        sum(scan.complete for scan in published),
        sum(not scan.complete for scan in published),
    )
    assert stats.scans_corrupt == stats.bad_form == 0
    if node.checked:
        assert all(
            scan.valid.all() for scan in published if scan.complete and scan.device_time_us is not None
        )
    else:
        assert stats.scans_unchecked == 0
    came: dict[int, list[int]] = {}
    for frame in frames:
        came.setdefault(frame.sample, []).append(frame.t_ns)
    assert stats.scans_mixed <= sum(max(times) - min(times) > 2 * PERIOD for times in came.values())


@pytest.mark.parametrize("examples", [50, pytest.param(250, marks=pytest.mark.long)])
def test_no_scan_is_ever_mixed_from_two(examples: int) -> None:
    check = given(world=worlds(), polled=st.booleans())(no_scan_is_ever_mixed_from_two)
    settings(deadline=None, max_examples=examples)(check)()


@st.composite
def falsified(draw: st.DrawFn) -> tuple[ModelNode, list[Frame]]:
    """Frames of a node with checks, in order, of which some are lost and some are not as they were sent: a
    chunk has another code, another counter or another index, a summary other flags, or other numbers."""
    node = ModelNode(draw(st.sampled_from(PROFILES)), draw(st.sampled_from([5, 240])), checked=True)
    n, head = node.profile.n_chunks, node.profile.chunk_head_bytes
    chunks = st.none() | st.sets(st.integers(0, n - 1))
    frames: list[Frame] = []
    for sample in range(3, 3 + draw(st.integers(1, 8))):
        *sent, summary = node.scan(sample, draw(chunks))
        for frame in sent:
            match draw(st.sampled_from(["", "", "", "", "lost", "code", "counter", "index"])):
                case "":
                    frames.append(frame)
                case "code":
                    at = head + draw(st.integers(0, node.profile.code_bits // 8 - 1))
                    frames.append(changed(frame, at, draw(st.integers(1, 255))))
                case "counter":
                    ahead = node.counter(sample + draw(st.sampled_from([-1, 1, 1, 2])))
                    frames.append(changed(frame, 1, frame.data[1] ^ ahead))
                case "index" if node.profile.bus == "classic":
                    frames.append(changed(frame, 0, frame.data[0] ^ draw(st.integers(0, n - 1))))
        match draw(st.sampled_from(["", "", "", "lost", "CHANGED_ONLY", "fewer", "any", "miscounted"])):
            case "":
                frames.append(summary)
            case "CHANGED_ONLY":
                frames.append(changed(summary, 1, summary.data[1] & 1 ^ 1))
            case "fewer":
                frames.append(changed(summary, 2, summary.data[2] ^ max(0, summary.data[2] - 1)))
            case "any":
                frames.append(changed(summary, draw(st.integers(1, 7)), draw(st.integers(1, 255))))
            case "miscounted":  # by the node itself, whose check is right for what it says
                fewer = max(0, summary.data[2] - 1)
                frames.append(dataclasses.replace(summary, data=node.summary(sample, 1, fewer)))
    return node, frames


def changed(frame: Frame, at: int, by: int) -> Frame:
    data = bytearray(frame.data)
    data[at] ^= by
    return dataclasses.replace(frame, data=bytes(data))


def nothing_false_is_ever_complete(world: tuple[ModelNode, list[Frame]]) -> None:
    node, frames = world
    assembler = ScanAssembler(
        node.profile, counter_overflow=node.counter_overflow, period_ns=PERIOD, grace_ns=GRACE
    )
    assembler.expect_check()
    end_ns = frames[-1].t_ns + 4 * PERIOD if frames else 0
    published = receive(assembler, frames, until_ns=end_ns)
    for scan in published:
        if not scan.complete:
            continue
        assert scan.valid.all()
        truth = node.truth[origin(scan, node)].reshape(scan.codes.shape)
        if (scan.codes != truth).any():  # one in 65,536: damage that turns the check as little as none does
            bits = node.profile.code_bits
            assert check_of_scan(scan.codes, bits, b"") == check_of_scan(truth, bits, b"")
    stats = assembler.stats
    assert frames_counted(stats) == len(frames)
    assert stats.scans_complete == sum(scan.complete for scan in published)
    assert stats.scans_torn + stats.scans_unchecked == sum(not scan.complete for scan in published)


@pytest.mark.parametrize("examples", [50, pytest.param(250, marks=pytest.mark.long)])
def test_nothing_false_is_ever_complete(examples: int) -> None:
    check = given(world=falsified())(nothing_false_is_ever_complete)
    settings(deadline=None, max_examples=examples)(check)()


# --- a channel in order: what must come out is known exactly


def arrivals_in_order(frames: Sequence[Frame], copies: Sequence[int]) -> Iterator[Frame]:
    for frame, count in zip(frames, copies, strict=True):
        yield from [frame] * count


@pytest.mark.long
@settings(deadline=None, max_examples=150)
@given(
    profile=st.sampled_from(PROFILES),
    overflow=st.sampled_from([5, 240, 0]),
    checked=st.booleans(),
    data=st.data(),
)
def test_counters_are_exact_when_frames_are_only_lost_and_repeated(
    profile: PatchProfile, overflow: int, checked: bool, data: st.DataObject
) -> None:
    node = ModelNode(profile, overflow, checked)
    n = profile.n_chunks
    assembler = ScanAssembler(profile, counter_overflow=overflow, period_ns=PERIOD, grace_ns=GRACE)
    if checked:
        assembler.expect_check()
    fates = data.draw(  # of each scan: how often each of its frames arrives, the summary last
        st.lists(st.lists(st.sampled_from([1, 1, 1, 1, 0, 2]), min_size=n + 1, max_size=n + 1), min_size=1)
    )
    first = data.draw(st.integers(1, 300))
    frames: list[Frame] = []
    seen: list[tuple[int, list[int]]] = []
    for sample, copies in enumerate(fates, first):
        if seen and sample - seen[-1][0] > 2 and not any(copies):
            copies = [1] * (n + 1)  # so that a gap stays below half of five and below the timeout
        frames += arrivals_in_order(node.scan(sample), copies)
        if any(copies):
            seen.append((sample, copies))
    published = receive(assembler, frames, until_ns=(first + len(fates) + 4) * PERIOD)
    expected = dict(seen)
    assert [origin(scan, node) for scan in published] == [sample for sample, _ in seen]
    for scan in published:
        copies = expected[origin(scan, node)]
        assert_from_one_scan(scan, node)
        arrived = [count > 0 for count in copies[:n]]
        assert scan.complete == all(copies if checked else arrived)
        assert (scan.chunks_received, scan.chunks_expected) == (sum(arrived), n)
        assert (scan.device_time_us is None) == (copies[n] == 0)
        shown = np.array(arrived)[owners(profile)]
        np.testing.assert_array_equal(scan.valid.ravel(), shown)
    stats = assembler.stats
    assert stats == AssemblerStats(
        scans_complete=sum(all(copies if checked else copies[:n]) for _, copies in seen),
        scans_torn=sum(not all(copies[:n]) for _, copies in seen),
        scans_unchecked=sum(checked and all(copies[:n]) and not copies[n] for _, copies in seen),
        scans_missed=seen[-1][0] - seen[0][0] + 1 - len(seen) if seen else 0,
        scans_discarded=0,
        scans_mixed=0,
        scans_corrupt=0,
        scans_joined=0,
        chunks_accepted=sum(min(count, 1) for _, copies in seen for count in copies[:n]),
        summaries_accepted=sum(min(copies[n], 1) for _, copies in seen),
        chunks_lost=sum(count == 0 for _, copies in seen for count in copies[:n]),
        summaries_lost=sum(copies[n] == 0 for _, copies in seen),
        duplicates=sum(max(count - 1, 0) for _, copies in seen for count in copies),
        conflicts=0,
        late=0,
        bad_length=0,
        bad_index=0,
        bad_counter=0,
        bad_form=0,
        resyncs=0,
    )


@pytest.mark.long
@settings(deadline=None, max_examples=100)
@given(
    profile=st.sampled_from(PROFILES),
    changes=st.lists(st.sets(st.integers(0, 3)), min_size=1, max_size=20),
    order=st.randoms(use_true_random=False),
)
def test_unsent_chunks_keep_their_codes_in_an_unbroken_stream(
    profile: PatchProfile, changes: list[set[int]], order: object
) -> None:
    """Frames of a scan may come in any order, the summary among them."""
    node = ModelNode(profile, 240)
    assembler = ScanAssembler(profile, counter_overflow=240, period_ns=PERIOD, grace_ns=GRACE)
    frames = node.scan(230)
    for sample, chunks in enumerate(changes, 231):
        sent = node.scan(sample, chunks)
        times = [frame.t_ns for frame in sent]
        order.shuffle(sent)  # type: ignore[attr-defined]  # hypothesis hands out a random.Random
        frames += [dataclasses.replace(frame, t_ns=t) for frame, t in zip(sent, times, strict=True)]
    published = receive(assembler, frames)
    assert len(published) == len(changes) + 1
    for scan in published:
        assert_from_one_scan(scan, node)
        assert scan.complete
        assert scan.valid.all()


# --- single cases


@pytest.fixture
def node() -> ModelNode:
    return ModelNode(PROFILES[0], 240)


@pytest.fixture
def assembler() -> ScanAssembler:
    return ScanAssembler(PROFILES[0], counter_overflow=240, period_ns=PERIOD, grace_ns=GRACE)


def test_a_scan_is_published_with_its_last_frame(node: ModelNode, assembler: ScanAssembler) -> None:
    frames = node.scan(7)
    assert receive(assembler, frames[:-1], polled=False) == []
    (scan,) = receive(assembler, frames[-1:], polled=False)
    assert scan.complete
    assert (scan.scan, scan.counter, scan.device_time_us, scan.flags) == (7, 7, 7, 0)
    assert (scan.t_first_ns, scan.t_last_ns) == (frames[0].t_ns, frames[-1].t_ns)
    assert scan.codes.dtype == np.uint32
    assert not scan.codes.flags.writeable
    assert not scan.valid.flags.writeable
    assert assembler.next_deadline_ns() is None


def test_the_summary_may_come_before_the_last_chunk(node: ModelNode, assembler: ScanAssembler) -> None:
    *chunks, summary = node.scan(7)
    (scan,) = receive(assembler, [*chunks[:-1], summary, chunks[-1]], polled=False)
    assert scan.complete


def test_reserved_codes_arrive_and_are_not_valid() -> None:
    profile = PatchProfile(1, 4, 1, 1, 16)
    assembler = ScanAssembler(profile)
    assembler.on_chunk(pack_chunk(0, 9, [65535, 65534, 65533]), 1)
    assembler.on_chunk(pack_chunk(1, 9, [65532]), 2)
    scan = assembler.on_summary(pack_summary(9, 0, 2, 0), 3)
    assert scan is not None
    assert scan.codes.tolist() == [[65535, 65534, 65533, 65532]]
    assert scan.valid.tolist() == [[False, False, False, True]]


def test_missing_chunks_are_waited_for_during_the_grace_after_the_summary(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    *chunks, summary = node.scan(7)
    assert receive(assembler, [*chunks[1:], summary]) == []
    assert assembler.next_deadline_ns() == summary.t_ns + GRACE
    assert assembler.poll(summary.t_ns + GRACE - 1) is None
    scan = assembler.poll(summary.t_ns + GRACE)
    assert scan is not None
    assert not scan.complete
    assert scan.valid.ravel().tolist() == [False] * 3 + [True] * 7
    assert (scan.codes.ravel()[:3] == MISSING).all()
    assert assembler.on_chunk(chunks[0].data, summary.t_ns + GRACE + 1) is None
    assert (assembler.stats.chunks_lost, assembler.stats.late) == (1, 1)


def test_a_lost_summary_costs_the_grace_and_the_device_time_but_no_scan(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    *chunks, _ = node.scan(7)
    assert receive(assembler, chunks) == []
    scan = assembler.poll(chunks[-1].t_ns + GRACE)
    assert scan is not None
    assert scan.complete
    assert scan.device_time_us is None


def test_frames_of_an_older_scan_are_dropped(node: ModelNode, assembler: ScanAssembler) -> None:
    older, newer = node.scan(7), node.scan(8)
    at = newer[0].t_ns
    mixed_up = [*older[:2], newer[0], *(dataclasses.replace(f, t_ns=at) for f in older[2:]), *newer[1:]]
    torn, whole = receive(assembler, mixed_up)
    assert (torn.scan, torn.complete, torn.chunks_received) == (7, False, 2)
    assert (whole.scan, whole.complete) == (8, True)
    assert assembler.stats.late == len(older) - 2


@pytest.mark.parametrize("first_of_the_other", [3, 4], ids=["chunk", "summary"])
def test_a_scan_one_counter_range_later_is_another_scan(
    node: ModelNode, assembler: ScanAssembler, first_of_the_other: int
) -> None:
    half, other = node.scan(7)[:2], node.scan(7 + 240)[first_of_the_other:]
    first, second = receive(assembler, [*half, *other], polled=False) + receive(
        assembler, [], until_ns=248 * PERIOD
    )
    assert (first.scan, first.chunks_received) == (7, 2)
    assert (second.scan, second.chunks_received) == (247, 4 - first_of_the_other)
    assert (second.counter, second.device_time_us) == (7, 247)


@pytest.mark.parametrize(
    ("overflow", "ahead", "is_newer"),
    [(5, 2, True), (5, 3, False), (240, 120, True), (240, 121, False), (0, 128, True), (0, 129, False)],
)
def test_half_the_counter_range_ahead_is_newer_and_the_rest_late(
    overflow: int, ahead: int, is_newer: bool
) -> None:
    node = ModelNode(PROFILES[0], overflow)
    assembler = ScanAssembler(PROFILES[0], counter_overflow=overflow, period_ns=PERIOD)
    first, last = node.scan(3), node.scan(3 + ahead)
    receive(assembler, first)
    published = receive(assembler, [dataclasses.replace(f, t_ns=first[-1].t_ns + 1) for f in last])
    assert len(published) == is_newer
    assert assembler.stats.late == (0 if is_newer else len(last))
    assert assembler.stats.scans_missed == (ahead - 1 if is_newer else 0)


@pytest.mark.parametrize(
    ("overflow", "periods"), [(2, 1), (3, 1), (4, 1), (5, 2), (6, 2), (7, 3), (8, 3), (240, 3), (0, 3)]
)
def test_a_scan_is_waited_for_no_longer_than_its_counter_tells_it_apart(overflow: int, periods: int) -> None:
    """At most three periods, and less than half the counter's range: a later frame may be of another scan."""
    node = ModelNode(PROFILES[0], overflow)
    assembler = ScanAssembler(PROFILES[0], counter_overflow=overflow, period_ns=PERIOD)
    first = node.scan(7)[0]
    receive(assembler, [first])
    assert assembler.next_deadline_ns() == first.t_ns + periods * PERIOD


def test_a_scan_that_stops_half_way_is_published_at_the_timeout(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    frames = node.scan(7)[:2]
    assert receive(assembler, frames) == []
    assert assembler.next_deadline_ns() == frames[0].t_ns + 3 * PERIOD
    (scan,) = receive(assembler, [], until_ns=frames[0].t_ns + 3 * PERIOD)
    assert (scan.complete, scan.chunks_received) == (False, 2)


def test_two_scans_that_end_in_one_call_both_come_out(node: ModelNode, assembler: ScanAssembler) -> None:
    """A torn scan is ended by the summary of a scan without changes, which is complete by itself."""
    full, torn, unchanged = node.scan(7), node.scan(8)[:1], node.scan(9, [])
    receive(assembler, full)
    receive(assembler, torn)
    first = assembler.on_summary(unchanged[0].data, unchanged[0].t_ns)
    second = assembler.poll(unchanged[0].t_ns)
    assert first is not None
    assert second is not None
    assert (first.scan, first.complete) == (8, False)
    assert (second.scan, second.complete) == (9, True)
    assert not second.valid[0, 4], "what scan 8 may have changed unseen is not known"
    assert second.valid.ravel()[:3].all()


def test_an_unchanged_scan_repeats_the_last_codes(node: ModelNode, assembler: ScanAssembler) -> None:
    published = receive(assembler, [*node.scan(7), *node.scan(8, []), *node.scan(9, [1])])
    assert [scan.valid.all() for scan in published] == [True, True, True]
    np.testing.assert_array_equal(published[1].codes, published[0].codes)
    assert (published[2].codes != published[1].codes).ravel().tolist() == [False] * 3 + [True] * 3 + [
        False
    ] * 4


@pytest.mark.parametrize("what", ["missed", "torn", "overrun", "summary lost", "silence of all counters"])
def test_after_a_break_only_what_is_sent_again_is_valid(
    node: ModelNode, assembler: ScanAssembler, what: str
) -> None:
    receive(assembler, node.scan(7))
    after = 9
    match what:
        case "missed":
            node.scan(8)
        case "torn":
            receive(assembler, node.scan(8, [0, 1])[1:])
        case "overrun":
            receive(assembler, node.scan(8, [0, 1], overrun=True))
        case "summary lost":
            receive(assembler, node.scan(8, [0, 1])[:-1])
        case _:
            after = 7 + 241  # the counter goes on as if nothing had been
            node.scan(after - 1)
    *_, scan = receive(assembler, node.scan(after, [3]), until_ns=(after + 1) * PERIOD)
    assert scan.complete
    assert_from_one_scan(scan, node)
    assert scan.valid.ravel()[9]
    assert not scan.valid.ravel()[6:9].any()
    (healed,) = receive(assembler, node.scan(after + 1))
    assert healed.valid.all()


def test_chunks_are_not_called_lost_where_nobody_knows_how_many_were_sent(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    receive(assembler, [*node.scan(7), *node.scan(8, [1])])
    (scan,) = receive(assembler, node.scan(9, [1, 2])[:1], until_ns=13 * PERIOD)
    assert not scan.complete
    assert (assembler.stats.chunks_lost, assembler.stats.summaries_lost) == (0, 1)


def test_an_overrun_full_scan_is_torn_although_all_it_sent_arrived(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    *chunks, _ = node.scan(7)
    for frame in chunks[:2]:
        assembler.on_chunk(frame.data, frame.t_ns)
    scan = assembler.on_summary(pack_summary(7, SummaryFlag.OVERRUN, 2, 0), chunks[1].t_ns + 1)
    assert scan is not None
    assert not scan.complete
    assert scan.valid.ravel().tolist() == [True] * 6 + [False] * 4
    assert assembler.stats.chunks_lost == 0


@pytest.mark.parametrize("twice", ["chunk", "summary"])
def test_scan_with_frames_that_contradict_each_other_is_thrown_away(
    node: ModelNode, assembler: ScanAssembler, twice: str
) -> None:
    """Two scans, or two nodes, under one counter: nobody knows whose the other chunks are."""
    *chunks, summary = node.scan(7)
    receive(assembler, chunks[:-1])
    for k in range(2):
        if twice == "chunk":
            assembler.on_chunk(pack_chunk(2, 7, [1, 2, 3]), chunks[-1].t_ns)
        else:
            assembler.on_summary(pack_summary(7, SummaryFlag(0), 4, k), chunks[-1].t_ns)
    assert receive(assembler, [chunks[-1], summary], until_ns=summary.t_ns + GRACE) == []
    stats = assembler.stats
    assert stats.conflicts == (2 if twice == "chunk" else 1)  # the third summary comes after the end
    assert (stats.duplicates, stats.scans_mixed) == (0, 1)
    assert (stats.scans_complete, stats.scans_torn, stats.chunks_lost) == (0, 0, 0)
    assert frames_counted(stats) == 7
    (healed,) = receive(assembler, node.scan(8))
    assert healed.complete
    assert healed.valid.all()


def test_nothing_is_kept_of_a_scan_thrown_away(node: ModelNode, assembler: ScanAssembler) -> None:
    """Where only changed chunks are sent, the next scan knows those alone."""
    receive(assembler, node.scan(7))
    *chunks, summary = node.scan(8, [1])
    assembler.on_chunk(pack_chunk(1, 8, [1, 2, 3]), chunks[0].t_ns - 1)
    assert receive(assembler, [*chunks, summary], until_ns=summary.t_ns + GRACE) == []
    (scan,) = receive(assembler, node.scan(9, [0]))
    assert scan.valid.ravel().tolist() == [True] * 3 + [False] * 7


@pytest.mark.parametrize(
    ("restart", "counter"), [("node or SYNC", 1), ("a little back", 195), ("the same", 200)]
)
def test_a_stream_that_starts_anew_is_followed_after_the_timeout(
    node: ModelNode, assembler: ScanAssembler, restart: str, counter: int
) -> None:
    receive(assembler, node.scan(200))
    silence = 4 * PERIOD
    shift = (200 - counter) * PERIOD + silence
    frames = [
        dataclasses.replace(f, t_ns=f.t_ns + shift) for f in [*node.scan(counter), *node.scan(counter + 1)]
    ]
    published = receive(assembler, frames)
    assert [scan.counter for scan in published] == [counter, counter + 1]
    assert all(scan.complete and scan.valid.all() for scan in published)
    assert published[0].scan > 200
    assert published[1].scan == published[0].scan + 1
    assert assembler.stats.resyncs == (counter != 1)  # 1 is 41 ahead of 200: believed to be that many lost


def test_a_stream_that_starts_anew_at_once_is_followed_within_the_timeout(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    receive(assembler, node.scan(100))
    frames = [
        dataclasses.replace(frame, t_ns=frame.t_ns + 100 * PERIOD)
        for sample in range(1, 9)
        for frame in node.scan(sample)
    ]
    published = receive(assembler, frames)
    assert [scan.counter for scan in published][-5:] == [4, 5, 6, 7, 8]
    assert published[-1].valid.all()
    assert assembler.stats.late > 0


def test_after_a_reset_nothing_is_remembered(node: ModelNode, assembler: ScanAssembler) -> None:
    receive(assembler, node.scan(7))
    receive(assembler, node.scan(8)[:2])
    assembler.reset()
    assert assembler.next_deadline_ns() is None
    again = [dataclasses.replace(frame, t_ns=10 * PERIOD) for frame in node.scan(3, [0])]
    (scan,) = receive(assembler, again)
    assert scan.counter == 3
    assert scan.scan > 8
    assert scan.valid.ravel().tolist() == [True] * 3 + [False] * 7
    assert assembler.stats.scans_discarded == 1
    assert frames_counted(assembler.stats) == 5 + 2 + 2


def test_frames_that_are_not_of_this_patch_are_counted_and_change_nothing(
    node: ModelNode, assembler: ScanAssembler
) -> None:
    *chunks, summary = node.scan(7)
    receive(assembler, chunks)
    t = summary.t_ns
    assert assembler.on_chunk(pack_chunk(4, 7, [1]), t) is None  # chunks are 0 … 3
    assert assembler.on_chunk(pack_chunk(255, 8, [1]), t) is None
    assert assembler.on_summary(pack_summary(8, 0, 5, 0), t) is None
    assert assembler.on_chunk(pack_chunk(0, 0, [1]), t) is None  # counters are 1 … 240
    assert assembler.on_chunk(pack_chunk(0, 241, [1]), t) is None
    assert assembler.on_summary(pack_summary(255, 0, 4, 0), t) is None
    (scan,) = receive(assembler, [summary])
    assert scan.complete
    assert (assembler.stats.bad_index, assembler.stats.bad_counter) == (3, 3)


@pytest.mark.parametrize(
    ("wire", "column"),
    [(2, 0), (255, 0), (0, 1), (0, 10), (0, 21), (1, 22), (0, 65535)],  # 2 wires, columns from 0 and 11 on
)
def test_parts_of_wires_that_the_patch_does_not_have(wire: int, column: int) -> None:
    node = ModelNode(PROFILES[2], 240)
    assembler = ScanAssembler(PROFILES[2], counter_overflow=240, period_ns=PERIOD)
    *chunks, summary = node.scan(7)
    for counter in (7, 8):
        receive(assembler, chunks[: 2 if counter == 7 else 0])
        bad = struct.pack("<BBH", wire, counter, column).ljust(48, b"\1")
        assert assembler.on_chunk(bad, chunks[-1].t_ns) is None
    assert assembler.stats.bad_index == 2
    (scan,) = receive(assembler, [*chunks[2:], summary])
    assert scan.complete
    assert_from_one_scan(scan, node)


def test_a_fd_chunk_of_another_length_is_rejected_and_reported() -> None:
    told: list[CodecError] = []
    assembler = ScanAssembler(PROFILES[2], node_id=5, on_reject=told.append)
    for length in (0, 3, 8, 44, 64):
        assert assembler.on_chunk(bytes(length), 0) is None
    assert assembler.stats.bad_length == len(told) == 5
    assert str(told[2]).endswith("allowed: 48 bytes (chunk)")


def test_frames_of_the_wrong_length_are_rejected_and_reported() -> None:
    told: list[CodecError] = []
    assembler = ScanAssembler(PROFILES[0], node_id=5, on_reject=told.append)
    assert assembler.on_chunk(bytes(7), 0) is None
    assert assembler.on_chunk(b"", 0) is None
    assert assembler.on_summary(bytes(64), 0) is None
    assert assembler.stats.bad_length == 3
    assert [error.cob_id for error in told] == [0x185, 0x185, 0x285]
    assert str(told[0]) == "COB-ID 0x185: got 7 bytes (00 00 00 00 00 00 00), allowed: 8 bytes (chunk)"


@pytest.mark.parametrize(
    "arguments",
    [
        {"counter_overflow": -5},
        {"counter_overflow": 1},
        {"counter_overflow": 241},
        {"period_ns": 0},
        {"grace_ns": -1},
    ],
)
def test_settings_that_cannot_be_are_refused(arguments: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="allowed"):
        ScanAssembler(PROFILES[0], **arguments)  # type: ignore[arg-type]  # ints by name


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("changed", [False, True])
def test_a_scan_that_was_under_way_when_the_stream_was_taken_up_is_not_torn(
    profile: PatchProfile, changed: bool
) -> None:
    chunks = range(profile.n_chunks) if changed else None
    for first in range(1, profile.n_chunks + 1):
        node, assembler = (
            ModelNode(profile, 240),
            ScanAssembler(profile, counter_overflow=240, under_way=True),
        )
        frames = [*node.scan(1, chunks)[first:], *node.scan(2)]
        assert [origin(scan, node) for scan in receive(assembler, frames)] == [2]
        stats = assembler.stats
        assert (stats.scans_joined, stats.scans_complete, stats.scans_torn) == (1, 1, 0)
        assert (stats.chunks_lost, stats.summaries_lost, stats.scans_missed) == (0, 0, 0)
        assert stats.chunks_accepted + stats.summaries_accepted == len(frames)
        assembler.reset(under_way=True)
        receive(assembler, [*node.scan(7)[first:], *node.scan(8)])
        assert (assembler.stats.scans_joined, assembler.stats.scans_torn) == (2, 0)


def test_a_scan_that_was_heard_from_its_first_chunk_on_lacks_what_was_lost() -> None:
    profile = PROFILES[0]
    for under_way in (True, False):
        node = ModelNode(profile, 240)
        assembler = ScanAssembler(profile, counter_overflow=240, under_way=under_way)
        frames = node.scan(1)
        (scan,) = receive(assembler, [*frames[:2], *frames[3:], *node.scan(2)])[:1]
        assert (scan.complete, scan.chunks_received) == (False, profile.n_chunks - 1)
        assert (assembler.stats.scans_torn, assembler.stats.scans_joined) == (1, 0)
    assembler = ScanAssembler(profile, counter_overflow=240)  # begun by whoever listens: nothing came before
    receive(assembler, [*frames[1:], *node.scan(2)])
    assert (assembler.stats.scans_torn, assembler.stats.scans_joined) == (1, 0)
