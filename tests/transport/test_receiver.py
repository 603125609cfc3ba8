"""The receive threads: bounded, counted, and never dead unheard."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

import pytest

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.process import clock
from skinnode.transport import CanPort, Frame, Intake, Receiver
from skinnode.transport.datagram import DatagramPort, datagram, free_channel
from skinnode.transport.receiver import GATHER_NS, LONG_NS
from vcan_sim.virtual_time import VirtualClock


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) == before


class Script:
    """A port that plays frames and then an error, or silence."""

    reads_batches = pollable = False
    signalling = None

    def __init__(self, count: int, error: Exception | None = None) -> None:
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


@contextmanager
def buses(count: int) -> Iterator[tuple[list[DatagramPort], list[Callable[[int], object]]]]:
    """Ports that read batches, and for each what sends it a frame with that identifier."""
    with ExitStack() as stack:
        ports, senders = [], []
        for number in range(count):
            bus = BusConfig(name=f"can{number}", interface="udp", channel=free_channel())
            ports.append(stack.enter_context(DatagramPort(bus)))
            sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            sock.connect(("127.0.0.1", int(bus.channel)))
            senders.append(lambda can_id, sock=sock: sock.send(datagram(can_id, b"")))
        yield ports, senders


def ids(frames: Sequence[Frame]) -> list[int]:
    return [frame.can_id for frame in frames]


def take(receiver: Receiver, intake: Intake, count: int) -> list[int]:
    """Identifiers of as many frames, or of those that came within five seconds."""
    got: list[int] = []
    end_s = time.monotonic() + 5
    while len(got) < count and time.monotonic() < end_s:
        receiver.wait(0.1)
        got += ids(intake.take())
    return got


def failure_of(receiver: Receiver, intake: Intake) -> Exception | None:
    """What a reader is told within five seconds instead of frames."""
    end_s = time.monotonic() + 5
    while time.monotonic() < end_s:
        receiver.wait(0.1)
        try:
            intake.take()
        except Exception as error:
            return error
    return None


def test_order() -> None:
    port = Script(10)
    intake = Intake(port)
    with Receiver([intake]) as receiver:
        assert port.played.wait(5)
        assert intake.queued == 10
        receiver.wait(5.0)
        assert ids(intake.take()) == list(range(10))
        assert (intake.queued, intake.dropped) == (0, 0)
        assert intake.take() == []
        receiver.close()
        receiver.close()


def test_a_full_queue_drops_the_newest_and_counts() -> None:
    port = Script(100)
    intake = Intake(port, capacity=30)
    with Receiver([intake]):
        assert port.played.wait(5)
        assert ids(intake.take()) == list(range(30))
        assert intake.dropped == 70


def test_capacity() -> None:
    with pytest.raises(ValueError, match="capacity: got 0, must be at least 1"):
        Intake(Script(0), capacity=0)


def test_on_a_bus(any_bus: BusConfig) -> None:
    with CanPort(any_bus) as ours, CanPort(any_bus) as theirs:
        intake = Intake(theirs)
        with Receiver([intake]) as receiver:
            for number in range(200):
                ours.send(number, b"12345678")
            assert take(receiver, intake, 200) == list(range(200))


def test_many_buses_each_in_order_and_a_full_one_costs_the_others_nothing() -> None:
    with buses(4) as (ports, senders):
        intakes = [Intake(ports[0], capacity=5), *(Intake(port) for port in ports[1:])]
        with Receiver(intakes) as receiver:
            for number in range(300):
                for send in senders:
                    send(number)
            for intake in intakes[1:]:
                assert take(receiver, intake, 300) == list(range(300))
            end_s = time.monotonic() + 5
            while ports[0].received < 300 and time.monotonic() < end_s:
                time.sleep(0.005)
            assert ids(intakes[0].take()) == list(range(5))
        assert [intake.dropped for intake in intakes] == [295, 0, 0, 0]
        assert [port.received for port in ports] == [300] * 4


def test_many_buses_wake_one_thread() -> None:
    before = set(threading.enumerate())
    with (
        buses(4) as (ports, _),
        CanPort(BusConfig(name="can7", channel="slow")) as other,
        Receiver([Intake(port) for port in (*ports, other)]),
    ):
        names = sorted(thread.name for thread in set(threading.enumerate()) - before)
    assert names == ["receive", "receive can7"]  # python-can may block in the other


def test_buses_in_virtual_time_need_no_thread_and_a_failure_is_found_without_frames() -> None:
    with VirtualClock(), ExitStack() as opened:
        configs = [BusConfig(name=name, interface="timed", channel=name) for name in ("can0", "can1")]
        senders = [opened.enter_context(CanPort(config)) for config in configs]
        ports = [opened.enter_context(CanPort(config)) for config in configs]
        before = set(threading.enumerate())
        intakes = [Intake(port) for port in ports]
        with Receiver(intakes) as receiver:
            assert set(threading.enumerate()) == before
            receiver.wait(0.1)
            for number in range(100):
                senders[number % 2].send(number, b"12345678")
            got: dict[Intake, list[int]] = {intake: [] for intake in intakes}
            end_s = clock.monotonic() + 0.02  # 50 frames of a bus take 6 ms, and gathering at most 7.5 ms
            while clock.monotonic() < end_s:
                for intake in receiver.wait(0.01):
                    got[intake] += ids(intake.take())
            assert [*got.values()] == [list(range(0, 100, 2)), list(range(1, 100, 2))]
            ports[1].close()
            closed_s = clock.monotonic()
            while intakes[1] not in receiver.wait(0.01):
                assert clock.monotonic() < closed_s + 0.05
            with pytest.raises(BusError, match="can1"):
                intakes[1].take()


def test_an_error_is_raised_to_the_reader_after_the_frames_before_it() -> None:
    error = BusError("script: gone")
    port = Script(3, error)
    intake = Intake(port)
    with Receiver([intake]) as receiver:
        assert port.played.wait(5)
        assert failure_of(receiver, intake) is error
        with pytest.raises(BusError, match="script: gone"):
            intake.take()
        port.left, port.error = 4, None
        receiver.resume(intake)  # it was opened again
        assert take(receiver, intake, 4) == [-1, 0, 1, 2]
    assert intake.queued == 0


@pytest.mark.parametrize("error", [BusError("can1: gone"), ZeroDivisionError("by zero")])
def test_what_goes_wrong_on_one_bus_is_told_to_its_reader_and_the_others_go_on(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    with buses(3) as (ports, senders):
        intakes = [Intake(port) for port in ports]

        def broken(timeout_s: float, most: int = 1) -> list[Frame]:
            raise error

        with Receiver(intakes) as receiver:
            for send in senders:
                send(1)
            assert [take(receiver, intake, 1) for intake in intakes] == [[1], [1], [1]]
            with monkeypatch.context() as patch:
                patch.setattr(ports[1], "recv_batch", broken)
                assert failure_of(receiver, intakes[1]) is error
            for send in senders:
                send(2)
            assert [take(receiver, intakes[number], 1) for number in (0, 2)] == [[2], [2]]
            assert intakes[1].failed
            ports[1].reopen()
            receiver.resume(intakes[1])
            senders[1](3)
            assert take(receiver, intakes[1], 1) == [3]


def test_a_port_that_is_opened_again_before_its_thread_has_ended_is_received_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on a machine where threads wait long for their turn."""
    port, failed, tell = Script(3, BusError("script: gone")), threading.Event(), Receiver._notify

    def slowly(receiver: Receiver) -> None:
        tell(receiver)
        if port.error is not None and port.played.is_set():
            failed.set()
            time.sleep(0.2)

    monkeypatch.setattr(Receiver, "_notify", slowly)
    intake = Intake(port)
    with Receiver([intake]) as receiver:
        assert failed.wait(5)
        port.left, port.error = 4, None
        again = threading.Thread(target=receiver.resume, args=(intake,), daemon=True)
        again.start()
        again.join(5)
        ended = not again.is_alive()
        assert take(receiver, intake, 7) == [0, 1, 2, -1, 0, 1, 2]
    assert ended


@pytest.mark.parametrize("name", ["gather", "_next_awaited", "failed"])
def test_what_goes_wrong_beside_a_port_is_told_and_all_buses_go_on(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Exception] = []
    error = ZeroDivisionError("of ours")

    def broken(*args: object) -> None:
        if len(told) < 3:
            raise error

    with buses(2) as (ports, senders):
        intakes = [Intake(port) for port in ports]
        with Receiver(intakes, told.append) as receiver:
            with monkeypatch.context() as patch:
                patch.setattr(Intake, name, property(broken) if name == "failed" else broken)
                end_s = time.monotonic() + 5
                while len(told) < 3 and time.monotonic() < end_s:
                    for send in senders:
                        send(1)
                    time.sleep(0.01)
            assert told == [error] * 3
            for send, intake in zip(senders, intakes, strict=True):
                sent = sum(take(receiver, intake, 1)) + intake.queued  # those of before, at least one
                assert sent
                send(2)
                got: list[int] = []
                while 2 not in got and time.monotonic() < end_s + 5:
                    got += take(receiver, intake, 1)
                assert 2 in got


def test_a_port_that_is_closed_meanwhile_fails_alone() -> None:
    with buses(2) as (ports, senders):
        intakes = [Intake(port) for port in ports]
        with Receiver(intakes) as receiver:
            ports[0].close()
            assert isinstance(failure_of(receiver, intakes[0]), BusError)
            senders[1](5)
            assert take(receiver, intakes[1], 1) == [5]


def test_it_knows_up_to_when_it_has_seen_everything() -> None:
    port = Script(10)
    begin_ns = time.monotonic_ns()
    intake = Intake(port)
    with Receiver([intake]):
        assert port.played.wait(5)
        end_s = time.monotonic() + 5
        while intake.seen_ns < begin_ns and time.monotonic() < end_s:
            time.sleep(0.005)
        assert begin_ns < intake.seen_ns <= time.monotonic_ns()
        assert intake.queued == 10


def test_of_a_silent_bus_it_knows_that_nothing_came_while_another_is_busy() -> None:
    with buses(2) as (ports, senders):
        busy, silent = (Intake(port) for port in ports)
        with Receiver([busy, silent]):
            begin_ns = time.monotonic_ns()
            end_s = time.monotonic() + 5
            while silent.seen_ns < begin_ns and time.monotonic() < end_s:
                senders[0](1)
            assert begin_ns < silent.seen_ns <= time.monotonic_ns()


def test_frames_that_wait_are_not_yet_seen(any_bus: BusConfig) -> None:
    """However long the thread is held up: while a frame waits, nothing later has been seen."""
    with CanPort(any_bus) as ours, CanPort(any_bus) as theirs:
        held, go = threading.Event(), threading.Event()
        receive = theirs.recv_batch

        def hold(timeout_s: float, most: int = 256) -> list[Frame]:
            frames = receive(timeout_s)
            if not frames and not go.is_set():
                held.set()
                go.wait(10)  # it was told that there is nothing, and is away for a while
            return frames

        theirs.recv_batch = hold  # type: ignore[method-assign]
        intake = Intake(theirs)
        with Receiver([intake]) as receiver:
            assert held.wait(5)
            ours.send(1, b"")
            time.sleep(0.05)
            sent_ns = time.monotonic_ns()
            assert intake.seen_ns < sent_ns
            go.set()
            receiver.wait(5.0)
            seen_ns = intake.seen_ns
            assert ids(intake.take()) == [1] or seen_ns < sent_ns


def pause_ns(intake: Intake, now_ns: int) -> int:
    intake.gather(now_ns)
    return intake.due_ns - now_ns


def is_about(pause: int, usual: int) -> bool:
    """Buses wake together, so a pause may be half as long again, or half as long."""
    return 0.5 * usual <= pause <= 1.5 * usual


NOW_NS = 5_000_000_000


def test_what_is_expected_does_not_wait_for_more_frames() -> None:
    intake = Intake(Script(0))
    assert is_about(pause_ns(intake, NOW_NS), GATHER_NS)  # nothing is known
    intake.expect("thumb", (NOW_NS + 600_000,))
    intake.expect("index", (NOW_NS + 500_000,))
    assert 500_000 < pause_ns(intake, NOW_NS) < 600_000  # until the first of them
    assert pause_ns(intake, NOW_NS + 700_000) < 400_000  # overdue
    intake.expect("thumb", (NOW_NS + 50_000_000,))
    intake.expect("index", (NOW_NS + 50_000_000,))
    assert 600_000 < pause_ns(intake, NOW_NS + 49_400_000) < 700_000


def test_one_that_may_come_at_two_times_is_looked_for_at_both() -> None:
    intake = Intake(Script(0))
    intake.expect("thumb", (NOW_NS, NOW_NS + 12_000_000))
    assert 300_000 < pause_ns(intake, NOW_NS - 300_000) < 400_000
    assert pause_ns(intake, NOW_NS + 100_000) < 400_000  # perhaps it is a little late
    assert is_about(pause_ns(intake, NOW_NS + 1_000_000), LONG_NS)  # it is the other time
    assert 300_000 < pause_ns(intake, NOW_NS + 11_700_000) < 400_000
    assert is_about(pause_ns(intake, NOW_NS + 14_000_000), GATHER_NS)  # neither
    intake.expect("thumb", ())
    assert is_about(pause_ns(intake, NOW_NS + 14_000_000), GATHER_NS)


def test_the_pause_is_long_while_it_is_known_what_comes_and_nobody_has_asked_anything() -> None:
    """An answer may come at any time, so it is looked for as often as if nothing were known."""
    intake = Intake(Script(0))
    intake.expect("thumb", (NOW_NS + 50_000_000,))
    assert is_about(pause_ns(intake, NOW_NS + 10_000_000), LONG_NS)
    assert LONG_NS > 3 * GATHER_NS
    intake.asked(NOW_NS + 10_000_000)
    assert is_about(pause_ns(intake, NOW_NS + 11_000_000), GATHER_NS)
    assert is_about(pause_ns(intake, NOW_NS + 35_000_000), LONG_NS)  # it has come, or does not
    # once a little before it is due, then when it is
    assert 2_000_000 < pause_ns(intake, NOW_NS + 47_000_000) < 2_500_000
    assert 700_000 < pause_ns(intake, NOW_NS + 49_300_000) < 800_000


def test_while_something_is_late_the_pause_is_not_long() -> None:
    """It may come at any time; a stream that has ended is given up after a while."""
    intake = Intake(Script(0))
    intake.expect("late", (NOW_NS,))
    intake.expect("index", (NOW_NS + 1_000_000_000,))
    assert pause_ns(intake, NOW_NS + 300_000) < 400_000
    assert is_about(pause_ns(intake, NOW_NS + 10_000_000), GATHER_NS)
    assert is_about(pause_ns(intake, NOW_NS + 190_000_000), GATHER_NS)
    assert is_about(pause_ns(intake, NOW_NS + 210_000_000), LONG_NS)


def test_buses_are_fetched_from_together() -> None:
    """However far apart the frames came that the pauses began with: one waking does for all."""
    one, other = Intake(Script(0)), Intake(Script(0))
    for intake in (one, other):
        intake.expect("thumb", (NOW_NS + 500_000_000,))
    ends = set()
    for after_ns in range(0, LONG_NS, LONG_NS // 10):
        one.gather(NOW_NS + after_ns)
        other.gather(NOW_NS + after_ns + LONG_NS // 20)
        ends |= {one.due_ns, other.due_ns}
    assert len(ends) <= 3
