"""Uploads without an end, or longer than any value: the transfer ends, the host and the commands go on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from skinnode.config import HandConfig
from skinnode.errors import NodeError
from skinnode.host import Condition, Host
from skinnode.host.sdo_client import Abandoned, RemoteOd, SkinNetwork
from skinnode.process import clock
from skinnode.transport import CanPort

from .conftest import Rack, eventually

ANNOUNCED = {"no size": None, "4 GB": 0xFFFF_FFFF, "nothing": 0, "less": 5}


class Endless:
    """An SDO server whose uploads never end: frames of CiA 301, 7.2.4.3, none of which is the last."""

    def __init__(self, announced: int | None, reply: Callable[[bytes], None]) -> None:
        self._announced, self._reply = announced, reply
        self.aborted: list[bytes] = []

    def on_request(self, data: bytes) -> None:
        command = data[0] >> 5
        size = b"\0\0\0\0" if self._announced is None else self._announced.to_bytes(4, "little")
        has_size = self._announced is not None
        if data[0] == 0x80:
            self.aborted.append(data)
        elif command == 2:  # initiate upload: segmented
            self._reply(bytes([0x41 if has_size else 0x40]) + data[1:4] + size)
        elif command == 3:  # upload segment, with the toggle bit of the request
            self._reply(bytes([data[0] & 0x10]) + b"endless")
        elif command == 5 and data[0] & 3 == 0:  # initiate block upload
            self._reply(bytes([0xC2 if has_size else 0xC0]) + data[1:4] + size)
        elif command == 5 and data[0] & 3 != 1:  # start, or the next block
            for number in range(1, 128):
                self._reply(bytes([number]) + b"endless")


@pytest.mark.system_time  # no bus: an answer takes no time, only computing does
@pytest.mark.parametrize("announced", ANNOUNCED.values(), ids=list(ANNOUNCED))
@pytest.mark.parametrize("how", ["number", "text", "block", "large"])
def test_an_upload_that_does_not_end_is_an_error_and_is_aborted(announced: int | None, how: str) -> None:
    network = SkinNetwork(lambda can_id, data: server.on_request(data))
    server = Endless(announced, lambda data: network.notify(0x585, bytearray(data), 0.0))
    remote = RemoteOd(network, 5)
    read: dict[str, Callable[[], object]] = {
        "number": lambda: remote.read(0x1018, 1, "u32"),
        "text": lambda: remote.read_bytes(0x1008, 0),
        "block": lambda: remote.read_block(0x2301, 1200),
        "large": lambda: remote.read_large(0x2301),
    }
    begun_s = clock.monotonic()
    with pytest.raises(NodeError, match=r"node 5: (block )?read of object 0x\w+:\d: got .*, expected "):
        read[how]()
    assert clock.monotonic() - begun_s < 10.0
    assert server.aborted


def test_a_node_whose_device_type_has_no_end_answers() -> None:
    network = SkinNetwork(lambda can_id, data: server.on_request(data))
    server = Endless(None, lambda data: network.notify(0x585, bytearray(data), 0.0))
    assert RemoteOd(network, 5).answers()


def test_an_abandoned_transfer_ends_at_the_next_segment() -> None:
    network = SkinNetwork(lambda can_id, data: server.on_request(data))

    def slowly(data: bytes) -> None:
        clock.sleep(0.01)
        network.notify(0x585, bytearray(data), 0.0)

    server = Endless(None, slowly)
    remote = RemoteOd(network, 5)
    end_s = clock.monotonic() + 0.1
    with remote.abort_if(lambda: clock.monotonic() > end_s), pytest.raises(Abandoned):
        remote.read_bytes(0x1008, 0)
    assert clock.monotonic() < end_s + 1.0
    assert len(server.aborted) == 1
    assert server.aborted[0][1:4] == bytes((0x08, 0x10, 0))


@contextmanager
def endless_node(port: CanPort, node_id: int) -> Iterator[None]:
    """A pre-operational node on the bus of ``port``."""
    over = clock.event()
    server = Endless(None, lambda data: port.send(0x580 + node_id, data))

    def serve() -> None:
        port.send(0x700 + node_id, b"\x00")
        beat_s = 0.0
        while not over.is_set():
            if clock.monotonic() > beat_s:
                beat_s = clock.monotonic() + 0.1
                port.send(0x700 + node_id, b"\x7f")
            for frame in port.recv_batch(0.01, 16):
                if frame.can_id == 0x600 + node_id:
                    server.on_request(frame.data)

    thread = clock.thread(serve, "endless node")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def endless_node_after(rack: Rack, port: CanPort) -> Iterator[Callable[[], None]]:
    """What is given pulls p0 and puts an endless node in its place until the end of the block."""
    with ExitStack() as stack:

        def swap() -> None:
            rack.pull("p0")
            stack.enter_context(endless_node(port, 5))

        yield swap


@pytest.mark.long
def test_a_host_names_such_a_node_and_serves_the_others(
    make_hand: Callable[..., HandConfig],
    rack_of: Callable[[HandConfig], Rack],
    listener_of: Callable[[HandConfig], CanPort],
) -> None:
    hand = make_hand(2)
    rack = rack_of(hand)
    rack.plug("p1")
    with endless_node(listener_of(hand), 5):
        begun_s = clock.monotonic()
        with (
            pytest.raises(NodeError, match="node 5: read of object 0x1018:1: got more than"),
            Host.from_config(hand),
        ):
            pass
        assert clock.monotonic() - begun_s < 5.0
    rack.plug("p0")
    with endless_node_after(rack, listener_of(hand)) as swap, Host.from_config(hand) as host:
        swap()
        assert eventually(lambda: host.health("p0").condition is Condition.REFUSED)
        assert "got more than" in host.health("p0").reason
        solved = host.stats().patches["p1"].solved
        assert eventually(lambda: host.stats().patches["p1"].solved > solved + 5)
        begun_s = clock.monotonic()
    assert clock.monotonic() - begun_s < 3.0
