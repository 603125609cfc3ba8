"""One bus: frames to handlers by COB-ID, the rest counted, the load to the bit."""

from __future__ import annotations

import itertools
import queue
from collections.abc import Callable, Sequence

import pytest

from skinnode.bus_load.timing import exact_bits
from skinnode.config import BusConfig, HandConfig
from skinnode.errors import BusError, NodeError, NodeTimeout, SdoAbort, SkinError
from skinnode.host import containment
from skinnode.host.containment import Defects
from skinnode.host.dispatcher import Dispatcher
from skinnode.host.link import BusLink
from skinnode.host.mainline import Mainline
from skinnode.process import clock
from skinnode.transport import CanPort, Frame
from skinnode.transport.receiver import GATHER_NS

from .conftest import eventually


def fail(error: SkinError) -> None:
    raise AssertionError(error)


def test_frames_go_to_their_handlers_in_order(hand: HandConfig, listener: CanPort) -> None:
    got: queue.SimpleQueue[tuple[str, bytes]] = clock.simple_queue()
    handlers = {
        0x185: lambda data, t_ns: got.put(("a", data)),
        0x186: lambda data, t_ns: got.put(("b", data)),
    }
    with BusLink(hand.buses[0], handlers, fail) as link, Mainline([link]):
        for can_id, data in ((0x3F0, b"x"), (0x186, b"1"), (0x185, b"2"), (0x3F0, b"x"), (0x186, b"3")):
            listener.send(can_id, data)
        assert [got.get(timeout=10) for _ in range(3)] == [("b", b"1"), ("a", b"2"), ("b", b"3")]
        stats = link.stats()
    assert (stats.received, stats.foreign, stats.dropped, stats.malformed) == (5, 2, 0, 0)
    assert stats.foreign_ids == {0x3F0: 2}


def test_bits_are_those_of_every_frame_sent_and_received(hand: HandConfig, listener: CanPort) -> None:
    received = [(0x185, bytes([i, 255 - i, 0, 0, 0, 0, 255, 255])) for i in range(200)] + [(0x705, b"\x05")]
    sent = [(0x080, bytes([i])) for i in range(1, 20)]
    with BusLink(hand.buses[0], {}, fail) as link, Mainline([link]):
        for can_id, data in received:
            listener.send(can_id, data)
        for can_id, data in sent:
            link.send(can_id, data)
        expected = sum(exact_bits(can_id, data) for can_id, data in received + sent)
        assert eventually(lambda: link.stats().bits == expected)
        assert (link.stats().received, link.stats().sent) == (201, 19)
        assert link.stats().load > 0


def test_defect_of_a_handler_costs_its_frame_and_is_reported_once(
    hand: HandConfig, listener: CanPort
) -> None:
    """Whatever else is in the same batch goes to its handlers."""
    failures: queue.SimpleQueue[SkinError] = clock.simple_queue()
    got: queue.SimpleQueue[bytes] = clock.simple_queue()

    def broken(data: bytes, t_ns: int) -> None:
        raise ZeroDivisionError("by zero")

    handlers = {0x185: broken, 0x186: lambda data, t_ns: got.put(data)}
    with BusLink(hand.buses[0], handlers, failures.put) as link:
        for number in range(10):
            listener.send(0x185, b"")
            listener.send(0x186, bytes([number]))
        with Mainline([link]):
            error = failures.get(timeout=10)
            assert [got.get(timeout=10) for _ in range(10)] == [bytes([number]) for number in range(10)]
            assert eventually(lambda: link.stats().received == 20)
    assert str(error) == "can0: frame 0x185: ZeroDivisionError: by zero"
    assert isinstance(error.__cause__, ZeroDivisionError)
    assert failures.empty()
    assert link.defects.count == 10


def numbered(send: Callable[[int, bytes], object], got: queue.SimpleQueue[bytes], first: int) -> None:
    """Ten frames come through, in order."""
    expected = [bytes([first + i]) for i in range(10)]
    for data in expected:
        send(0x185, data)
    assert [got.get(timeout=10) for _ in expected] == expected


def two_buses(hand: HandConfig) -> list[BusConfig]:
    return [hand.buses[0].model_copy(update={"name": name, "channel": f"{name}-{id(hand)}"}) for name in "ab"]


def test_a_batch_and_the_pollers_go_on_after_a_defect() -> None:
    """Each owner hears of its own defect; every other frame and poller of the turn is served."""
    palm, thumb, contained, served = Defects("palm"), Defects("thumb"), [], []

    class Containing(Dispatcher):
        def contain(self, owner: Defects | None, doing: str, error: Exception) -> None:
            contained.append((owner, doing, str(error)))

    def broken(*_: object) -> None:
        raise RuntimeError("broken")

    dispatcher = Containing(BusConfig(name="can0", channel="batch"), {}, 0)
    dispatcher.handle(0x185, broken, palm)
    dispatcher.handle(0x186, lambda data, t_ns: served.append(data), thumb)
    dispatcher.poll_with(broken, palm)
    dispatcher.poll_with(served.append, thumb)
    dispatcher.dispatch(
        [Frame(can_id, bytes([i]), i + 1) for i, can_id in enumerate((0x185, 0x186, 0x185, 0x186))]
    )
    dispatcher.poll(5_000_000)
    assert served == [b"\x01", b"\x03", 5_000_000]
    assert contained == [
        (palm, "frame 0x185", "broken"),
        (palm, "frame 0x185", "broken"),
        (palm, "polling", "broken"),
    ]
    assert dispatcher.count().received == 4


def test_a_listener_that_raises_costs_no_frame(hand: HandConfig, listener: CanPort) -> None:
    got: queue.SimpleQueue[bytes] = clock.simple_queue()
    batches: queue.SimpleQueue[int] = clock.simple_queue()

    def broken(frames: Sequence[Frame]) -> None:
        raise ZeroDivisionError("of ours")

    with BusLink(hand.buses[0], {0x185: lambda data, t_ns: got.put(data)}, lambda error: None) as link:
        link.listen(broken)
        link.listen(lambda frames: batches.put(len(frames)))
        with Mainline([link]):
            numbered(listener.send, got, 0)
        assert sum(batches.get_nowait() for _ in range(batches.qsize())) == 10
        assert link.stats().received == 10
        assert link.defects.newest == "a listener: ZeroDivisionError: of ours"


def test_pollers_are_told_the_time_every_two_milliseconds_at_most() -> None:
    told: list[int] = []
    dispatcher = Dispatcher(BusConfig(name="can0", channel="polls"), {}, 0)
    dispatcher.poll_with(told.append)
    for t_us in (5000, 5000, 5001, 6999, 7000, 8999, 12_000):
        dispatcher.poll(1000 * t_us)
    assert told == [5_000_000, 7_000_000, 12_000_000]
    dispatcher.poll(11_999_000)  # time went back: nobody waits until it has caught up
    assert told[3:] == [11_999_000]


def test_a_load_that_cannot_be_measured_is_tried_again_ever_more_seldom(
    hand: HandConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mainline would spend its time on it, for it turns with each batch of frames."""
    now_s, due_s = [100.0], list[float]()
    monkeypatch.setattr(containment.clock, "monotonic", lambda: now_s[0])
    with BusLink(hand.buses[0], {}, lambda error: None) as link:

        def broken(now_ns: int) -> None:
            due_s.append(now_ns * 1e-9)
            raise ZeroDivisionError("of ours")

        monkeypatch.setattr(link, "measure", broken)
        for turn in range(4000):
            now_s[0] = 100.0 + turn / 1000
            link.t_dispatched_ns = round(now_s[0] * 1e9)
            link.measure_load()
    assert link.defects.newest == "measuring the load: ZeroDivisionError: of ours"
    pauses = [later - earlier for earlier, later in itertools.pairwise(due_s)]
    assert pauses == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.0, 1.0], abs=0.0015)


def test_a_defect_on_one_bus_is_told_once_and_the_other_goes_on(hand: HandConfig) -> None:
    failures: queue.SimpleQueue[SkinError] = clock.simple_queue()
    got: queue.SimpleQueue[bytes] = clock.simple_queue()

    def broken(data: bytes, t_ns: int) -> None:
        raise ZeroDivisionError("by zero")

    one, other = two_buses(hand)
    with (
        CanPort(one) as to_one,
        CanPort(other) as to_other,
        BusLink(one, {0x185: broken}, failures.put) as a,
        BusLink(other, {0x185: lambda data, t_ns: got.put(data)}, failures.put) as b,
        Mainline([a, b]),
    ):
        to_one.send(0x185, b"")
        assert str(failures.get(timeout=10)) == "a: frame 0x185: ZeroDivisionError: by zero"
        to_one.send(0x185, b"")
        numbered(to_other.send, got, 0)
    assert failures.empty()


def test_an_interface_that_takes_long_to_open_again_holds_up_no_other_bus(hand: HandConfig) -> None:
    opening, go = clock.event(), clock.event()

    class Slow(CanPort):
        def recv_batch(self, timeout_s: float, most: int = 1) -> list[Frame]:
            if not opening.is_set():
                raise BusError("a: unplugged")
            return super().recv_batch(timeout_s, most)

        def reopen(self) -> None:
            opening.set()
            go.wait(10)
            super().reopen()

    got: dict[str, queue.SimpleQueue[bytes]] = {"a": clock.simple_queue(), "b": clock.simple_queue()}
    one, other = two_buses(hand)
    with (
        CanPort(one) as to_one,
        CanPort(other) as to_other,
        BusLink(one, {0x185: lambda data, t_ns: got["a"].put(data)}, fail, Slow) as a,
        BusLink(other, {0x185: lambda data, t_ns: got["b"].put(data)}, fail) as b,
        Mainline([a, b]),
    ):
        assert opening.wait(10)
        numbered(to_other.send, got["b"], 0)
        assert (str(a.failure), a.stats().outages, b.failure, b.stats().outages) == (
            "a: unplugged",
            1,
            None,
            0,
        )
        go.set()
        assert eventually(lambda: a.failure is None)
        numbered(to_one.send, got["a"], 0)
        numbered(to_other.send, got["b"], 10)
        assert (a.stats().outages, a.stats().received, b.stats().received) == (1, 10, 20)


def test_the_mainline_ends_while_an_interface_is_away(hand: HandConfig) -> None:
    class Gone(CanPort):
        def recv_batch(self, timeout_s: float, most: int = 1) -> list[Frame]:
            raise BusError("can0: unplugged")

        def reopen(self) -> None:
            raise BusError("can0: does not open")

    with BusLink(hand.buses[0], {}, fail, Gone) as link:
        with Mainline([link]) as mainline:
            assert eventually(lambda: link.failure is not None)
        mainline.stop()
        assert link.stats().outages == 1


@pytest.mark.system_time  # one bus is to be busy, not overloaded
def test_time_goes_on_for_a_silent_bus_while_another_is_busy(hand: HandConfig) -> None:
    """What a scan on it lacks is not waited for until the other falls silent."""
    one, other = two_buses(hand)
    polled_ns: queue.SimpleQueue[int] = clock.simple_queue()
    with CanPort(one) as to_one, BusLink(one, {}, fail) as busy, BusLink(other, {}, fail) as silent:
        silent.poll_with(polled_ns.put)
        with Mainline([busy, silent]):
            begin_ns = clock.monotonic_ns()
            end_s, newest_ns = clock.monotonic() + 10, 0
            while newest_ns < begin_ns and clock.monotonic() < end_s:
                to_one.send(0x185, b"")
                while not polled_ns.empty():
                    newest_ns = polled_ns.get()
    assert begin_ns < newest_ns <= clock.monotonic_ns()


def test_the_time_up_to_which_frames_were_dealt_out_never_goes_back(hand: HandConfig) -> None:
    """It is that of the newest frame, and the receiver may have looked before that came."""
    told: list[int] = []
    with BusLink(hand.buses[0], {}, fail) as link:
        link.poll_with(told.append)
        link.t_dispatched_ns = link.intake.seen_ns + 1_000_000_000
        link.turn()
        assert (link.t_dispatched_ns, told) == (link.intake.seen_ns + 1_000_000_000, [])


def test_whoever_asks_is_answered_as_soon_as_if_no_scan_were_expected(hand: HandConfig) -> None:
    """A SYNC asks for no answer, for it is known when scans come."""
    with BusLink(hand.buses[0], {}, fail) as link:
        far_ns = clock.monotonic_ns() + 1_000_000_000
        link.expect("thumb", (far_ns,))
        link.send(0x80, b"\x01")
        now_ns = clock.monotonic_ns()
        link.intake.gather(now_ns)
        assert link.intake.due_ns > now_ns + 1.5 * GATHER_NS
        link.send(0x605, bytes(8))
        now_ns = clock.monotonic_ns()
        link.intake.gather(now_ns)
        assert link.intake.due_ns <= now_ns + 1.5 * GATHER_NS


def test_the_load_of_each_bus_is_measured_though_in_turn(hand: HandConfig) -> None:
    one, other = two_buses(hand)
    with (
        CanPort(one) as to_one,
        CanPort(other) as to_other,
        BusLink(one, {}, fail) as a,
        BusLink(other, {}, fail) as b,
        Mainline([a, b]),
    ):
        for _ in range(20):
            to_one.send(0x185, bytes(8))
            to_other.send(0x186, b"")
            clock.sleep(0.01)
        assert eventually(lambda: a.stats().bits == 20 * exact_bits(0x185, bytes(8)))
        assert eventually(lambda: b.stats().bits == 20 * exact_bits(0x186, b""))


@pytest.mark.parametrize(
    ("response", "error", "line"),
    [
        (None, NodeTimeout, "node 5: read of object 0x1017:0: no response within 0.9 s"),
        (
            "4f 17 10 00 05 00 00 00",
            NodeError,
            "node 5: object 0x1017:0: got 05, expected 2 bytes (u16)",
        ),
        (
            "60 17 10 00 00 00 00 00",
            NodeError,
            "node 5: read of object 0x1017:0: got Unexpected response 0x60, "
            "expected a response according to CiA 301",
        ),
        (
            "80 17 10 00 00 00 02 06",
            SdoAbort,
            "node 5: SDO abort 0x06020000: read of object 0x1017:0: Object does not exist",
        ),
    ],
)
def test_sdo_that_goes_wrong(
    hand: HandConfig, listener: CanPort, response: str | None, error: type[NodeError], line: str
) -> None:
    def on_request(data: bytes, t_ns: int) -> None:
        if response is not None:
            listener.send(0x585, bytes.fromhex(response))

    bus = hand.buses[0]
    with (  # the node is a link as well: it answers on its own mainline
        BusLink(bus, {}, fail) as link,
        BusLink(bus, {0x605: on_request}, fail) as node,
        Mainline([link]),
        Mainline([node]),
        pytest.raises(error) as caught,
    ):
        link.remote_od(5).read(0x1017, 0, "u16")
    assert str(caught.value) == line


def test_short_sdo_answer_is_rejected_and_the_next_one_counts(hand: HandConfig, listener: CanPort) -> None:
    def on_request(data: bytes, t_ns: int) -> None:
        listener.send(0x585, b"\x4b\x17\x10")
        listener.send(0x585, bytes.fromhex("4b 17 10 00 fa 00 00 00"))

    bus = hand.buses[0]
    with (
        BusLink(bus, {}, fail) as link,
        BusLink(bus, {0x605: on_request}, fail) as node,
        Mainline([link]),
        Mainline([node]),
    ):
        assert link.remote_od(5).read(0x1017, 0, "u16") == 250
        assert link.stats().malformed == 1
        assert str(link.first_malformed) == (
            "COB-ID 0x585: got 3 bytes (4b 17 10), allowed: 8 bytes (SDO response)"
        )


def test_listener_gets_frames_of_all_kinds(hand: HandConfig, listener: CanPort) -> None:
    got: queue.SimpleQueue[tuple[int, bytes, bool]] = clock.simple_queue()

    def note(frames: Sequence[Frame]) -> None:
        for frame in frames:
            got.put((frame.can_id, frame.data, frame.remote))

    with BusLink(hand.buses[0], {}, fail) as link, Mainline([link]):
        link.listen(note)
        listener.send(0x705, remote=True, data=b"")
        listener.send(0x3F0, b"x")
        assert [got.get(timeout=10) for _ in range(2)] == [(0x705, b"", True), (0x3F0, b"x", False)]
        link.ask_remote(0x706)
        frame = listener.recv(10)
    assert frame is not None
    assert (frame.can_id, frame.remote) == (0x706, True)
