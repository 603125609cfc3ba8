"""One endpoint, the same behaviour over every interface that this machine has."""

from __future__ import annotations

import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import can
import pytest

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.transport import CanPort, Frame, multicast
from skinnode.transport import port as port_module

WAIT_S = 5.0


@pytest.fixture
def config(any_bus: BusConfig) -> BusConfig:
    return any_bus


@pytest.fixture
def open_port(config: BusConfig) -> Iterator[Callable[[], CanPort]]:
    opened: list[CanPort] = []

    def open_() -> CanPort:
        opened.append(CanPort(config))
        return opened[-1]

    yield open_
    for port in opened:
        port.close()


def receive(port: CanPort) -> Frame:
    frame = port.recv(WAIT_S)
    assert frame is not None
    return frame


def test_frames_arrive_in_order_and_as_they_were(open_port) -> None:
    ours, theirs = open_port(), open_port()
    for number in range(9):
        ours.send(0x100 + number, bytes(range(number)))
    for number in range(9):
        frame = receive(theirs)
        assert frame[:2] == (0x100 + number, bytes(range(number)))
        assert frame[3:] == (False, False, False, False)
        assert type(frame.data) is bytes
    assert theirs.recv(0.0) is None
    assert (ours.sent, theirs.received, ours.errors, theirs.errors) == (9, 9, 0, 0)


def test_remote_frames(open_port) -> None:
    ours, theirs = open_port(), open_port()
    ours.send(0x704, b"", remote=True)
    frame = receive(theirs)
    assert (frame.can_id, frame.data, frame.remote) == (0x704, b"", True)


def test_what_an_endpoint_sends_does_not_come_back(open_port) -> None:
    ours, theirs = open_port(), open_port()
    ours.send(1, b"ours")
    theirs.send(2, b"theirs")
    ours.send(3, b"ours")
    assert receive(ours).data == b"theirs"
    assert ours.recv(0.05) is None
    assert ours.received == 1
    assert [receive(theirs).can_id for _ in range(2)] == [1, 3]


def test_every_endpoint_hears_every_other(open_port) -> None:
    ports = [open_port() for _ in range(3)]
    ports[0].send(5, b"")
    assert [receive(port).can_id for port in ports[1:]] == [5, 5]


def test_plain_python_can_at_the_other_end(config: BusConfig, open_port, plain_bus) -> None:
    ours = open_port()
    with plain_bus(config) as theirs:
        theirs.send(can.Message(arbitration_id=0x1ABCDEF, is_extended_id=True, data=b"x"))
        frame = receive(ours)
        assert (frame.can_id, frame.extended) == (0x1ABCDEF, True)
        if config.interface != "socketcan":  # whose classic socket is not handed FD frames
            theirs.send(can.Message(arbitration_id=7, is_extended_id=False, is_fd=True, data=bytes(64)))
            frame = receive(ours)
            assert (frame.fd, len(frame.data)) == (True, 64)
        ours.send(0x123, b"12345678")
        messages = [theirs.recv(WAIT_S) for _ in range(3 if config.interface == "udp_multicast" else 1)]
        message = messages[-1]  # the multicast bus hands a sender its own frames
        assert message is not None
        assert (message.arbitration_id, message.is_extended_id) == (0x123, False)
        assert bytes(message.data) == b"12345678"


def test_time_is_that_of_arrival_not_of_reading(open_port) -> None:
    ours, theirs = open_port(), open_port()
    for _ in range(50):  # the kernel starts to stamp packets a moment after the first socket asked for it
        before_ns = time.monotonic_ns()
        ours.send(1, b"")
        after_ns = time.monotonic_ns()
        time.sleep(0.2)
        frame = receive(theirs)
        assert before_ns - 20_000_000 <= frame.t_ns
        if frame.t_ns <= after_ns + 100_000_000:
            return
    pytest.fail("50 frames in a row have the time at which they were read")


def test_clock_of_another_machine_is_not_believed(config: BusConfig, open_port, monkeypatch) -> None:
    ours, theirs = open_port(), open_port()
    ours.send(1, b"")
    real, real_ns = time.time, time.time_ns
    monkeypatch.setattr(port_module.clock, "time", lambda: real() + 1e6)
    monkeypatch.setattr(time, "time_ns", lambda: real_ns() + 10**15)  # by which socketcan dates its frames
    before_ns = time.monotonic_ns()
    assert before_ns <= receive(theirs).t_ns <= time.monotonic_ns()


def test_timeout(open_port) -> None:
    port = open_port()
    start = time.monotonic()
    assert port.recv(0.05) is None
    assert time.monotonic() - start >= 0.04


@pytest.mark.parametrize(
    ("can_id", "data", "message"),
    [(0x800, b"", "can_id: got 2048"), (-1, b"", "can_id: got -1"), (1, bytes(9), "data: got 9 bytes")],
)
def test_no_such_frame(open_port, can_id: int, data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        open_port().send(can_id, data)


@pytest.fixture
def fd_port(config: BusConfig) -> Iterator[Callable[[], CanPort]]:
    opened: list[CanPort] = []

    def open_() -> CanPort:
        opened.append(CanPort(config.model_copy(update={"fd": True})))
        return opened[-1]

    yield open_
    for port in opened:
        port.close()


def test_longer_frames_on_a_bus_of_can_fd(config: BusConfig, fd_port) -> None:
    ours, theirs = fd_port(), fd_port()
    for n_bytes in (8, 9, 12, 33, 64):
        ours.send(0x185, bytes(range(1, n_bytes + 1)))
    lengths = []
    for n_bytes in (8, 9, 12, 33, 64):
        frame = receive(theirs)
        assert frame.data.rstrip(b"\0") == bytes(range(1, n_bytes + 1))
        assert frame.fd == (n_bytes > 8)
        lengths.append(len(frame.data))
    assert lengths == [8, 12, 12, 48, 64]  # padded to lengths that CAN FD has
    with pytest.raises(ValueError, match="got 65 bytes, must be at most 64"):
        ours.send(0x185, bytes(65))


def test_python_can_sees_an_fd_frame_with_bit_rate_switch(config: BusConfig, fd_port, plain_bus) -> None:
    options = {} if config.interface == "virtual" else {"fd": True}
    with plain_bus(config, **options) as other:
        port = fd_port()
        port.send(0x185, bytes(64))
        message = other.recv(WAIT_S)
        assert message is not None
        assert (message.is_fd, message.bitrate_switch, len(message.data)) == (True, True, 64)
        port.send(0x185, bytes(8))
        message = other.recv(WAIT_S)
        assert message is not None
        assert (message.is_fd, message.bitrate_switch) == (False, False)


def test_closed(open_port) -> None:
    port = open_port()
    port.close()
    port.close()
    with pytest.raises(BusError, match=r"^can7: interface .* 0x001 not sent"):
        port.send(1, b"")
    with pytest.raises(BusError, match=r"^can7: interface .* cannot receive"):
        port.recv(0.0)
    assert (port.sent, port.errors) == (0, 2)


@pytest.mark.parametrize(
    ("interface", "channel", "says"),
    [
        ("sockecan", "can0", "no such interface, allowed: "),
        ("udp_multicast", "10.0.0.1", "cannot be opened .* allowed: a multicast address"),
        ("socketcan", "nosuchcan7", "cannot be opened .* allowed: a CAN network interface that exists"),
        ("slcan", "/dev/nosuchtty", "cannot be opened .* allowed: a channel that"),
    ],
)
def test_interfaces_that_do_not_open(interface: str, channel: str, says: str) -> None:
    with pytest.raises(BusError, match=says) as caught:
        CanPort(BusConfig(name="left", interface=interface, channel=channel))
    message = str(caught.value)
    assert message.startswith(f"left: interface {interface!r}, channel {channel!r}: ")
    assert "\n" not in message


def test_stuck_endpoint_of_a_virtual_bus_loses_its_own_frames_only(monkeypatch) -> None:
    monkeypatch.setattr(port_module, "VIRTUAL_QUEUE_FRAMES", 4)
    config = BusConfig(channel=uuid.uuid4().hex)
    with CanPort(config) as ours, CanPort(config) as stuck, CanPort(config) as well:
        for number in range(10):
            ours.send(number, b"")
            assert receive(well).can_id == number
        assert (ours.sent, ours.undelivered, ours.errors) == (10, 6, 0)
        assert [receive(stuck).can_id for _ in range(4)] == [0, 1, 2, 3]
        assert stuck.recv(0.0) is None


def test_receivers_of_a_virtual_bus_do_not_share_a_message() -> None:
    channel = uuid.uuid4().hex
    with (
        CanPort(BusConfig(channel=channel)) as ours,
        can.Bus(interface="virtual", channel=channel) as one,
        can.Bus(interface="virtual", channel=channel) as two,
    ):
        ours.send(1, b"\x01")
        first, second = one.recv(WAIT_S), two.recv(WAIT_S)
        assert first is not None
        assert second is not None
        first.data[0] = 99
        assert bytes(second.data) == b"\x01"


def test_two_multicast_groups_are_two_buses(multicast_group: str) -> None:
    another = multicast_group.replace("239.74.", "239.75.")
    one, two = (BusConfig(interface="udp_multicast", channel=group) for group in (multicast_group, another))
    with CanPort(one) as ours, CanPort(one) as theirs, CanPort(two) as other:
        ours.send(1, b"")
        assert receive(theirs).can_id == 1
        assert other.recv(0.1) is None


def test_a_frame_of_another_group_that_is_delivered_late_is_discarded_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The kernel accepted it before the port chose its group, and hands it over afterwards."""
    kernel, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with kernel, ours:
        kernel.send(b"accepted before the change")
        delayed = SimpleNamespace(sleep=lambda pause_s: kernel.send(b"delivered after it"))
        monkeypatch.setattr(multicast, "clock", delayed)
        multicast._discard_other_groups(ours)
        with pytest.raises(BlockingIOError):
            ours.recv(1, socket.MSG_DONTWAIT)


def test_a_port_that_opens_hears_nothing_of_a_busy_group_that_is_not_its_own(multicast_group: str) -> None:
    """python-can joins the group before anybody can tell the kernel to hand over no other."""
    busy = BusConfig(interface="udp_multicast", channel=multicast_group.replace("239.74.", "239.75."))
    quiet = BusConfig(interface="udp_multicast", channel=multicast_group)
    done = threading.Event()

    def babble(port: CanPort) -> None:
        while not done.is_set():
            port.send(0x111, b"")
            time.sleep(20e-6)

    with CanPort(busy) as port, CanPort(busy):
        thread = threading.Thread(target=babble, args=[port])
        thread.start()
        try:
            for _ in range(40):
                with CanPort(quiet) as ours:
                    assert ours.recv(0.001) is None
        finally:
            done.set()
            thread.join()


def test_garbage_in_the_multicast_group_is_counted_and_skipped(multicast_group: str) -> None:
    config = BusConfig(interface="udp_multicast", channel=multicast_group)
    with CanPort(config) as port, CanPort(config) as theirs:
        sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for packet in (b"\xff\xff", b"", b"\x81\xa4dlc\x00\x01", bytes(2000)):
            sender.sendto(packet, (multicast_group, 43113))
        sender.close()
        theirs.send(1, b"")
        assert receive(port).can_id == 1
        assert port.malformed >= 3
        assert port.errors == 0


def test_sends_from_many_threads_are_counted_exactly() -> None:
    config = BusConfig(channel=uuid.uuid4().hex)
    with CanPort(config) as ours, CanPort(config) as theirs:
        threads = [
            threading.Thread(target=lambda: [ours.send(1, b"") for _ in range(500)] and None)
            for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        received = 0
        while theirs.recv(0.0) is not None:
            received += 1
        assert ours.sent == received == 2000


def test_queue_of_python_cans_virtual_bus_is_what_we_take_it_for() -> None:
    """``undelivered`` rests on a full receiver raising CanOperationError at once when the time-out is 0."""
    channel = uuid.uuid4().hex
    with (
        can.Bus(interface="virtual", channel=channel) as ours,
        can.Bus(interface="virtual", channel=channel, rx_queue_size=1) as full,
    ):
        ours.send(can.Message(arbitration_id=1), 0.0)
        with pytest.raises(can.CanOperationError):
            ours.send(can.Message(arbitration_id=2), 0.0)
        message = full.recv(0.0)
        assert message is not None
        assert message.arbitration_id == 1
