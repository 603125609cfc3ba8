"""The dictionary a node answers from is the one its EDS describes: read by the canopen library, asked by
SDO."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes, eds

from skinnode.model.layout import PatchLayout
from skinnode.protocol.coordinates import pack_coordinates
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile

COMPUTED = {0x1010, 0x1011}  # says 0, cannot store, whatever the EDS of the finished device promises


def variables(dictionary: canopen.ObjectDictionary) -> Iterator[ODVariable]:
    for item in dictionary.values():
        if isinstance(item, ODVariable):
            yield item
        else:
            yield from item.subindices.values()


def upload(desk, index: int, subindex: int) -> bytes | int:
    """The value, by expedited or segmented upload; the abort code if there is one."""
    answer = bytes.fromhex(desk.sdo((struct.pack("<BHB", 0x40, index, subindex) + bytes(4)).hex()))
    if answer[0] == 0x80:
        return int.from_bytes(answer[4:], "little")
    if answer[0] & 2:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    size, value, toggle = int.from_bytes(answer[4:], "little"), b"", 0
    while True:
        segment = bytes.fromhex(desk.sdo(bytes((0x60 | toggle,)).ljust(8, b"\0").hex()))
        assert segment[0] & 0x10 == toggle
        value += segment[1 : 8 - (segment[0] >> 1 & 7)]
        toggle ^= 0x10
        if segment[0] & 1:
            assert len(value) == size
            return value


@pytest.mark.parametrize("code_bits", [16, 24])
def test_every_object_of_the_eds_is_there(make: Callable, layout: PatchLayout, code_bits: int) -> None:
    desk = make(profile=PatchProfile.from_layout(layout, code_bits))
    dictionary = eds.import_eds(io.StringIO(eds_text(desk.node.profile)), 4)
    asked = 0
    for variable in variables(dictionary):
        if variable.index < 0x1000:
            continue  # dummy entries of PDO mappings are no objects
        asked += 1
        where = f"0x{variable.index:04X}:{variable.subindex}"
        value = upload(desk, variable.index, variable.subindex)
        if variable.index == 0x1003 and variable.subindex:
            assert value == 0x08000024, where  # no error, no data
            continue
        assert isinstance(value, bytes), where
        if variable.data_type not in datatypes.DATA_TYPES:
            assert len(value) * 8 == len(variable), where
        if isinstance(variable.default, int) and variable.index not in COMPUTED and variable.index < 0x2200:
            assert int.from_bytes(value, "little") == variable.default, where
    assert asked >= 100


def test_nothing_else_is_there(desk) -> None:
    dictionary = eds.import_eds(io.StringIO(eds_text(desk.node.profile)), 4)
    for index in (0x0005, 0x0FFF, 0x1002, 0x1804, 0x2102, 0x2202, 0x2FFF, 0x6000, 0xFFFF):
        assert index not in dictionary or index < 0x1000
        assert upload(desk, index, 0) == 0x06020000


def test_writable_is_what_the_eds_calls_writable(desk) -> None:
    dictionary = eds.import_eds(io.StringIO(eds_text(desk.node.profile)), 4)
    for variable in variables(dictionary):
        if variable.index < 0x1000:
            continue
        # A download of far too many bytes: refused as too long only where writing is allowed at all.
        request = struct.pack("<BHBI", 0x21, variable.index, variable.subindex, 1 << 20)
        answer = bytes.fromhex(desk.sdo(request.hex()))
        writable = variable.access_type not in ("ro", "const")
        expected = 0x06070012 if writable else 0x06010002
        assert int.from_bytes(answer[4:], "little") == expected, f"0x{variable.index:04X}:{variable.subindex}"


def test_coordinates_are_the_layouts(desk) -> None:
    assert upload(desk, 0x2300, 0) == pack_coordinates(desk.layout)


def test_descriptor_names_the_layout(desk) -> None:
    read = [upload(desk, 0x2000, subindex) for subindex in range(1, 12)]
    assert read[:5] == [b"\x02", b"\x06", b"\x02", b"\x02", b"\x10"]
    assert struct.unpack("<3f", b"".join(read[5:8])) == (0.25, 1.25, 1e7)
    assert read[8] == b"\x03"
    assert int.from_bytes(read[9], "little") == desk.layout.layout_hash
