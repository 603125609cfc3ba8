"""Nodes that are not ours: the canopen library's, by an EDS of its own; and sheets as others write them."""

from __future__ import annotations

import uuid
from collections.abc import Iterator

import can
import canopen
import pytest

from skinnode.config import BusConfig
from skinnode.conformance import Dut, Verdict, connect, parse_eds, run_cases, select
from skinnode.errors import ConfigError, ProfileError
from skinnode.transport import CanPort

pytestmark = pytest.mark.system_time  # threads of the canopen library

NODE_ID = 0x21
SHEET = """
[DeviceInfo]
VendorName=somebody
VendorNumber=0x42
NrOfRXPDO=0
NrOfTXPDO=0
[DummyUsage]
Dummy0001=0
Dummy0002=0
Dummy0003=0
Dummy0004=0
Dummy0005=1
Dummy0006=0
Dummy0007=0
[MandatoryObjects]
SupportedObjects=3
1=0x1000
2=0x1001
3=0x1018
[1000]
ParameterName=Device type
DataType=0x7
AccessType=ro
DefaultValue=0xF0191
[1001]
ParameterName=Error register
DataType=0x5
AccessType=ro
DefaultValue=0
[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=2
[1018sub0]
ParameterName=Highest sub-index
DataType=0x5
AccessType=const
DefaultValue=1
[1018sub1]
ParameterName=Vendor-ID
DataType=0x7
AccessType=ro
DefaultValue=0x42
[OptionalObjects]
SupportedObjects=2
1=0x1008
2=0x1017
[1008]
ParameterName=Name
DataType=0x9
AccessType=const
DefaultValue=somebody's device
[1017]
ParameterName=Heartbeat
DataType=0x6
AccessType=rw
DefaultValue=0
[ManufacturerObjects]
SupportedObjects=2
1=0x2000
2=0x2001
[2000]
ParameterName=Many alike
ObjectType=0x8
DataType=0x6
AccessType=rw
CompactSubObj=3
DefaultValue=7
[2001]
ParameterName=Write-only
DataType=0x5
AccessType=wo
"""


@pytest.fixture(scope="module")
def channel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where the library's node is."""
    name = f"foreign-{uuid.uuid4().hex[:8]}"
    sheet = tmp_path_factory.mktemp("sheets") / "device.eds"
    sheet.write_text(SHEET)
    network = canopen.Network(can.Bus(interface="virtual", channel=name, ignore_config=True))
    network.connect()
    network.add_node(canopen.LocalNode(NODE_ID, str(sheet)))
    try:
        yield name
    finally:
        network.disconnect()


@pytest.fixture
def foreign(channel: str) -> Iterator[Dut]:
    with CanPort(BusConfig(channel=channel)) as port:
        yield connect(port, NODE_ID, parse_eds(SHEET, "device.eds"))


def test_the_canopen_librarys_node(foreign: Dut) -> None:
    numbers = (1, 3, 4, 5, 6, 7, 8, 12, 15, 16, 17, 18)
    report = run_cases(foreign, select(("EDS", "OD-01", "OD-04", *(f"SDO-{n:02}" for n in numbers))))
    found = {result.case.id: result for result in report.results}
    # What its server does not do: look at the sub-index of a VAR, end a transfer that it has aborted.
    for name, got in (("SDO-05", "43 00 10 01"), ("SDO-17", "00 73 6F 6D")):
        result = found.pop(name)
        assert result.verdict is Verdict.FAILED
        assert got in result.why
    lacking = found.pop("SDO-12")
    assert lacking.verdict is Verdict.NOT_APPLICABLE
    assert "0x1200" in lacking.why
    assert {result.verdict for result in found.values()} == {Verdict.PASSED}


def test_a_node_without_a_sheet_that_is_not_ours_is_told_so(channel: str) -> None:
    with CanPort(BusConfig(channel=channel)) as port, pytest.raises(ConfigError, match="--eds"):
        connect(port, NODE_ID)


def test_a_sheet_is_read() -> None:
    eds = parse_eds(SHEET.replace("0xF0191", "$NODEID+0x10"), "device.eds")
    assert eds.contradictions == ()
    assert eds.dummies == {5}
    assert [entry.subindex for entry in eds.between(0x2000, 0x2000)] == [0, 1, 2, 3]
    assert eds.entries[0x2000, 3].default_bytes(NODE_ID) == b"\x07\x00"
    assert eds.entries[0x1000, 0].default_bytes(0x21) == b"\x31\0\0\0"
    assert eds.entries[0x1008, 0].default_bytes(0x21) == b"somebody's device"


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (("SupportedObjects=3", "SupportedObjects=4"), "SupportedObjects=4, but 3"),
        (("2=0x1017", "2=0x1016"), "0x1016 is listed only"),
        (("SubNumber=2", "SubNumber=3"), "SubNumber=3, but 2"),
        (("VendorNumber=0x42", "VendorNumber=0x43"), "vendornumber=0x43, but the device reports 0x00000042"),
        (
            ("DefaultValue=0\n[1018]", "DefaultValue=300\n[1018]"),
            "default 300 exceeds the range of its data type",
        ),
        (("AccessType=wo", "AccessType=write"), "access type 'write'"),
        (("DataType=0x9", "DataType=0x99"), "data type 0x0099"),
    ],
)
def test_a_sheet_that_contradicts_itself_or_the_device(
    foreign: Dut, wrong: tuple[str, str], told: str
) -> None:
    assert wrong[0] in SHEET
    dut = Dut(foreign.bus, NODE_ID, parse_eds(SHEET.replace(*wrong), "device.eds"))
    (result,) = run_cases(dut, select(("EDS",))).results
    assert result.verdict is Verdict.FAILED
    assert told in result.why


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (("NrOfTXPDO=0", "NrOfTXPDO=4"), "NrOfTXPDO=4, but the EDS describes 0"),
        (("NrOfRXPDO=0", "NrOfRXPDO=many"), "NrOfRXPDO=many, but the EDS describes 0"),
        (
            (
                "AccessType=const\nDefaultValue=somebody",
                "AccessType=const\nPDOMapping=1\nDefaultValue=somebody",
            ),
            "0x1008:00 (Name): mappable, but of variable length",
        ),
        (
            ("DataType=0x9\nAccessType=const", "DataType=0xA\nAccessType=const\nPDOMapping=1"),
            "0x1008:00 (Name): mappable, but of variable length",
        ),
        (
            ("CompactSubObj=3", "CompactSubObj=3\nLowLimit=9\nHighLimit=8"),
            "low limit 9 is above high limit 8",
        ),
        (("CompactSubObj=3", "CompactSubObj=3\nHighLimit=6"), "default 7 is outside the limits"),
    ],
)
def test_what_is_doubtful_in_a_sheet_is_a_warning(foreign: Dut, wrong: tuple[str, str], told: str) -> None:
    assert wrong[0] in SHEET
    dut = Dut(foreign.bus, NODE_ID, parse_eds(SHEET.replace(*wrong), "device.eds"))
    report = run_cases(dut, select(("EDS",)))
    (result,) = report.results
    assert result.verdict is Verdict.WARNING
    assert told in result.why
    assert report.failed == 0


@pytest.mark.parametrize("text", ["", "no sections", "[DeviceInfo]\n", "\0", "[a]\n[1000"])
def test_what_is_no_sheet_is_one_line(text: str) -> None:
    with pytest.raises(ProfileError, match=r"device\.eds") as error:
        parse_eds(text, "device.eds")
    assert "\n" not in str(error.value)
