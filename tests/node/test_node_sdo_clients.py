"""The SDO server on a bus, asked by two clients that are not ours: the canopen library, and python-can with
frames written by hand."""

from __future__ import annotations

import binascii
import contextlib
import io
import itertools
import struct
import uuid
from collections.abc import Iterator

import can
import canopen
import numpy as np
import pytest

from skinnode.config import BusConfig
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NodeRunner, PatchNode
from skinnode.protocol.coordinates import pack_coordinates
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort

WAIT_S = 5.0
LAYOUT = PatchLayout.preset("staggered")  # 10 × 30: 300 R0, 4800 bytes of coordinates
NAME = b"skinnode patch"


class Steady:
    def read(self, t_ns: int) -> Float:
        return np.full(LAYOUT.shape, 1234.5)


@contextlib.contextmanager
def node_on(config: BusConfig) -> Iterator[None]:
    """A node of node-ID 4 on a bus."""
    with CanPort(config) as port:
        node = PatchNode(4, LAYOUT, Steady(), send=port.send, serial=7)
        with NodeRunner(port, [node]):
            yield


@pytest.fixture
def sdo() -> Iterator[canopen.sdo.SdoClient]:
    config = BusConfig(channel=uuid.uuid4().hex)
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05  # how long the library takes to disconnect
    network.connect(interface="virtual", channel=config.channel)
    eds = io.StringIO(eds_text(PatchProfile.from_layout(LAYOUT)))
    eds.name = "patch.eds"
    remote = network.add_node(4, canopen.import_od(eds, 4))
    remote.sdo.RESPONSE_TIMEOUT = WAIT_S
    try:
        with node_on(config):
            yield remote.sdo
    finally:
        network.disconnect()


def read(sdo: canopen.sdo.SdoClient, index: int, subindex: int, how: str) -> bytes:
    if how == "plain":
        return sdo.upload(index, subindex)
    options = {"block_transfer": True, "request_crc_support": how == "block with CRC"}
    with sdo.open(index, subindex, "rb", **options) as stream:
        return stream.read()


def write(sdo: canopen.sdo.SdoClient, index: int, subindex: int, data: bytes, how: str) -> None:
    if how in ("plain", "segmented"):
        sdo.download(index, subindex, data, force_segment=how == "segmented")
        return
    crc = how == "block with CRC"
    options = {"size": len(data), "block_transfer": True, "request_crc_support": crc}
    with sdo.open(index, subindex, "wb", **options) as stream:
        stream.write(data)


UPLOADS = ["plain", "block with CRC", "block without CRC"]
DOWNLOADS = ["plain", "segmented", "block with CRC", "block without CRC"]


class TestCanopenLibrary:
    @pytest.mark.parametrize("how", UPLOADS)
    def test_reads_every_kind_of_object(self, sdo: canopen.sdo.SdoClient, how: str) -> None:
        for index, subindex, value in (
            (0x1001, 0, b"\0"),
            (0x1017, 0, b"\0\0"),
            (0x1018, 4, struct.pack("<I", 7)),
            (0x1008, 0, NAME),
            (0x2000, 6, struct.pack("<f", 0.25)),
            (0x2209, 30, struct.pack("<f", 1234.5)),
            (0x2300, 0, pack_coordinates(LAYOUT)),
            (0x2301, 0, struct.pack("<f", 1234.5) * 300),
        ):
            assert read(sdo, index, subindex, how) == value, hex(index)

    @pytest.mark.parametrize("how", DOWNLOADS)
    def test_writes_every_kind_of_object(self, sdo: canopen.sdo.SdoClient, how: str) -> None:
        whole = np.arange(1, 301, dtype="<f4").tobytes()
        for index, subindex, value in (
            (0x1019, 0, b"\x0a"),
            (0x1015, 0, struct.pack("<H", 5)),
            (0x1016, 1, struct.pack("<I", 0x0001_FFFF)),
            (0x2200, 3, struct.pack("<f", 99.5)),
            (0x2301, 0, whole),
        ):
            write(sdo, index, subindex, value, how)
            assert sdo.upload(index, subindex) == value, hex(index)
        assert sdo[0x2209][30].raw == 300.0

    @pytest.mark.parametrize("how", ["segmented", "block with CRC", "block without CRC"])
    def test_is_told_why_not(self, sdo: canopen.sdo.SdoClient, how: str) -> None:
        for index, subindex, value, code in (
            (0x1018, 4, bytes(4), 0x06010002),
            (0x1017, 0, bytes(3), 0x06070012),
            (0x1017, 0, bytes(1), 0x06070013),
            (0x2301, 0, bytes(1201), 0x06070012),
            (0x2301, 0, bytes(1200), 0x06090030),
            (0x2500, 0, bytes(1), 0x06020000),
            (0x1018, 9, bytes(1), 0x06090011),
        ):
            with pytest.raises(canopen.SdoAbortedError) as caught:
                write(sdo, index, subindex, value, how)
            assert caught.value.code == code, hex(index)
        assert sdo[0x2200][1].raw == 1234.5

    @pytest.mark.parametrize("how", ["plain", "block with CRC"])
    def test_lost_segments_of_a_block_are_asked_for_again(self, sdo: canopen.sdo.SdoClient, how: str) -> None:
        """Two answers, far apart since the library gets over one at a time, do not reach it. It gives up on a
        plain transfer, and gets the whole value by block transfer."""
        heard = sdo.on_response
        count = itertools.count(1)

        def lossy(can_id: int, data: bytearray, timestamp: float) -> None:
            if next(count) not in (30, 300):
                heard(can_id, data, timestamp)

        sdo.network.unsubscribe(sdo.tx_cobid)
        sdo.network.subscribe(sdo.tx_cobid, lossy)
        sdo.RESPONSE_TIMEOUT = 0.5  # less than the server's
        if how == "plain":
            with pytest.raises(canopen.SdoCommunicationError):
                read(sdo, 0x2300, 0, how)
        else:
            assert read(sdo, 0x2300, 0, how) == pack_coordinates(LAYOUT)


class Client:
    """As few lines as a client can have, over raw frames."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send(self, data: bytes) -> None:
        frame = can.Message(arbitration_id=0x604, data=data.ljust(8, b"\0"), is_extended_id=False)
        self._bus.send(frame)

    def receive(self) -> bytes:
        while (frame := self._bus.recv(WAIT_S)) is not None:
            if frame.arbitration_id == 0x584:
                return bytes(frame.data)
        raise TimeoutError("no answer")

    def ask(self, data: bytes) -> bytes:
        self.send(data)
        return self.receive()


@pytest.fixture
def client(any_bus: BusConfig, plain_bus) -> Iterator[Client]:
    with plain_bus(any_bus) as bus, node_on(any_bus):
        yield Client(bus)


class TestPythonCan:
    def test_block_upload(self, client: Client) -> None:
        first = client.ask(struct.pack("<BHBB", 0xA4, 0x2300, 0, 100))
        assert first == struct.pack("<BHBI", 0xC6, 0x2300, 0, 4800)
        client.send(b"\xa3")
        value, expected = b"", 1
        while True:
            segment = client.receive()
            assert segment[0] & 0x7F == expected
            value += segment[1:]
            last, expected = segment[0] & 0x80, expected + 1
            if last or expected > 100:
                client.send(bytes((0xA2, expected - 1, 100)))
                expected = 1
            if last:
                break
        command, crc = struct.unpack("<BH5x", client.receive())
        client.send(b"\xa1")
        assert command & 0xE3 == 0xC1
        value = value[: len(value) - (command >> 2 & 7)]
        assert value == pack_coordinates(LAYOUT)
        assert crc == binascii.crc_hqx(value, 0)
        assert client.ask(bytes.fromhex("4000100000000000")) == bytes.fromhex("4300100000000000")

    def test_block_download(self, client: Client) -> None:
        value = np.linspace(500.0, 900.0, 300, dtype="<f4").tobytes()
        answer = client.ask(struct.pack("<BHBI", 0xC6, 0x2301, 0, len(value)))
        assert answer[:4] == struct.pack("<BHB", 0xA4, 0x2301, 0)
        parts = [value[at : at + 7] for at in range(0, len(value), 7)]
        while parts:
            block, parts = parts[: answer[4]], parts[answer[4] :]
            for number, part in enumerate(block, 1):
                last = not parts and number == len(block)
                client.send(bytes((number | last << 7,)) + part)
            assert client.receive()[:2] == bytes((0xA2, len(block)))
        unused = -len(value) % 7
        assert client.ask(struct.pack("<BH", 0xC1 | unused << 2, binascii.crc_hqx(value, 0)))[0] == 0xA1
        assert client.ask(struct.pack("<BHB", 0x40, 0x2209, 30))[4:] == struct.pack("<f", 900.0)

    def test_segmented_both_ways(self, client: Client) -> None:
        assert client.ask(struct.pack("<BHB", 0x40, 0x1008, 0)) == struct.pack("<BHBI", 0x41, 0x1008, 0, 14)
        assert client.ask(b"\x60") + client.ask(b"\x70") == b"\x00" + NAME[:7] + b"\x11" + NAME[7:]
        assert client.ask(struct.pack("<BHBI", 0x21, 0x1017, 0, 2))[0] == 0x60
        assert client.ask(b"\x0b\xe8\x03")[0] == 0x20
        assert client.ask(struct.pack("<BHB", 0x40, 0x1017, 0))[4:6] == b"\xe8\x03"
