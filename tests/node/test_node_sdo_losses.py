"""Block transfer over a channel that loses segments and delivers some twice: whole, or an abort."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterator
from itertools import chain, repeat

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.canopen.dictionary import DataType, Entry, Object, ObjectType
from skinnode.errors import BusError
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.sdo.server import SdoServer

INDEX = 0x2301
START_NS = 10**9
MOST_FRAMES = 20_000

# How often a segment is delivered, from the first on; afterwards once each.
fates = st.lists(st.sampled_from([1, 1, 1, 0, 2]), max_size=400)
values = st.integers(0, 1200).flatmap(lambda size: st.binary(min_size=size, max_size=size))
block_sizes = st.lists(st.integers(1, 127), min_size=1, max_size=8)


class Bench:
    """A server of one DOMAIN, and the time."""

    def __init__(self, value: bytes = b"", length: int = 0) -> None:
        declared = Entry(INDEX, 0, "value", DataType.DOMAIN, "rw")
        store = ObjectStore([Object(INDEX, "value", ObjectType.DOMAIN, (declared,))], 4)
        self.written: list[bytes] = []
        store.bind_domain(INDEX, length or len(value), lambda _: value, self.written.append)
        self.server = SdoServer(store, self._send)
        self.answers: list[bytes] = []
        self.t_ns = START_NS
        self.busy = False

    def _send(self, answer: bytes) -> None:
        if self.busy:
            raise BusError("no buffer space")
        assert len(answer) == 8
        self.answers.append(answer)

    def ask(self, request: bytes) -> list[bytes]:
        self.server.on_request(request.ljust(8, b"\0"), self.t_ns)
        return self.take()

    def take(self) -> list[bytes]:
        taken, self.answers = self.answers, []
        return taken

    def wait(self) -> list[bytes]:
        """Until the server does something by itself."""
        assert self.server.deadline_ns < NO_DEADLINE_NS
        self.t_ns = max(self.t_ns, self.server.deadline_ns)
        self.server.on_timer(self.t_ns)
        return self.take()


def upload(bench: Bench, sizes: list[int], fate: Iterator[int]) -> bytes:
    """As a client by the book: it acknowledges at the end of a block, or when no more comes for a while."""
    sizes_left = chain(sizes, repeat(sizes[-1]))
    size = next(sizes_left)
    (first,) = bench.ask(struct.pack("<BHBB", 0xA4, INDEX, 0, size))
    assert first[0] == 0xC6
    announced = int.from_bytes(first[4:], "little")
    value, good, last = b"", 0, False
    waiting = bench.ask(b"\xa3")
    for _ in range(MOST_FRAMES):
        silent_ns = bench.t_ns + 100_000_000
        while not waiting and bench.server.deadline_ns < silent_ns:
            waiting = bench.wait()
        ended = not waiting
        for segment in chain.from_iterable(repeat(frame, next(fate)) for frame in waiting):
            number = segment[0] & 0x7F
            assert 1 <= number <= size
            if number == good + 1:
                good, last = number, bool(segment[0] & 0x80)
                value += segment[1:]
            ended = ended or number == size or bool(segment[0] & 0x80)
        waiting = []
        if ended:
            acknowledged, size, good = good, next(sizes_left), 0
            waiting = bench.ask(bytes((0xA2, acknowledged, size)))
        if ended and last:
            break
    ((command, crc),) = (struct.unpack("<BH5x", frame) for frame in waiting)
    assert command & 0xE3 == 0xC1
    assert bench.ask(b"\xa1") == []
    value = value[: len(value) - (command >> 2 & 7)]
    assert len(value) == announced
    assert crc == binascii.crc_hqx(value, 0)
    return value


@settings(deadline=None, max_examples=200)
@given(values, block_sizes, fates)
def test_upload_arrives_whole(value: bytes, sizes: list[int], fate: list[int]) -> None:
    bench = Bench(value)
    assert upload(bench, sizes, chain(fate, repeat(1))) == value
    assert bench.server.deadline_ns == NO_DEADLINE_NS


@pytest.mark.long
@settings(deadline=None, max_examples=200)
@given(values, block_sizes, st.lists(st.booleans(), max_size=100))
def test_upload_gets_over_a_queue_that_is_full(value: bytes, sizes: list[int], busy: list[bool]) -> None:
    """The interface refuses some frames; the server sends them again, later."""

    class Busy(Bench):
        tries = chain(busy, repeat(False))

        def wait(self) -> list[bytes]:
            self.busy = next(self.tries)
            try:
                return super().wait()
            except BusError:
                return []
            finally:
                self.busy = False

    assert upload(Busy(value), sizes, repeat(1)) == value


@pytest.mark.parametrize(
    ("bitrate_bps", "refused", "block_ms"),
    [(1_000_000, 0, 80), (500_000, 0, 80), (250_000, 0, 80), (125_000, 1, 130)],
)
def test_upload_into_the_queue_of_a_real_interface(bitrate_bps: int, refused: int, block_ms: int) -> None:
    """Ten frames wait for the wire, an eleventh is refused. The thread wakes 2 ms late, and rests for 20 ms
    after a frame was refused, as the runner does."""
    frame_ns = 135 * 1_000_000_000 // bitrate_bps  # eight bytes, as many stuff bits as there can be

    class Queued(Bench):
        def _send(self, answer: bytes) -> None:
            leaves_ns[:] = [left for left in leaves_ns if left > self.t_ns]
            self.busy = len(leaves_ns) > 10  # one is on the wire
            if self.busy:
                refusals.append(self.t_ns)
            super()._send(answer)
            leaves_ns.append(max([self.t_ns, *leaves_ns]) + frame_ns)

        def wait(self) -> list[bytes]:
            self.t_ns = max(self.t_ns, self.server.deadline_ns) + 2_000_000
            try:
                return super().wait()
            except BusError:
                self.t_ns += 20_000_000
                return self.take()

    leaves_ns: list[int] = []  # when each of the frames that wait will have left
    refusals: list[int] = []
    bench = Queued(bytes(range(256)) * 3)
    assert upload(bench, [127], repeat(1)) == bytes(range(256)) * 3
    assert len(refusals) <= refused
    assert bench.t_ns - START_NS <= block_ms * 1_000_000


def download(bench: Bench, value: bytes, announce: bool, fate: Iterator[int], spare_first: bool) -> bytes:
    """The last answer of the server: the end of the transfer, or an abort."""
    head = struct.pack("<BHBI", 0xC4 | announce << 1, INDEX, 0, len(value) if announce else 0)
    (first,) = bench.ask(head)
    assert first[0] == 0xA4
    parts = [value[at : at + 7] for at in range(0, len(value), 7)] or [b""]
    at, size = 0, first[4]
    for _ in range(MOST_FRAMES):
        if at == len(parts):
            end = struct.pack("<BH5x", 0xC1 | (7 * len(parts) - len(value)) << 2, binascii.crc_hqx(value, 0))
            (last,) = bench.ask(end)
            return last
        block, answers = parts[at : at + size], []
        for number, part in enumerate(block, 1):
            final = at + number == len(parts)
            times = next(fate)
            if spare_first and number in (1, len(block)):
                times = max(1, times)
            for _ in range(times):
                answers += bench.ask(bytes((number | final << 7,)) + part.ljust(7, b"\0"))
        (answer,) = answers or bench.wait()
        if answer[0] == 0x80:
            return answer
        assert answer[0] == 0xA2
        at, size = at + answer[1], answer[2]
    raise AssertionError("no end")


@pytest.mark.long
@settings(deadline=None, max_examples=200)
@given(values, st.booleans(), fates)
def test_download_arrives_whole_or_is_aborted(value: bytes, announce: bool, fate: list[int]) -> None:
    bench = Bench(length=len(value))
    answer = download(bench, value, announce, chain(fate, repeat(1)), spare_first=False)
    if answer[0] == 0x80:
        assert bench.written == []
        assert answer == struct.pack("<BHBI", 0x80, INDEX, 0, 0x05040000)
    else:
        assert answer[0] == 0xA1
        assert bench.written == [value]
    assert bench.server.deadline_ns == NO_DEADLINE_NS


@pytest.mark.long
@settings(deadline=None, max_examples=200)
@given(values, st.booleans(), fates)
def test_download_arrives_whole_if_blocks_reach_their_ends(
    value: bytes, announce: bool, fate: list[int]
) -> None:
    bench = Bench(length=len(value))
    assert download(bench, value, announce, chain(fate, repeat(1)), spare_first=True)[0] == 0xA1
    assert bench.written == [value]


@pytest.mark.long
@settings(deadline=None, max_examples=200)
@given(values, st.integers(-20, 20), st.booleans(), st.booleans())
def test_download_of_another_length_is_refused(
    value: bytes, difference: int, announce: bool, crc: bool
) -> None:
    length = max(0, len(value) + difference)
    bench = Bench(length=length)
    head = struct.pack("<BHBI", 0xC0 | crc << 2 | announce << 1, INDEX, 0, len(value) if announce else 0)
    answer = bench.ask(head)[0]
    parts = [value[at : at + 7] for at in range(0, len(value), 7)] or [b""]
    for at, part in enumerate(parts):
        if answer[0] == 0x80:
            break
        number = at % 127 + 1 | (at + 1 == len(parts)) << 7
        answer = (bench.ask(bytes((number,)) + part.ljust(7, b"\0")) or [answer])[-1]
    if answer[0] != 0x80:
        end = struct.pack("<BH5x", 0xC1 | (-len(value) % 7) << 2, binascii.crc_hqx(value, 0))
        (answer,) = bench.ask(end if value else b"\xdd")
    if len(value) == length:
        assert answer[0] == 0xA1
        assert bench.written == [value]
    else:
        code = 0x06070012 if len(value) > length else 0x06070013
        assert answer == struct.pack("<BHBI", 0x80, INDEX, 0, code)
        assert bench.written == []
