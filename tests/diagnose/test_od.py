"""The object dictionary of a node, read, written, dumped and compared; values are held against raw bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import canopen
import pytest

from skinnode.canopen import indices as od
from skinnode.config import BusConfig
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.node import PatchNode
from skinnode.protocol.eds_files import dcf_text, eds_text
from skinnode.protocol.profile import PatchProfile

from .conftest import LAYOUT, run

Powered = Callable[..., list[PatchNode]]
ConnectionOn = Callable[[BusConfig], BusConnection]
PROFILE = PatchProfile.from_layout(LAYOUT)


def value(bus: BusConfig, address: str, *options: str) -> object:
    done = run(["od", "5", address, "--json", *options], bus)
    assert done.status == 0, done.stderr
    (reading,) = done.json
    return reading["value"]


def test_reads_by_type(bus: BusConfig, powered: Powered) -> None:
    powered(bus, 5, serial=0xDEADBEEF)
    assert value(bus, "1018:4") == 0xDEADBEEF
    assert value(bus, "0x1008") == "skinnode patch"
    assert value(bus, "2000:6") == 0.25
    assert value(bus, "1800:0x1") == 0x185
    done = run(["od", "5", "1018"], bus)
    assert done.status == 0
    assert "Product code" in done.stdout
    assert "1397442894 (0x534B494E)" in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    ("address", "text", "raw"),
    [
        ("1017", "1000", b"\xe8\x03"),
        ("1017", "0x64", b"\x64\x00"),
        ("2200:3", "1234.5", struct.pack("<f", 1234.5)),
        ("1800:5", "7", b"\x07\x00"),
        ("1014", "$NODEID+0x80", bytes((0x85, 0, 0, 0))),
    ],
)
def test_writes_by_type(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn, address: str, text: str, raw: bytes
) -> None:
    powered(bus, 5)
    assert run(["od", "5", address, "--write", text], bus).status == 0
    index, _, subindex = address.partition(":")
    assert connection_on(bus).od(5).read_bytes(int(index, 16), int(subindex or "0")) == raw


def test_writes_and_reads_bytes(bus: BusConfig, powered: Powered) -> None:
    powered(bus, 5)
    done = run(["od", "5", "1017", "--hex", "--write", "e8 03"], bus)
    assert done.status == 0
    assert "e8 03" in done.stdout
    assert value(bus, "1017") == 1000


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["1017", "--write", "70000"], "--write: got '70000', allowed: a value of 0x1017:00"),
        (["1017", "--write", "soon"], "UNSIGNED16"),
        (["1017", "--hex", "--write", "xy"], "bytes in hexadecimal"),
        (["1018", "--write", "1"], "allowed: INDEX:SUB"),
        (["1000", "--write", "1"], "SDO abort 0x06010002"),
        (["1018:9"], "SDO abort 0x06090011"),
        (["5000"], "SDO abort 0x06020000"),
        (["5000", "--write", "1"], "allowed: --hex and bytes in hexadecimal"),
        (["no-index"], "INDEX: got 'no-index'"),
        (["1018:256"], "INDEX: got '1018:256'"),
        (["--write", "1"], "--write: got '1', allowed: only with INDEX[:SUB]"),
        (["--diff", "no/such.eds"], "a file that can be read"),
        (["--diff", "/dev/null"], "/dev/null: EDS: got no section DeviceInfo or 1000, allowed: a file"),
        (["--eds", "no/such.eds"], "a file that can be read"),
        (["--dcf", "no/such/folder.dcf"], "--dcf"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    bus: BusConfig, powered: Powered, arguments: list[str], line: str
) -> None:
    powered(bus, 5)
    done = run(["od", "5", *arguments], bus)
    assert done.status == 2
    assert line in done.stderr
    assert "\n" not in done.stderr.strip()


def test_dumps_every_value(any_bus: BusConfig, powered: Powered) -> None:
    powered(any_bus, 5)
    done = run(["od", "5", "--json"], any_bus)
    assert done.status == 0
    told = {(item["index"], item["subindex"]): item for item in done.json}
    described = {(e.index, e.subindex) for item in PROFILE.objects() for e in item.entries}
    assert set(told) == described
    refused = {key for key, item in told.items() if item["refused"]}
    assert refused == {(0x1003, sub) for sub in range(1, 9)}  # no errors yet
    assert {told[key]["refused"] for key in refused} == {"no data"}
    assert len(bytes.fromhex(told[0x2301, 0]["hex"])) == 4 * 12


@pytest.mark.long
def test_dcf_is_one_to_another_parser_and_to_ourselves(
    bus: BusConfig, powered: Powered, tmp_path: Path
) -> None:
    powered(bus, 5)
    file = tmp_path / "node5.dcf"
    assert run(["od", "5", "1017", "--write", "250"], bus).status == 0
    assert run(["od", "5", "2020:2", "--write", "9"], bus).status == 0
    done = run(["od", "5", "--dcf", file], bus)
    assert done.status == 0, done.stderr
    described = canopen.import_od(str(file))
    assert described.node_id == 5
    assert described.bitrate == 1_000_000
    assert described[0x1017].value == 250
    assert described[0x2020][2].value == 9
    assert described[0x1800][1].value == 0x185
    assert run(["od", "5", "--diff", file], bus).status == 0
    assert run(["od", "5", "1017", "--write", "500"], bus).status == 0
    done = run(["od", "5", "--diff", file, "--json"], bus)
    assert done.status == 1
    assert [(d["index"], d["subindex"], d["node"], d["file"]) for d in done.json] == [
        (0x1017, 0, "500 (0x1F4)", "250")
    ]


def test_diff_against_the_data_sheet(bus: BusConfig, powered: Powered, tmp_path: Path) -> None:
    powered(bus, 5)
    eds, other = tmp_path / "patch.eds", tmp_path / "other.dcf"
    eds.write_text(eds_text(PROFILE))
    assert run(["od", "5", "--diff", eds], bus).status == 0
    other.write_text(dcf_text(PROFILE, 6, 1_000_000))  # of node 6: its COB-IDs are others
    done = run(["od", "5", "--diff", other, "--json"], bus)
    assert done.status == 1
    differing = {(d["index"], d["subindex"]) for d in done.json}
    assert {(od.TPDO1_PARAMETER, 1), (od.COB_ID_EMCY, 0), (od.RPDO1_PARAMETER, 1)} <= differing


def test_a_device_of_others_needs_its_sheet(
    bus: BusConfig, powered: Powered, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    powered(bus, 5)
    monkeypatch.setattr(od, "PRODUCT_CODE", 0x1234)  # what the tool takes for a patch of ours
    done = run(["od", "5", "2020:3", "--write", "100"], bus)  # of what type?
    assert done.status == 2
    assert "--eds" in done.stderr
    assert "4e 49 4b 53" in run(["od", "5", "1018:2", "--hex"], bus).stdout  # bytes need no sheet
    assert run(["od", "5", "2020:3", "--hex", "--write", "09 00"], bus).status == 0
    assert run(["od", "5", "1017", "--write", "100"], bus).status == 0  # CiA 301 has its type
    eds = tmp_path / "of-others.eds"
    eds.write_text(eds_text(PROFILE))
    assert value(bus, "1018:2", "--eds", str(eds)) == 0x534B494E
