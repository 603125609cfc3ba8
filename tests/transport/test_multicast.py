"""Packets of udp_multicast: byte for byte those of python-can, and read as python-can reads them."""

from __future__ import annotations

import os
import random
import select
import socket
from collections.abc import Callable, Iterator, Sequence

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.transport import CanPort, Frame

UDP_PORT = 43113  # python-can's default
WAIT_S = 5.0

MESSAGES = {
    "standard": {"arbitration_id": 0x185, "is_extended_id": False, "data": b"12345678"},
    "lowest identifier": {"arbitration_id": 0, "is_extended_id": False, "data": b"\x01"},
    "identifier of one byte": {"arbitration_id": 0x7F, "is_extended_id": False, "data": b"12"},
    "identifier of two bytes": {"arbitration_id": 0x80, "is_extended_id": False},
    "highest identifier": {"arbitration_id": 0x7FF, "is_extended_id": False, "data": b"abcdefgh"},
    "extended": {"arbitration_id": 0x12345678, "data": b"xyz"},
    "extended, lowest": {"arbitration_id": 0, "data": b"xyz"},
    "remote": {"arbitration_id": 0x705, "is_extended_id": False, "is_remote_frame": True, "dlc": 4},
    "remote, empty": {"arbitration_id": 0x705, "is_extended_id": False, "is_remote_frame": True},
    "error": {"arbitration_id": 4, "is_error_frame": True, "data": bytes(8)},
    "FD": {"arbitration_id": 0x185, "is_extended_id": False, "is_fd": True, "data": bytes(range(64))},
    "FD, short": {"arbitration_id": 0x185, "is_extended_id": False, "is_fd": True, "data": b"123"},
    "BRS": {"arbitration_id": 1, "is_fd": True, "bitrate_switch": True, "data": bytes(12)},
    "ESI": {"arbitration_id": 1, "is_fd": True, "error_state_indicator": True, "data": bytes(12)},
    "channel": {"arbitration_id": 0x185, "is_extended_id": False, "channel": "left", "data": b"12345678"},
    "channel, a number": {
        "arbitration_id": 0x185,
        "is_extended_id": False,
        "channel": 3,
        "data": b"87654321",
    },
}


@pytest.fixture
def config(multicast_group: str) -> BusConfig:
    return BusConfig(name="can7", interface="udp_multicast", channel=multicast_group, fd=True)


@pytest.fixture
def port(config: BusConfig) -> Iterator[CanPort]:
    with CanPort(config) as opened:
        yield opened


@pytest.fixture
def send_raw(config: BusConfig) -> Iterator[Callable[[bytes], int]]:
    """Sends a packet to the group, as any program can."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        yield lambda packet: sock.sendto(packet, (config.channel, UDP_PORT))


@pytest.fixture
def raw(config: BusConfig) -> Iterator[socket.socket]:
    """Receives the packets of the group as they are."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((config.channel, UDP_PORT))
        sock.setsockopt(
            socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(config.channel) + bytes(4)
        )
        sock.settimeout(WAIT_S)
        yield sock


def received(port: CanPort, count: int) -> list[Frame]:
    """The next frames, without their times."""
    frames: list[Frame] = []
    while len(frames) < count:
        batch = port.recv_batch(WAIT_S)
        assert batch
        frames += batch
    return [frame._replace(t_ns=0) for frame in frames]


def frame_of(message: can.Message) -> Frame:
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        0,
        message.is_remote_frame,
        message.is_error_frame,
        message.is_extended_id,
        message.is_fd,
    )


def read_by_python_can(packet: bytes) -> Frame | None:
    """What python-can takes a packet for; None: for no frame."""
    try:
        return frame_of(unpack_message(packet, replace={"timestamp": 0.0}, check=True))
    except Exception:
        return None


@pytest.mark.parametrize("kind", MESSAGES)
def test_every_kind_of_frame_of_python_can_arrives(
    config: BusConfig, port: CanPort, plain_bus, kind: str
) -> None:
    message = can.Message(**MESSAGES[kind])
    again = can.Message(
        **MESSAGES[kind], timestamp=1e9
    )  # a kind that the port knows by then, at another time
    again.data = bytearray(byte ^ 0xFF for byte in message.data)
    with plain_bus(config) as theirs:
        for each in (message, again, message):
            theirs.send(each)
    assert received(port, 3) == [frame_of(each) for each in (message, again, message)]
    assert (port.received, port.malformed) == (3, 0)


@pytest.mark.parametrize("remote", [False, True])
@pytest.mark.parametrize("can_id", [0, 0x7F, 0x80, 0xFF, 0x100, 0x7FF])
def test_packets_are_those_of_python_can_byte_for_byte(
    port: CanPort, raw: socket.socket, can_id: int, remote: bool
) -> None:
    channels = set()
    for data in (b"", b"\x00", bytes(range(8)), b"\xff" * 8, *([] if remote else [bytes(range(1, 65))])):
        port.send(can_id, b"" if remote else data, remote=remote)
        packet = raw.recv(4096)
        fields = msgpack.unpackb(packet)
        channels.add(fields["channel"])
        message = can.Message(
            arbitration_id=can_id,
            is_extended_id=False,
            is_remote_frame=remote,
            is_fd=len(data) > 8,
            bitrate_switch=len(data) > 8,
            channel=fields["channel"],
            data=data,
        )
        assert packet == pack_message(message)
    assert len(channels) == 1


def test_packets_of_other_packers_are_read_as_python_can_reads_them(
    port: CanPort, send_raw: Callable[[bytes], int]
) -> None:
    whole = msgpack.unpackb(
        pack_message(can.Message(arbitration_id=0x285, is_extended_id=False, data=b"abc"))
    )
    few = {"arbitration_id": 0x123, "is_extended_id": False, "data": b"12"}
    wide = pack_message(can.Message(arbitration_id=5, is_extended_id=False, data=b"wide")).replace(
        b"arbitration_id\x05", b"arbitration_id\xce\x00\x00\x00\x05"
    )
    packets = [
        msgpack.packb(dict(reversed(whole.items()))),
        msgpack.packb(dict(sorted(whole.items()))),
        msgpack.packb(few),
        msgpack.packb(few | {"data": [1, 2, 3]}),
        msgpack.packb(few | {"channel": "a" * 600, "dlc": 2}),
        msgpack.packb(few | {"data": b"\xa4data\xc4\x01\x02"}),
        msgpack.packb(whole | {"timestamp": 7}),
        msgpack.packb(whole | {"timestamp": float("nan")}),
        wide,
    ]
    packets += packets  # once more, when their kinds are known
    for packet in packets:
        send_raw(packet)
    expected = [read_by_python_can(packet) for packet in packets]
    assert None not in expected
    assert received(port, len(packets)) == expected
    assert port.malformed == 0


def test_data_that_looks_like_a_packet_is_data(port: CanPort, config: BusConfig) -> None:
    looks = b"\xa4data\xc4\x08"
    with CanPort(config) as theirs:
        for data in (looks, looks * 5, b"\xa4data\xc4\x02", looks[::-1], looks):
            theirs.send(0x185, data)
    frames = received(port, 5)
    assert [frame.data.rstrip(b"\0") for frame in frames] == [
        *(looks, looks * 5, b"\xa4data\xc4\x02", looks[::-1], looks)
    ]


def damaged(packets: Sequence[bytes], dice: random.Random) -> bytes:
    """One of the packets with a few bytes changed, cut out, put in or taken from another."""
    packet = bytearray(dice.choice(packets))
    for _ in range(dice.choice((1, 1, 1, 2, 8))):
        at = dice.randrange(len(packet) + 1)
        match dice.randrange(5):
            case 0:
                packet[at : at + 1] = dice.randbytes(1)
            case 1:
                del packet[at : at + dice.choice((1, 2, 40))]
            case 2:
                packet[at:at] = dice.randbytes(dice.choice((1, 2, 9)))
            case 3:
                other = dice.choice(packets)
                packet[at:] = other[at:]
            case _:
                packet[12:20] = dice.randbytes(8)  # the timestamp
    return bytes(packet)


def test_damaged_packets_are_frames_or_garbage_as_python_can_judges(
    port: CanPort, send_raw: Callable[[bytes], int]
) -> None:
    dice = random.Random(7)
    sound = [pack_message(can.Message(**fields)) for fields in MESSAGES.values()]
    packets = [damaged(sound, dice) if dice.random() < 0.7 else dice.choice(sound) for _ in range(4000)]
    expected = [read_by_python_can(packet) for packet in packets]
    frames: list[Frame] = []
    for first in range(0, len(packets), 200):
        for packet in packets[first : first + 200]:
            send_raw(packet)
        while batch := port.recv_batch(0.0):
            frames += [frame._replace(t_ns=0) for frame in batch]
    assert frames == [frame for frame in expected if frame is not None]
    assert port.malformed == expected.count(None)
    assert 500 < port.malformed < 3500
    assert (port.errors, port.dropped) == (0, 0)


def test_garbage_after_own_frames_is_counted_exactly(port: CanPort, send_raw: Callable[[bytes], int]) -> None:
    for _ in range(3):
        port.send(0x185, b"12345678")
    assert port.recv_batch(0.05) == []
    for packet in (b"", b"x", bytes(60)):  # into the buffers that still hold what came before
        send_raw(packet)
    assert port.recv_batch(0.05) == []
    assert (port.received, port.malformed) == (0, 3)


def test_own_frames_with_any_identifier_do_not_come_back_but_reach_other_ports_of_the_process(
    config: BusConfig, port: CanPort
) -> None:
    ids = [0, 1, 0x7F, 0x80, 0xFF, 0x100, 0x7FF]
    with CanPort(config) as theirs:
        for can_id in ids * 2:
            port.send(can_id, b"12")
        assert [frame.can_id for frame in received(theirs, 14)] == ids * 2
        theirs.send(3, b"")
        assert [frame.can_id for frame in received(port, 1)] == [3]
        assert port.received == 1


def test_what_the_kernel_has_no_room_for_is_counted(config: BusConfig, port: CanPort) -> None:
    with socket.socket(fileno=os.dup(port.fileno())) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    with CanPort(config) as theirs:
        for number in range(500):
            theirs.send(number, b"12345678")
        frames: list[Frame] = []
        while batch := port.recv_batch(0.05):
            frames += batch
        assert 0 < len(frames) < 500
        assert [frame.can_id for frame in frames] == list(range(len(frames)))  # the newest were dropped
        theirs.send(0x7FF, b"")  # the kernel tells with the next frame that it has room for
        assert [frame.can_id for frame in received(port, 1)] == [0x7FF]
        assert port.received + port.dropped == 501
        dropped = port.dropped
        port.reopen()
        assert port.dropped == dropped


def test_frames_beyond_the_number_asked_for_come_next(config: BusConfig, port: CanPort) -> None:
    with CanPort(config) as theirs:
        for number in range(600):  # more than a system call fetches
            theirs.send(number, b"")
    batches = [port.recv_batch(WAIT_S, most) for most in (1, 2, 300)]
    assert [len(batch) for batch in batches[:2]] == [1, 2]
    frames = [*batches[0], *batches[1], *batches[2]]
    while len(frames) < 600:
        frames += port.recv_batch(WAIT_S)
    assert [frame.can_id for frame in frames] == list(range(600))


def test_a_frame_wakes_who_polls(config: BusConfig, port: CanPort) -> None:
    poll = select.poll()
    poll.register(port.fileno(), select.POLLIN)
    assert poll.poll(0) == []
    with CanPort(config) as theirs:
        theirs.send(1, b"")
        assert poll.poll(WAIT_S * 1e3) == [(port.fileno(), select.POLLIN)]
    assert port.pollable
    assert port.reads_batches


def test_a_reopened_port_keeps_its_counts_and_no_file(
    config: BusConfig, port: CanPort, send_raw: Callable[[bytes], int]
) -> None:
    files = len(os.listdir("/proc/self/fd"))
    with CanPort(config) as theirs:
        for _ in range(3):
            send_raw(b"garbage")
            theirs.send(1, b"")
            received(port, 1)
            port.send(2, b"")
            port.reopen()
        theirs.send(4, b"")
        assert [frame.can_id for frame in received(port, 1)] == [4]  # and not its own
    assert (port.received, port.malformed, port.sent) == (4, 3, 3)
    assert len(os.listdir("/proc/self/fd")) == files
    port.close()
    assert len(os.listdir("/proc/self/fd")) == files - 1
    assert port.fileno() == -1
    with pytest.raises(BusError, match=r"0x001 not sent \(\[Errno 9\] Bad file descriptor\)$"):
        port.send(1, b"")


def test_a_group_of_ipv6() -> None:
    group = f"ff15:7079:{random.randrange(1 << 16):x}::1"
    config = BusConfig(name="can7", interface="udp_multicast", channel=group)
    try:
        ports = [CanPort(config), CanPort(config)]
        ports[0].send(1, b"first")
    except BusError as error:
        pytest.skip(f"no IPv6 multicast on this machine: {error}")
    ours, theirs = ports
    with ours, theirs:
        assert [frame.data for frame in received(theirs, 1)] == [b"first"]
        theirs.send(2, b"second")
        assert [frame.data for frame in received(ours, 1)] == [b"second"]


def test_a_full_send_buffer_delays_frames_and_loses_none(config: BusConfig, port: CanPort) -> None:
    """The buffer holds about four packets, which a network card may keep for a while."""
    with CanPort(config) as theirs:
        with socket.socket(fileno=os.dup(theirs.fileno())) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
        for number in range(1000):
            theirs.send(number, b"12345678")
    assert [frame.can_id for frame in received(port, 1000)] == list(range(1000))
