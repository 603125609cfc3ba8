"""A device of another make on the bus: the technician's commands say what it is, in the words of CiA 301."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from canopen.objectdictionary import ObjectDictionary

from skinnode.canopen import indices as od
from skinnode.config import BusConfig
from skinnode.diagnose import discovery
from skinnode.diagnose.standard_objects import standard_entries

from .conftest import run

pytestmark = pytest.mark.system_time  # threads of the canopen library

NODE_ID = 16
_SECTIONS = {
    "1000": ("Device type", "0x7", "ro", "0x000F0191"),
    "1001": ("Error register", "0x5", "ro", "0x01"),
    "1003": ("Errors", "0x8", "", ""),
    "1003sub0": ("Count", "0x5", "rw", "1"),
    "1003sub1": ("Error", "0x7", "ro", "0x2F015000"),
    "1008": ("Name", "0x9", "const", "valve"),
    "1016": ("Consumers", "0x8", "", ""),
    "1016sub0": ("Count", "0x5", "ro", "2"),
    "1016sub1": ("Consumer", "0x7", "rw", "0"),
    "1016sub2": ("Consumer", "0x7", "rw", "0x007F0064"),
    "1017": ("Heartbeat", "0x6", "rw", "0"),
    "1018": ("Identity", "0x9", "", ""),
    "1018sub0": ("Count", "0x5", "ro", "4"),
    "1018sub1": ("Vendor", "0x7", "ro", "0x42"),
    "1018sub2": ("Product", "0x7", "ro", "0x43"),
    "1018sub3": ("Revision", "0x7", "ro", "0x10002"),
    "1018sub4": ("Serial", "0x7", "ro", "99"),
    "2000": ("Setting", "0x5", "rw", "7"),
}


def _section(title: str, name: str, data_type: str, access: str, default: str) -> str:
    lines = [f"[{title}]", f"ParameterName={name}"]
    if not access:
        return "\n".join([*lines, f"ObjectType={data_type}", "SubNumber=2"])
    return "\n".join([*lines, f"DataType={data_type}", f"AccessType={access}", f"DefaultValue={default}"])


@pytest.fixture
def foreign(bus: BusConfig, tmp_path: Path) -> Iterator[canopen.LocalNode]:
    """An operational I/O device of profile 401 that reports an error of its own."""
    sheet = tmp_path / "valve.eds"
    text = "\n".join(_section(title, *row) for title, row in _SECTIONS.items())
    sheet.write_text(f"[DeviceInfo]\nVendorName=somebody\n{text}\n")
    network = canopen.Network(can.Bus(interface="virtual", channel=bus.channel, ignore_config=True))
    network.connect()
    node = canopen.LocalNode(NODE_ID, str(sheet))
    network.add_node(node)
    assert isinstance(node.object_dictionary, ObjectDictionary)
    node.nmt.state = "OPERATIONAL"
    node.nmt.start_heartbeat(50)
    try:
        yield node
    finally:
        node.nmt.stop_heartbeat()
        network.disconnect()


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery, "LISTEN_S", 0.3)
    monkeypatch.setattr(discovery, "PACE_S", 0.0001)


def test_an_emergency_code_means_what_the_standard_says(bus: BusConfig, foreign: object) -> None:
    done = run(["info", NODE_ID, "--json"], bus)
    assert done.json["errors"] == ["0x5000 hardware (manufacturer-specific: 0x2F01)"]


def test_standard_objects_have_names_without_an_eds(bus: BusConfig, foreign: object) -> None:
    (name,) = run(["od", NODE_ID, "0x1008", "--json"], bus).json
    assert (name["name"], name["type"], name["value"]) == (
        "Manufacturer device name",
        "VISIBLE_STRING",
        "valve",
    )
    readings = run(["od", NODE_ID, "1018", "--json"], bus).json
    assert [(r["name"], r["value"]) for r in readings] == [
        ("Identity object: entries", 4),
        ("Vendor-ID", 0x42),
        ("Product code", 0x43),
        ("Revision number", 0x10002),
        ("Serial number", 99),
    ]
    readings = run(["od", NODE_ID, "1016", "--json"], bus).json
    assert [r["value"] for r in readings] == [2, 0, 0x7F0064]


@pytest.mark.parametrize("refused", ["0x1018:1", "0x1018:2", "0x2000"])
def test_standard_objects_are_read_whatever_else_the_node_refuses(
    bus: BusConfig, foreign: canopen.LocalNode, refused: str
) -> None:
    """A node of our identity, such as one that is half programmed."""
    foreign.set_data(0x1018, 1, od.VENDOR_ID.to_bytes(4, "little"))
    foreign.set_data(0x1018, 2, od.PRODUCT_CODE.to_bytes(4, "little"))
    if refused.startswith("0x1018"):
        del foreign.object_dictionary[0x1018].subindices[int(refused[-1])]
    else:
        del foreign.object_dictionary[0x2000]
    done = run(["od", NODE_ID, "0x1008", "--json"], bus)
    assert (done.status, [(r["name"], r["value"]) for r in done.json]) == (
        0,
        [("Manufacturer device name", "valve")],
    )
    (note,) = done.stderr.splitlines()
    assert note.startswith("note: node 16: ")
    assert refused in note
    assert run(["od", NODE_ID, "1016:1", "--write", "0x000500C8"], bus).status == 0
    assert run(["info", NODE_ID, "--json"], bus).json["name"] == "valve"
    dumped = run(["od", NODE_ID], bus)
    assert dumped.status == 0
    assert "1008:0" in dumped.stdout
    assert "is not a skinnode patch" not in dumped.stdout


def test_a_standard_object_is_written_by_its_type(bus: BusConfig, foreign: canopen.LocalNode) -> None:
    done = run(["od", NODE_ID, "1016:1", "--write", "0x000500C8"], bus)
    assert done.status == 0
    assert foreign.sdo[0x1016][1].raw == 0x000500C8


def test_other_objects_are_known_to_the_eds_alone(bus: BusConfig, foreign: object) -> None:
    (reading,) = run(["od", NODE_ID, "2000", "--json"], bus).json
    assert (reading["name"], reading["hex"]) == ("named only in its EDS", "07")


def test_a_dump_without_an_eds_has_what_the_standard_names(bus: BusConfig, foreign: object) -> None:
    done = run(["od", NODE_ID], bus)
    assert done.status == 0
    printed = " ".join(done.stdout.split())
    for line in (
        "1000:0 Device type UNSIGNED32 ro 983441 (0xF0191)",
        "1018:4 Serial number UNSIGNED32 ro 99",
    ):
        assert line in printed
    assert "2000:0" not in done.stdout
    assert "note: node 16 is not a skinnode patch; to name all its objects, add --eds FILE" in done.stdout


def test_a_dcf_takes_an_eds(bus: BusConfig, foreign: object, tmp_path: Path) -> None:
    done = run(["od", NODE_ID, "--dcf", tmp_path / "x.dcf"], bus)
    assert done.status == 2
    expected = "error: --eds: got no file, allowed: the EDS of node 16, which is not a skinnode patch"
    assert done.stderr == expected


def test_the_doctor_names_it_and_finds_nothing_wrong(bus: BusConfig, foreign: object) -> None:
    done = run(["doctor"], bus)
    printed = " ".join(done.stdout.split())
    assert (
        "node 16 (valve), not a skinnode patch: device profile 401, vendor 0x00000042, product 0x00000043, "
        "NMT state operational, error register 0x01 (generic)"
    ) in printed
    assert "no patches, " in printed
    assert "the checks that were run found no faults" in printed
    assert done.status == 0
    assert run(["doctor", "--json"], bus).json["others"][0].startswith(f"{bus.channel}: node 16 (valve)")


def test_the_doctor_names_one_that_only_beats(bus: BusConfig) -> None:
    with can.Bus(interface="virtual", channel=bus.channel, ignore_config=True) as other:
        beats = other.send_periodic(can.Message(arbitration_id=0x711, data=[4], is_extended_id=False), 0.05)
        time.sleep(0.1)
        printed = " ".join(run(["doctor"], bus).stdout.split())
        beats.stop()
    assert "node 17, not a skinnode patch: NMT state stopped, does not answer SDO requests" in printed


def test_scan_says_what_kind_of_device_has_no_name(bus: BusConfig, foreign: canopen.LocalNode) -> None:
    del foreign.object_dictionary[0x1008]
    done = run(["scan"], bus)
    assert "unnamed, profile 401" in " ".join(done.stdout.split())


def test_the_groups_of_stored_parameters_have_names() -> None:
    names = [entry.name for entry in standard_entries(0x1010, 4)]
    assert names == [
        "Store parameters: entries",
        "Store parameters: all",
        "Store parameters: communication",
        "Store parameters: application",
        "Store parameters: manufacturer-specific",
    ]
