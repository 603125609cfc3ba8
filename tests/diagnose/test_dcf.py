"""A node's strings as a DCF and back: no byte is lost, and other readers take the right ones or none."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from skinnode.config import BusConfig
from skinnode.diagnose.data_sheet import DataSheet, load_data_sheet
from skinnode.diagnose.dcf import as_dcf, expected
from skinnode.diagnose.object_dictionary import Reading, decode, type_name

from .conftest import run

NODE_ID = 16
STRINGS = {0x09: "VISIBLE_STRING", 0x0A: "OCTET_STRING", 0x0B: "UNICODE_STRING", 0x0F: "DOMAIN"}
HEAD = """[DeviceInfo]
VendorName=somebody
[MandatoryObjects]
SupportedObjects=1
1=0x1000
[OptionalObjects]
SupportedObjects=0
[ManufacturerObjects]
SupportedObjects=1
1=0x2001
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x7
AccessType=ro
PDOMapping=0
"""


def sheet_text(data_type: int, *lines: str, name: str = "Text") -> str:
    options = [f"ParameterName={name}", "ObjectType=0x7", f"DataType=0x{data_type:04X}", "AccessType=rw"]
    return HEAD + "\n".join(["[2001]", *options, *lines, "PDOMapping=0", ""])


def written(folder: Path, data_type: int, data: bytes) -> Path:
    """The DCF of a node whose one string is ``data``."""
    source = folder / "device.eds"
    source.write_text(sheet_text(data_type))
    sheet = load_data_sheet(source)
    entry = sheet.eds.entries[0x2001, 0]
    reading = Reading(0x2001, 0, "Text", type_name(entry), "rw", decode(entry, data), data, "")
    made = as_dcf(sheet, [reading], NODE_ID, 1_000_000, "valve")
    assert made.values == 1
    file = folder / "device.dcf"
    file.write_text(made.text, encoding="utf-8")
    return file


def had_back(sheet: DataSheet) -> bytes | None:
    return expected(sheet).entries[0x2001, 0].default_bytes(NODE_ID)


NASTY = [
    b"",
    b" ",
    b"plain text, 100 of it",
    b"caf\xc3\xa9",
    b"caf\xe9",
    b"a\tb",
    b"a\r\nb\n",
    b"\x1b[31mred",
    b"ends in zero\0",
    b" blank before",
    b"blank behind ",
    b"; a comment",
    b"text ;not a comment",
    b"# another",
    b"$NODEID+0x80",
    b"%(name)s",
    b"[section]",
    b"key=value",
    b"ParameterBytes=00",
    b"'quoted'",
    b'"quoted"',
    b"back\\slash",
    b"\xff\xfe",
    b"h\0i\0",
    b"0x10",
    b"\xc2\xa0",
    b"\x85",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("dcf")


@pytest.mark.long
@settings(deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data_type=st.sampled_from(sorted(STRINGS)), data=st.binary(max_size=40) | st.text().map(str.encode))
@example(data_type=0x09, data=b"caf\xc3\xa9\t")
def test_any_string_is_had_back_byte_for_byte(folder: Path, data_type: int, data: bytes) -> None:
    file = written(folder, data_type, data)
    assert had_back(load_data_sheet(file)) == data
    told = canopen.import_od(str(file))[0x2001]
    if hasattr(told, "value_raw"):
        assert told.encode_raw(told.value) == data


@pytest.mark.parametrize("data", NASTY)
@pytest.mark.parametrize("data_type", sorted(STRINGS))
def test_no_reader_takes_a_string_for_another(tmp_path: Path, data_type: int, data: bytes) -> None:
    file = written(tmp_path, data_type, data)
    assert had_back(load_data_sheet(file)) == data
    told = canopen.import_od(str(file))[0x2001]
    if hasattr(told, "value_raw"):
        assert told.encode_raw(told.value) == data


def test_what_is_plain_is_where_the_standard_has_it(tmp_path: Path) -> None:
    for data_type, data, line in (
        (0x09, b"plain text", "ParameterValue=plain text"),
        (0x0B, b"h\0i\0", "ParameterValue=hi"),
        (0x0A, b"\x01\xab", "ParameterValue=01AB"),
        (0x0F, b"\0", "ParameterValue=00"),
        (0x09, b"caf\xe9", ";ParameterBytes=63 61 66 e9"),
    ):
        assert line in written(tmp_path, data_type, data).read_text().splitlines()


def test_dcfchk_accepts_the_bytes(tmp_path: Path) -> None:
    tool = shutil.which("dcfchk", path=str(Path(sys.executable).parent)) or shutil.which("dcfchk")
    assert tool is not None
    for data in (b"caf\xc3\xa9\t\x01", b"plain"):
        file = written(tmp_path, 0x09, data)
        text = file.read_text()
        done = subprocess.run([tool, str(file)], capture_output=True, text=True, timeout=60)
        before = tmp_path / "device.eds"
        alone = subprocess.run([tool, str(before)], capture_output=True, text=True, timeout=60)
        assert text.count("ParameterBytes") == (data != b"plain")
        told = (done.stdout + done.stderr).replace("device.dcf", "device.eds")
        assert (done.returncode, told) == (alone.returncode, alone.stdout + alone.stderr)


def test_a_dcf_made_of_a_dcf_keeps_no_old_value(tmp_path: Path) -> None:
    file = written(tmp_path, 0x09, b"caf\xe9")
    sheet = load_data_sheet(file)
    reading = Reading(0x2001, 0, "Text", "VISIBLE_STRING", "rw", "tea", b"tea", "")
    again = tmp_path / "again.dcf"
    again.write_text(as_dcf(sheet, [reading], NODE_ID, 1_000_000, "valve").text)
    assert had_back(load_data_sheet(again)) == b"tea"
    assert "ParameterBytes" not in again.read_text()


# --- on a bus


@pytest.fixture
def talker(bus: BusConfig, tmp_path: Path) -> Iterator[tuple[canopen.LocalNode, Path]]:
    """A device of others with a string that can be written, and its EDS."""
    sheet = tmp_path / "talker.eds"
    sheet.write_text(sheet_text(0x09))
    network = canopen.Network(can.Bus(interface="virtual", channel=bus.channel, ignore_config=True))
    network.connect()
    node = canopen.LocalNode(NODE_ID, str(sheet))
    network.add_node(node)
    node.set_data(0x1000, 0, bytes(4))
    try:
        yield node, sheet
    finally:
        network.disconnect()


@pytest.mark.system_time  # threads of the canopen library
@pytest.mark.parametrize("data", [b"caf\xc3\xa9", b"a\tb\x01\x7f", b"plain", b"padded\0\0"])
def test_a_node_is_as_its_dcf_says(
    bus: BusConfig, talker: tuple[canopen.LocalNode, Path], tmp_path: Path, data: bytes
) -> None:
    node, sheet = talker
    node.set_data(0x2001, 0, data)
    file = tmp_path / "talker.dcf"
    done = run(["od", NODE_ID, "--eds", sheet, "--dcf", file], bus)
    assert done.status == 0
    assert done.stdout.startswith("1 value of node 16 in ")
    plain = data == b"plain"
    assert ("note: CiA 306 cannot express 0x2001:0" in done.stdout) is not plain
    assert run(["od", NODE_ID, "--diff", file], bus).stdout == "no differences\n"
    node.set_data(0x2001, 0, data + b"x")
    assert run(["od", NODE_ID, "--diff", file], bus).status == 1


ALIKE = [b"", b"abc", b"abc\0", b"abc ", b" abc", b"0", b"a\x1b", b"a\\x1b", b"x" * 300, b"x" * 299 + b"y"]


@pytest.mark.long
@pytest.mark.system_time  # threads of the canopen library
@pytest.mark.parametrize("data_type", sorted(STRINGS))
def test_strings_that_look_alike_differ_visibly(
    bus: BusConfig, talker: tuple[canopen.LocalNode, Path], tmp_path: Path, data_type: int
) -> None:
    """A LocalNode refuses to read an empty string: no data available."""
    node, sheet = talker
    sheet.write_text(sheet_text(data_type))
    files = [tmp_path / f"{number}.dcf" for number, _ in enumerate(ALIKE)]
    for data, file in zip(ALIKE, files, strict=True):
        node.set_data(0x2001, 0, data)
        done = run(["od", NODE_ID, "--eds", sheet, "--dcf", file], bus)
        assert done.stdout.startswith("1 value of node 16 in ")
        assert had_back(load_data_sheet(file)) == data
    for number, data in enumerate(ALIKE):
        node.set_data(0x2001, 0, data)
        for other, file in zip(ALIKE[number:], files[number:], strict=True):  # every pair once
            done = run(["od", NODE_ID, "--diff", file, "--json"], bus)
            assert done.status == (data != other), (data, other)
            assert len(done.json) == (data != other)
            for found in done.json:
                assert "" != found["node"] != found["file"] != "", (data, other)


@pytest.mark.system_time  # threads of the canopen library
def test_an_empty_string_is_no_default(
    bus: BusConfig, talker: tuple[canopen.LocalNode, Path], tmp_path: Path
) -> None:
    node, sheet = talker
    sheet.write_text(sheet_text(0x09, "DefaultValue=abc", "ParameterValue=old"))
    node.set_data(0x2001, 0, b"")
    file = tmp_path / "empty.dcf"
    assert run(["od", NODE_ID, "--eds", sheet, "--dcf", file], bus).status == 0
    assert had_back(load_data_sheet(file)) == b""
    assert run(["od", NODE_ID, "--diff", file], bus).stdout == "no differences\n"
    node.set_data(0x2001, 0, b"abc")
    (found,) = run(["od", NODE_ID, "--diff", file, "--json"], bus).json
    assert (found["node"], found["file"]) == ("'abc'", "''")


ENCODINGS = {
    "ASCII": (b"Gerat", "Gerat"),
    "UTF-8": ("Gerät Ω".encode(), "Gerät Ω"),
    "UTF-8 with BOM": (b"\xef\xbb\xbf" + "Gerät".encode(), "Gerät"),
    "Windows-1252": ("Gerät €".encode("cp1252"), "Gerät €"),
    "Latin-1": ("Gerät \x81".encode("latin-1"), "Gerät \\x81"),
    "UTF-16 with BOM": (b"\xff\xfe", "Gerät Ω"),
}


def encoded(encoding: str) -> bytes:
    """A sheet whose object 0x2001 has a name in that encoding."""
    name, text = ENCODINGS[encoding]
    if encoding.startswith("UTF-16"):
        return sheet_text(0x09, name=text).replace("\n", "\r\n").encode("utf-16")
    bom = b"\xef\xbb\xbf" if encoding.endswith("BOM") else b""
    plain = sheet_text(0x09, "DefaultValue=NAME", name="NAME").encode()
    return bom + plain.replace(b"NAME", name.removeprefix(b"\xef\xbb\xbf"))


@pytest.mark.system_time  # threads of the canopen library
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_encoding_of_a_sheet_is_found_and_told(
    bus: BusConfig, talker: tuple[canopen.LocalNode, Path], encoding: str
) -> None:
    node, sheet = talker
    node.set_data(0x2001, 0, b"x")
    sheet.write_bytes(encoded(encoding))
    done = run(["od", NODE_ID, "2001", "--eds", sheet, "--json"], bus)
    assert done.json[0]["name"] == ENCODINGS[encoding][1]
    note = "" if encoding == "ASCII" else f"note: {sheet} read as {encoding}: an EDS should be ASCII\n"
    assert done.stderr == note


@pytest.mark.system_time  # threads of the canopen library
@pytest.mark.parametrize("encoding", [name for name in ENCODINGS if not name.startswith("UTF-16")])
def test_a_default_is_compared_by_the_bytes_of_the_file(
    bus: BusConfig, talker: tuple[canopen.LocalNode, Path], tmp_path: Path, encoding: str
) -> None:
    node, sheet = talker
    data = encoded(encoding)
    sheet.write_bytes(data.replace(b"AccessType=rw", b"AccessType=const"))
    node.set_data(0x2001, 0, ENCODINGS[encoding][0].removeprefix(b"\xef\xbb\xbf"))
    assert run(["od", NODE_ID, "--diff", sheet], bus).stdout == "no differences\n"
    file = tmp_path / "x.dcf"  # UTF-8, whatever the sheet was
    assert run(["od", NODE_ID, "--eds", sheet, "--dcf", file], bus).status == 0
    assert run(["od", NODE_ID, "--diff", file], bus).stdout == "no differences\n"
    name = canopen.import_od(str(file))[0x2001].name
    assert name == ENCODINGS[encoding][1].replace("\\x81", "\x81")


def test_utf_16_that_is_none_is_one_line(bus: BusConfig, tmp_path: Path) -> None:
    file = tmp_path / "x.eds"
    file.write_bytes(b"\xff\xfe[")
    done = run(["od", NODE_ID, "--diff", file], bus)
    assert done.status == 2
    assert done.stderr == f"error: {file}: EDS: got malformed UTF-16, allowed: a file in CiA 306 format"
