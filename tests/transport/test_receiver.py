"""The receive thread: bounded, counted, and never dead unheard."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from skinnode.errors import BusError
from skinnode.model.config import BusConfig
from skinnode.transport import CanPort, Frame, Receiver


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) == before


class Script:
    """A port that plays frames and then an error, or silence."""

    reads_batches = True

    def __init__(self, count: int, error: BusError | None = None) -> None:
        self.config = BusConfig(name="script")
        self.left, self.error = count, error
        self.count = count
        self.played = threading.Event()

    def recv_batch(self, timeout_s: float) -> list[Frame]:
        if self.left:
            batch = min(self.left, 7)
            self.left -= batch
            first = self.count - self.left - batch
            return [Frame(first + i, b"", 0) for i in range(batch)]
        self.played.set()
        if self.error is not None:
            raise self.error
        time.sleep(min(timeout_s, 0.005))
        return []


def test_order_and_batches() -> None:
    port = Script(10)
    with Receiver(port) as receiver:
        assert port.played.wait(5)
        assert [frame.can_id for frame in receiver.get_batch(1.0, max_frames=4)] == [0, 1, 2, 3]
        assert receiver.queued == 6
        assert [frame.can_id for frame in receiver.get_batch(1.0)] == [4, 5, 6, 7, 8, 9]
        assert receiver.get_batch(0.0) == []
        assert receiver.get_batch(0.01) == []
        assert receiver.dropped == 0


def test_a_full_queue_drops_the_newest_and_counts() -> None:
    port = Script(100)
    with Receiver(port, capacity=30) as receiver:
        assert port.played.wait(5)
        assert [frame.can_id for frame in receiver.get_batch(0.0)] == list(range(30))
        assert receiver.dropped == 70


def test_an_error_is_raised_to_the_reader_after_the_frames_before_it() -> None:
    error = BusError("script: gone")
    port = Script(3, error)
    with Receiver(port) as receiver:
        assert port.played.wait(5)
        assert len(receiver.get_batch(1.0)) == 3
        for _ in range(2):
            with pytest.raises(BusError, match="script: gone"):
                receiver.get_batch(1.0)


def test_capacity() -> None:
    with pytest.raises(ValueError, match="capacity: got 0, must be at least 1"):
        Receiver(Script(0), capacity=0)


def test_on_a_bus(any_bus: BusConfig) -> None:
    with CanPort(any_bus) as ours, CanPort(any_bus) as theirs, Receiver(theirs) as receiver:
        for number in range(200):
            ours.send(number, b"12345678")
        frames: list[Frame] = []
        end_s = time.monotonic() + 5
        while len(frames) < 200 and time.monotonic() < end_s:
            frames += receiver.get_batch(0.1)
        assert [frame.can_id for frame in frames] == list(range(200))
        receiver.close()
        receiver.close()


def test_it_knows_up_to_when_it_has_seen_everything() -> None:
    port = Script(10)
    begin_ns = time.monotonic_ns()
    with Receiver(port) as receiver:
        assert port.played.wait(5)
        end_s = time.monotonic() + 5
        while receiver.seen_ns < begin_ns and time.monotonic() < end_s:
            time.sleep(0.005)
        assert begin_ns < receiver.seen_ns <= time.monotonic_ns()
        assert receiver.queued == 10


def test_frames_that_wait_are_not_yet_seen(any_bus: BusConfig) -> None:
    """However long the thread is held up: while a frame waits, nothing later has been seen."""
    with CanPort(any_bus) as ours, CanPort(any_bus) as theirs:
        held, go = threading.Event(), threading.Event()
        receive = theirs.recv_batch

        def hold(timeout_s: float, most: int = 256) -> list[Frame]:
            frames = receive(timeout_s)
            if not frames and not go.is_set() and timeout_s:
                held.set()
                go.wait(10)  # it was told that there is nothing, and is away for a while
            return frames

        theirs.recv_batch = hold  # type: ignore[method-assign]
        with Receiver(theirs) as receiver:
            assert held.wait(5)
            ours.send(1, b"")
            time.sleep(0.05)
            sent_ns = time.monotonic_ns()
            assert receiver.seen_ns < sent_ns
            go.set()
            (frame,) = receiver.get_batch(5.0)
            assert frame.can_id == 1
            assert receiver.seen_ns < sent_ns or receiver.queued == 0
