"""Access types, limits and lengths: a dictionary made for the purpose, asked through the SDO server."""

from __future__ import annotations

import struct

import pytest

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.dictionary import DataType, Entry, Object, ObjectType
from skinnode.node.object_dictionary import MAX_BYTES, ObjectStore
from skinnode.node.sdo.server import SdoServer

INDEX = 0x2000
WRITE_ONLY, READ_ONLY, NO_SUBINDEX = "01 00 01 06", "02 00 01 06", "11 00 09 06"
TOO_HIGH, TOO_LOW, TOO_LONG, TOO_SHORT = "31 00 09 06", "32 00 09 06", "12 00 07 06", "13 00 07 06"
OUT_OF_MEMORY = "05 00 04 05"


class Server:
    """An SDO server of one variable."""

    def __init__(
        self, data_type: DataType, access: str = "rw", default: int | str = 0, **limits: int
    ) -> None:
        entry = Entry(INDEX, 0, "it", data_type, access, default, **limits)
        self.store = ObjectStore([Object(INDEX, "it", ObjectType.VAR, (entry,))], 4)
        self._answers: list[str] = []
        self._server = SdoServer(self.store, lambda data: self._answers.append(data.hex(" ")))

    def ask(self, request: bytes) -> str:
        self._server.on_request(request.ljust(8, b"\0"), 0)
        return self._answers.pop()

    def write(self, data: bytes) -> str:
        """The abort code, or nothing."""
        answer = self.ask(struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, INDEX, 0) + data)
        return answer[12:] if answer.startswith("80") else ""

    def read(self) -> str:
        return self.ask(struct.pack("<BHB", 0x40, INDEX, 0))

    def write_segments(self, data: bytes) -> str:
        """Without saying how much: the last answer."""
        answer = self.ask(struct.pack("<BHB", 0x20, INDEX, 0))
        parts = [data[at : at + 7] for at in range(0, len(data), 7)] or [b""]
        for number, part in enumerate(parts):
            if answer.startswith("80"):
                break
            command = (number & 1) << 4 | (7 - len(part)) << 1 | (number + 1 == len(parts))
            answer = self.ask(bytes((command,)) + part)
        return answer


@pytest.mark.parametrize(
    ("access", "readable", "writable"),
    [
        ("ro", True, False),
        ("const", True, False),
        ("rw", True, True),
        ("rwr", True, True),
        ("rww", True, True),
        ("wo", False, True),
    ],
)
def test_access_types(access: str, readable: bool, writable: bool) -> None:
    server = Server(DataType.UNSIGNED16, access, default=7)
    assert server.write(b"\x08\x00") == ("" if writable else READ_ONLY)
    assert server.store.integer(INDEX) == (8 if writable else 7)
    if readable:
        assert server.read() == f"4b 00 20 00 {8 if writable else 7:02x} 00 00 00"
    else:
        assert server.read() == f"80 00 20 00 {WRITE_ONLY}"


@pytest.mark.parametrize(
    ("data_type", "low", "high"),
    [
        (DataType.UNSIGNED8, 3, 200),
        (DataType.UNSIGNED16, 0x1000, 0xFF00),
        (DataType.UNSIGNED24, 1, 0xFFFFFE),
        (DataType.UNSIGNED32, 0x80, 0xFFFFFFFE),
        (DataType.UNSIGNED8, 5, 5),  # one value only
        (DataType.UNSIGNED32, 0, 0),
    ],
)
def test_limits_are_part_of_the_range(data_type: DataType, low: int, high: int) -> None:
    server, size = Server(data_type, default=low, low=low, high=high), data_type.bits // 8
    for value in (low, high):
        assert server.write(value.to_bytes(size, "little")) == ""
        assert server.store.integer(INDEX) == value
    assert server.write((high + 1).to_bytes(size, "little")) == TOO_HIGH
    if low:
        assert server.write((low - 1).to_bytes(size, "little")) == TOO_LOW
    assert server.store.integer(INDEX) == high


@pytest.mark.parametrize(
    ("data_type", "size"),
    [
        (DataType.UNSIGNED8, 1),
        (DataType.UNSIGNED16, 2),
        (DataType.UNSIGNED24, 3),
        (DataType.UNSIGNED32, 4),
        (DataType.REAL32, 4),
    ],
)
def test_length_is_that_of_the_type(data_type: DataType, size: int) -> None:
    server = Server(data_type)
    for length in range(1, 5):
        expected = "" if length == size else TOO_LONG if length > size else TOO_SHORT
        assert server.write(b"\x01".ljust(length, b"\0")) == expected
    assert server.write_segments(b"")[12:] == TOO_SHORT
    assert server.write_segments(bytes(size + 1))[12:] == TOO_LONG
    assert server.write_segments(b"\x02".ljust(size, b"\0"))[:2] == "20"
    assert server.store.raw(INDEX, 0) == b"\x02".ljust(size, b"\0")


def test_text_has_any_length_there_is_memory_for() -> None:
    server = Server(DataType.VISIBLE_STRING, default="hand")
    for text in (b"", b"a", b"left", b"right", bytes(MAX_BYTES)):
        assert server.write_segments(text)[:2] in ("20", "30")
        assert server.store.raw(INDEX, 0) == text
    assert server.write_segments(bytes(MAX_BYTES + 1))[12:] == OUT_OF_MEMORY
    assert server.ask(struct.pack("<BHBI", 0x21, INDEX, 0, MAX_BYTES + 1))[12:] == OUT_OF_MEMORY
    assert server.store.raw(INDEX, 0) == bytes(MAX_BYTES)


def test_empty_text_is_read_in_one_empty_segment() -> None:
    server = Server(DataType.VISIBLE_STRING, default="")
    assert server.read() == "41 00 20 00 00 00 00 00"
    assert server.ask(b"\x60") == "0f 00 00 00 00 00 00 00"
    server.ask(struct.pack("<BHBB", 0xA4, INDEX, 0, 127))
    assert server.ask(b"\xa3") == "81 00 00 00 00 00 00 00"
    assert server.ask(b"\xa2\x01\x7f") == "dd 00 00 00 00 00 00 00"


def test_the_whole_object_as_sub_index_255_is_not_offered() -> None:
    server = Server(DataType.UNSIGNED16)
    assert server.ask(struct.pack("<BHB", 0x40, INDEX, 0xFF))[12:] == NO_SUBINDEX


def test_abort_codes_are_those_of_table_22() -> None:
    codes = """
        05030000 05040000 05040001 05040002 05040003 05040004 05040005 06010000
        06010001 06010002 06020000 06040041 06040042 06040043 06040047 06060000
        06070010 06070012 06070013 06090011 06090030 06090031 06090032 06090036
        060A0023 08000000 08000020 08000021 08000022 08000023 08000024
    """
    assert [f"{code:08X}" for code in AbortCode] == codes.split()


def test_any_code_a_part_of_the_node_refuses_with_reaches_the_client() -> None:
    server = Server(DataType.UNSIGNED8)
    for code in AbortCode:

        def refuse(_index: int, _value: int, code: AbortCode = code) -> None:
            raise Refused(code)

        server.store.guard(INDEX, refuse)
        assert server.write(b"\1") == struct.pack("<I", code).hex(" ")
