"""SDO transfers of the host over a channel that loses frames, to the SDO server of a real node: each transfer
is done in the end, or its failure is one NodeError; the value is never a wrong one."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import NamedTuple

import pytest
from canopen.sdo.client import SdoClient
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.canopen.dictionary import DataType, Entry, Object, ObjectType
from skinnode.errors import NodeError
from skinnode.host import sdo_streams
from skinnode.host.sdo_client import RemoteOd, SkinNetwork
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.sdo.server import SdoServer

DOMAIN, NUMBER = 0x2301, 0x1017
LONG = bytes(i * 7 % 251 for i in range(1000))  # two blocks of at most 127 segments
OTHER = bytes(reversed(LONG))


class Frame(NamedTuple):
    """A frame of a transfer: whose it is and what it says."""

    sender: str
    command: int
    number: int
    """Among the frames of that sender and command, from 0."""


class Line:
    """A client and a server. ``is_lost`` decides about each frame; time passes as frames do."""

    def __init__(self, is_lost: Callable[[Frame], bool]) -> None:
        self.is_lost = is_lost
        self.value, self.seen = LONG, list[Frame]()
        number = Entry(NUMBER, 0, "number", DataType.UNSIGNED16, "rw", default=250)
        domain = Entry(DOMAIN, 0, "value", DataType.DOMAIN, "rw")
        store = ObjectStore(
            [
                Object(NUMBER, "number", ObjectType.VAR, (number,)),
                Object(DOMAIN, "value", ObjectType.DOMAIN, (domain,)),
            ],
            5,
        )
        store.bind_domain(DOMAIN, len(LONG), lambda _: self.value, self._on_written)
        self.server = SdoServer(store, lambda data: self._answer(data))
        self.network = SkinNetwork(self._request)
        self.t_ns = 10**9
        self.remote = RemoteOd(self.network, 5)

    def _on_written(self, data: bytes) -> None:
        self.value = bytes(data)

    def _passes(self, sender: str, data: bytes) -> bool:
        same = sum(frame[:2] == (sender, data[0]) for frame in self.seen)
        frame = Frame(sender, data[0], same)
        self.seen.append(frame)
        return not self.is_lost(frame)

    def _answer(self, data: bytes) -> None:
        if self._passes("node", data):
            self.network.notify(0x585, bytearray(data), 0.0)

    def _request(self, can_id: int, data: bytes) -> None:
        self.t_ns += 1_000_000
        if self._passes("host", data):
            self.server.on_request(data, self.t_ns)
        while self.server.deadline_ns < self.t_ns + 100_000_000:  # the segments of a block
            self.t_ns = max(self.t_ns, self.server.deadline_ns)
            self.server.on_timer(self.t_ns)


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers come at once, or never."""
    monkeypatch.setattr(SdoClient, "RESPONSE_TIMEOUT", 0.004)
    monkeypatch.setattr(sdo_streams, "_QUIET_S", 0.001)


def block_read(line: Line) -> None:
    assert line.remote.read_block(DOMAIN) == LONG


def segmented_read(line: Line) -> None:
    assert line.remote.read_bytes(DOMAIN, 0) == LONG


def read(line: Line) -> None:
    assert line.remote.read(NUMBER, 0, "u16") == 250


def block_write(line: Line) -> None:
    line.remote.write_block(DOMAIN, OTHER)
    assert line.value == OTHER


def segmented_write(line: Line) -> None:
    line.remote.write_bytes(DOMAIN, 0, OTHER)
    assert line.value == OTHER


def write(line: Line) -> None:
    line.remote.write_checked(NUMBER, 0, "u16", 250)


TRANSFERS = [block_read, segmented_read, read, block_write, segmented_write, write]


def kinds(transfer: Callable[[Line], None]) -> list[Frame]:
    """Every frame of a transfer in which none is lost; of a long one the first two, and the last two, of a
    command."""
    line = Line(lambda frame: False)
    transfer(line)
    of_kind: dict[tuple[str, int], list[Frame]] = {}
    for frame in line.seen:
        of_kind.setdefault((frame.sender, frame.command), []).append(frame)
    chosen: list[Frame] = []
    for frames in of_kind.values():
        chosen += dict.fromkeys(frames[:2] + frames[-2:])
    if transfer in (block_read, block_write):  # segments are numbered: each has a command of its own
        segments = [
            frame for frame in chosen if frame.command & 0x7F in range(3, 125) and frame.command < 0x80
        ]
        chosen = [frame for frame in chosen if frame not in segments[::1] or frame.command % 40 == 0]
    return chosen


CASES = [(transfer, frame) for transfer in TRANSFERS for frame in kinds(transfer)]


@pytest.mark.parametrize(
    ("transfer", "lost"),
    CASES,
    ids=[
        f"{transfer.__name__}-{frame.sender}-{frame.command:02x}-{frame.number}" for transfer, frame in CASES
    ],
)
def test_one_lost_frame_costs_a_transfer_nothing(transfer: Callable[[Line], None], lost: Frame) -> None:
    line = Line(lambda frame: frame == lost)
    transfer(line)
    assert lost in line.seen
    assert line.server.deadline_ns == NO_DEADLINE_NS or lost == Frame(
        "host", 0xA1, 0
    )  # no transfer is left open
    read(line)
    assert line.server.deadline_ns == NO_DEADLINE_NS
    assert line.network.subscribers[0x585]


def test_a_block_read_whose_end_is_lost_is_aborted_with_its_object() -> None:
    aborts: list[bytes] = []
    line = Line(lambda frame: frame.sender == "node" and frame.command & 0xE3 == 0xC1 and not frame.number)
    passes = line._passes
    line._passes = lambda sender, data: (
        aborts.append(data) if data[0] == 0x80 else None,
        passes(sender, data),
    )[1]  # type: ignore[method-assign]
    block_read(line)
    assert aborts == [bytes.fromhex("80 01 23 00 00 00 04 05")]


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_late_frames_of_the_transfer_before_are_no_answers(transfer: Callable[[Line], None]) -> None:
    """As of a node that gets no time to take the abort before it has sent more of its block."""
    line = Line(lambda frame: False)
    answer = line._answer

    def late(data: bytes) -> None:
        if data[1:4] in (bytes.fromhex("012300"), bytes.fromhex("171000")):
            for number in (1, 2, 3):
                line.network.notify(0x585, bytearray((number, *b"1234567")), 0.0)
            line.network.notify(0x585, bytearray.fromhex("80 99 99 00 00 00 04 05"), 0.0)
        answer(data)

    line._answer = late  # type: ignore[method-assign]
    transfer(line)


def whatever_is_lost_a_transfer_ends_and_the_next_is_whole(
    transfer: Callable[[Line], None], lost: set[int], density: int
) -> None:
    line = Line(lambda frame: len(line.seen) * density in lost or len(line.seen) in lost)
    with contextlib.suppress(NodeError):
        transfer(line)
    line.is_lost = lambda frame: False
    line.value = LONG
    block_read(line)
    block_write(line)


@pytest.mark.parametrize("examples", [12, pytest.param(60, marks=pytest.mark.long)])
def test_whatever_is_lost_a_transfer_ends_and_the_next_is_whole(examples: int) -> None:
    check = given(st.sampled_from(TRANSFERS), st.sets(st.integers(0, 400), max_size=12), st.integers(1, 4))(
        whatever_is_lost_a_transfer_ends_and_the_next_is_whole
    )
    settings(deadline=None, max_examples=examples)(check)()


@settings(deadline=None, max_examples=30)
@given(st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=6), st.integers(0, 3))
def test_whatever_a_node_answers_ends_in_one_error_or_a_value(answers: list[bytes], after: int) -> None:
    """Frames that are no answers at all, in place of answers or beside them."""

    def respond(can_id: int, data: bytes) -> None:
        said.append(data)
        for answer in answers[len(said) - 1 - after :][:1] if len(said) > after else []:
            network.notify(0x585, bytearray(answer), 0.0)

    said: list[bytes] = []
    network = SkinNetwork(respond)
    remote = RemoteOd(network, 5)
    for ask in (
        lambda: remote.read_block(DOMAIN),
        lambda: remote.read_bytes(DOMAIN, 0),
        lambda: remote.write_block(DOMAIN, b"0123456789"),
        lambda: remote.write_bytes(DOMAIN, 0, b"0123456789"),
        remote.answers,
    ):
        said.clear()
        with contextlib.suppress(NodeError):
            ask()
