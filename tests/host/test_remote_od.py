"""The object dictionary of a node: values and refusals are the node's, exceptions are ours."""

from __future__ import annotations

import struct

import pytest
from canopen.sdo.client import SdoClient

from skinnode.errors import BusError, NodeError, NodeTimeout, SdoAbort
from skinnode.host import sdo_streams
from skinnode.host.sdo_client import ATTEMPTS, RemoteOd, SkinNetwork

NO_OBJECT = 0x0602_0000


class Server:
    """A node with a few objects of at most four bytes, which it transfers expedited (CiA 301, 7.2.4.3.3 and
    7.2.4.3.6). Sending the next frames raises ``raises``, where that is not None; the next requests are
    aborted with ``aborts``."""

    def __init__(self, objects: dict[tuple[int, int], bytes]) -> None:
        self.objects, self.silent = objects, False
        self.raises: list[Exception | None] = []
        self.aborts: list[int] = []
        self.requests: list[bytes] = []
        self.written: list[tuple[int, int]] = []
        self.defects: list[str] = []
        self.network = SkinNetwork(self._on_request)
        self.remote = RemoteOd(self.network, 5, lambda error: self.defects.append(repr(error)))

    def _on_request(self, can_id: int, data: bytes) -> None:
        self.requests.append(data)
        if self.raises and (error := self.raises.pop(0)) is not None:
            raise error
        command, index, subindex = struct.unpack_from("<BHB", data)
        if self.silent or command == 0x80:
            return
        at, value = (index, subindex), self.objects.get((index, subindex))
        if self.aborts:
            answer = struct.pack("<BHBI", 0x80, *at, self.aborts.pop(0))
        elif value is None:
            answer = struct.pack("<BHBI", 0x80, *at, NO_OBJECT)
        elif command == 0x40:
            answer = struct.pack("<BHB4s", 0x43 | (4 - len(value)) << 2, *at, value)
        else:
            self.objects[at] = data[4 : 8 - (command >> 2 & 3)]
            self.written.append(at)
            answer = struct.pack("<BHBI", 0x60, *at, 0)
        self.network.notify(0x585, bytearray(answer), 0.0)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Server:
    """Its answers come at once, or never."""
    monkeypatch.setattr(SdoClient, "RESPONSE_TIMEOUT", 0.01)
    monkeypatch.setattr(sdo_streams, "_QUIET_S", 0.001)
    return Server({(0x1000, 0): bytes(4), (0x1017, 0): b"\xfa\x00"})


def test_a_node_answers_with_a_value_or_an_abort(server: Server) -> None:
    assert server.remote.answers()
    del server.objects[0x1000, 0]
    assert server.remote.answers()
    assert server.defects == []


def test_a_node_is_asked_for_its_device_type(server: Server) -> None:
    """Every CANopen node has that object, and a question about it changes nothing."""
    assert server.remote.answers()
    assert server.requests == [bytes.fromhex("40 00 10 00 00 00 00 00")]


def test_a_silent_node_does_not_answer_and_is_no_defect_of_the_host(server: Server) -> None:
    server.silent = True
    assert not server.remote.answers()
    with pytest.raises(NodeTimeout, match=r"^node 5: read of object 0x1017:0: no response"):
        server.remote.read(0x1017, 0, "u16")
    assert server.defects == []
    server.silent = False
    assert server.remote.answers()
    assert server.remote.read(0x1017, 0, "u16") == 250


def test_an_exception_of_ours_is_reported_and_costs_one_try(server: Server) -> None:
    server.raises = [ZeroDivisionError("of ours")]
    assert not server.remote.answers()
    assert server.remote.answers()
    server.raises = [ZeroDivisionError("of ours"), None, ZeroDivisionError("of ours")]  # and an abort between
    assert server.remote.read(0x1017, 0, "u16") == 250
    assert server.defects == ["ZeroDivisionError('of ours')"] * 3


def test_an_interface_that_takes_no_request_is_neither_silence_nor_a_defect(server: Server) -> None:
    for ask in (server.remote.answers, lambda: server.remote.read(0x1017, 0, "u16")):
        server.raises = [BusError("can0: 0x605 not sent")]
        with pytest.raises(BusError, match="not sent"):
            ask()
    assert server.defects == []


@pytest.mark.parametrize("data", [b"\xfa", b"\xfa\x00\x00", b"\xfa\x00\x00\x00"])
def test_a_value_of_another_length_is_named(server: Server, data: bytes) -> None:
    server.objects[0x1017, 0] = data
    with pytest.raises(NodeError) as caught:
        server.remote.read(0x1017, 0, "u16")
    assert str(caught.value) == f"node 5: object 0x1017:0: got {data.hex(' ')}, expected 2 bytes (u16)"


def test_an_abort_is_told_with_its_code(server: Server) -> None:
    with pytest.raises(SdoAbort) as caught:
        server.remote.read(0x1018, 9, "u32")
    assert caught.value.code == NO_OBJECT
    assert str(caught.value) == (
        "node 5: SDO abort 0x06020000: read of object 0x1018:9: Object does not exist"
    )


OUT_OF_STEP = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid",
    0x0504_0002: "invalid block size",
    0x0504_0003: "invalid sequence number",
    0x0504_0004: "CRC error",
}
"""Aborts of a node that missed a frame (CiA 301, table 22)."""


@pytest.mark.parametrize("code", OUT_OF_STEP, ids=OUT_OF_STEP.values())
def test_a_transfer_that_a_node_aborts_because_it_missed_a_frame_is_tried_again(
    server: Server, code: int
) -> None:
    server.aborts = [code]
    assert server.remote.read(0x1017, 0, "u16") == 250
    server.aborts = [code] * 5
    with pytest.raises(SdoAbort) as caught:
        server.remote.read(0x1017, 0, "u16")
    assert caught.value.code == code
    assert len(server.aborts) == 5 - ATTEMPTS


@pytest.mark.parametrize("code", [0x0601_0002, 0x0609_0030, 0x0800_0022])
def test_a_node_that_refuses_is_not_asked_again(server: Server, code: int) -> None:
    server.aborts = [code, code]
    with pytest.raises(SdoAbort) as caught:
        server.remote.write(0x1017, 0, "u16", 100)
    assert (caught.value.code, server.aborts) == (code, [code])


def test_only_what_differs_is_written(server: Server) -> None:
    """Each write to a node of another master's may be one too many."""
    server.remote.write_if_different(0x1017, 0, "u16", 250)
    assert server.written == []
    server.remote.write_if_different(0x1017, 0, "u16", 100)
    assert server.written == [(0x1017, 0)]
    assert server.remote.read(0x1017, 0, "u16") == 100
