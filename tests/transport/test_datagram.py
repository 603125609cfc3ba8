"""SocketCAN's reader on datagrams: what it makes of frames, times and drops, in every kernel."""

from __future__ import annotations

import itertools
import socket
import struct
import time
from collections.abc import Callable, Iterator

import pytest

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.transport import Frame
from skinnode.transport.datagram import DatagramPort, datagram, free_channel

MS = 1_000_000


@pytest.fixture
def port() -> Iterator[DatagramPort]:
    with DatagramPort(BusConfig(name="can7", interface="udp", channel=free_channel(), fd=True)) as opened:
        yield opened


@pytest.fixture
def send(port: DatagramPort) -> Iterator[Callable[[bytes], int]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect(("127.0.0.1", int(port.config.channel)))
        yield sock.send


def raw(word: int, data: bytes, size: int = 8) -> bytes:
    """struct can_frame, or canfd_frame with 64, of <linux/can.h>."""
    return struct.pack("<IBBBB", word, len(data), 0, 0, 0) + data.ljust(size, b"\0")


def bare(frame: Frame) -> Frame:
    return frame._replace(t_ns=0)


def test_frames_are_those_of_linux_can_h(port: DatagramPort, send: Callable[[bytes], int]) -> None:
    long = bytes(range(64))
    for packet in (
        raw(0x185, b"12345678"),
        raw(0x80, b""),
        raw(0x184, long, 64),
        raw(0x284, b"short", 64),
        raw(0x305 | 1 << 30, b""),
        raw(0x12345678 | 1 << 31, b"x"),
        raw(0x40 | 1 << 29, bytes(8)),
    ):
        send(packet)
    assert [bare(frame) for frame in port.recv_batch(1.0)] == [
        Frame(0x185, b"12345678", 0),
        Frame(0x80, b"", 0),
        Frame(0x184, long, 0, fd=True),
        Frame(0x284, b"short", 0, fd=True),
        Frame(0x305, b"", 0, remote=True),
        Frame(0x12345678, b"x", 0, extended=True),
        Frame(0x40, bytes(8), 0, error=True),
    ]
    assert port.received == 7


def test_what_the_load_sends_is_what_is_received(port: DatagramPort, send: Callable[[bytes], int]) -> None:
    send(datagram(0x185, b"1234567"))
    send(datagram(0x185, bytes(48), fd=True))
    assert [bare(frame) for frame in port.recv_batch(1.0)] == [
        Frame(0x185, b"1234567", 0),
        Frame(0x185, bytes(48), 0, fd=True),
    ]


def test_a_batch_is_in_order_and_each_frame_has_the_time_it_came(
    port: DatagramPort, send: Callable[[bytes], int]
) -> None:
    for _ in range(100):  # the kernel starts to stamp packets a moment after the first socket asked for it
        send(raw(0, b""))
        sent_ns = time.monotonic_ns()
        time.sleep(0.1)
        if port.recv_batch(1.0)[0].t_ns < sent_ns + 50 * MS:
            break
    begin_ns = time.monotonic_ns()
    for number in range(10):
        send(raw(number, b""))
        time.sleep(0.012)
    batch = port.recv_batch(1.0, 4) + port.recv_batch(1.0)
    assert [frame.can_id for frame in batch] == list(range(10))
    assert min(b.t_ns - a.t_ns for a, b in itertools.pairwise(batch)) >= 10 * MS
    assert begin_ns - MS < batch[0].t_ns < batch[-1].t_ns < time.monotonic_ns()
    assert port.recv_batch(0.0) == []


def test_what_the_kernel_has_no_room_for_is_counted(port: DatagramPort, send: Callable[[bytes], int]) -> None:
    port._bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    for number in range(1000):
        send(raw(number, b"12345678"))
    frames: list[Frame] = []
    while batch := port.recv_batch(0.05):
        frames += batch
    assert 0 < len(frames) < 1000
    assert [frame.can_id for frame in frames] == list(range(len(frames)))  # the newest were dropped
    send(raw(0x7FF, b""))  # the kernel tells with the next frame that it has room for
    assert [frame.can_id for frame in port.recv_batch(1.0)] == [0x7FF]
    assert port.received + port.dropped == 1001


def test_it_only_listens_and_says_why_it_does_not_open(port: DatagramPort) -> None:
    with pytest.raises(BusError, match="0x080 not sent"):
        port.send(0x80, b"")
    with pytest.raises(BusError, match=r"channel '\d+': cannot be opened .* allowed: a free UDP port"):
        DatagramPort(port.config)
    with pytest.raises(BusError, match="channel 'skin': cannot be opened"):
        DatagramPort(port.config.model_copy(update={"channel": "skin"}))
