"""The configuration for ros2_canopen: dcfgen of Lely CANopen reads it, and a node has it as from the host."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import canopen
import pytest
import yaml

from skinnode.config import HandConfig, load_hand, parse_hand
from skinnode.errors import ConfigError
from skinnode.host import Host
from skinnode.host.sync import SyncProducer, Ticks
from skinnode.messages.ros2_canopen import master_node_id, package_files, package_name
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from tests.docs.blocks import REPOSITORY

from .conftest import Rack, heard
from .test_roles import changed
from .test_supervisor import take

KEYS_OF_MASTER = {"node_id", "driver", "package", "baudrate", "sync_period", "sync_overflow"}
KEYS_OF_DEVICE = {
    *("node_id", "serial_number", "dcf", "driver", "package", "heartbeat_producer", "tpdo", "sdo"),
    *("polling", "period", "sdo_timeout_ms", "boot_timeout_ms"),  # read by canopen_base_driver, not by dcfgen
}
"""Keys of the user guide of ros2_canopen 0.3.4 (configuration.rst) and its tests (config/simple/bus.yml)."""

CONFIGURED = [
    *((index, 0) for index in (0x1005, 0x1006, 0x1007, 0x1017, 0x1019)),
    *((index, sub) for index in (0x1800, 0x1801) for sub in (1, 2, 3, 5)),
    *((0x1016, 1), (0x2020, 1), (0x2021, 1)),
]


def written(hand: HandConfig, folder: Path) -> dict[str, Path]:
    """The folder with bus.yml of each bus, by the name of the bus."""
    for path, text in package_files(hand).items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    config = folder / package_name(hand) / "config"
    return {bus.name: config / bus.name for bus in hand.buses}


def dcfgen(folder: Path) -> None:
    """As generate_dcf of lely_core_libraries calls it."""
    tool = shutil.which("dcfgen", path=str(Path(sys.executable).parent)) or shutil.which("dcfgen")
    assert tool is not None
    done = subprocess.run(
        [tool, "-d", ".", "-rS", "bus.yml"], cwd=folder, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def concise(file: Path) -> Iterator[tuple[int, int, bytes]]:
    """Entries of a concise DCF (CiA 302-3), which Lely writes to a node one after the other."""
    data = file.read_bytes()
    (count,), at = struct.unpack_from("<I", data), 4
    for _ in range(count):
        index, subindex, size = struct.unpack_from("<HBI", data, at)
        yield index, subindex, data[at + 7 : at + 7 + size]
        at += 7 + size
    assert at == len(data)


def answer(port: CanPort, node_id: int, request: bytes) -> bytes:
    """The response of a node to an SDO request."""
    port.send(0x600 + node_id, request.ljust(8, b"\0"))
    while (frame := port.recv(5.0)) is not None:
        if frame.can_id == 0x580 + node_id:
            assert frame.data[0] != 0x80, frame.data.hex(" ")
            return frame.data
    raise AssertionError("no response")


def boot(port: CanPort, node_id: int, file: Path) -> None:
    for index, subindex, value in concise(file):
        head = bytes([0x23 | (4 - len(value)) << 2])
        answer(port, node_id, head + struct.pack("<HB", index, subindex) + value)


def values(port: CanPort, node_id: int) -> dict[tuple[int, int], bytes]:
    return {
        (index, sub): answer(port, node_id, b"\x40" + struct.pack("<HB", index, sub))[4:]
        for index, sub in CONFIGURED
    }


@pytest.mark.long
@pytest.mark.parametrize("name", ["hand", "hand-guest", "hand-two-buses"])
def test_dcfgen_reads_it_and_keys_are_those_of_the_documentation(name: str, tmp_path: Path) -> None:
    hand = load_hand(REPOSITORY / "examples" / f"{name}.toml")
    for bus, folder in written(hand, tmp_path).items():
        found = yaml.safe_load((folder / "bus.yml").read_text(encoding="utf-8"))
        patches = {patch.name: patch for patch in hand.patches_on(bus)}
        assert list(found) == ["options", "master", *patches]
        assert set(found["master"]) == KEYS_OF_MASTER
        assert found["master"]["node_id"] not in {patch.node_id for patch in patches.values()}
        assert found["master"]["sync_period"] == 1000 * hand.sync.period_ms
        for device, patch in patches.items():
            assert set(found[device]) <= KEYS_OF_DEVICE
            assert (found[device]["node_id"], found[device].get("serial_number")) == (
                patch.node_id,
                patch.serial,
            )
            eds = folder / found[device]["dcf"]
            assert eds.read_bytes() == (REPOSITORY / "eds" / eds.name).read_bytes()
        dcfgen(folder)
        master = canopen.import_od(str(folder / "master.dcf"))
        received = {each[1].default for index, each in master.items() if 0x1400 <= index < 0x1600}
        # summaries only: a proxy would queue each of five values of each of 100 chunks
        assert received == {0x280 + patch.node_id for patch in patches.values()}


@pytest.mark.long
def test_a_patch_booted_with_it_is_as_one_that_the_host_configured(
    hand: HandConfig,
    rack_of: Callable[[HandConfig], Rack],
    listener: CanPort,
    tmp_path: Path,
) -> None:
    first, second = rack_of(hand), rack_of(hand)
    for name in ("p0", "p1"):
        first.plug(name)
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10), 2)
        heard(listener)
        expected = {patch.node_id: values(listener, patch.node_id) for patch in hand.patches}
    first.close()
    folder = written(hand, tmp_path)["can0"]
    dcfgen(folder)
    for name in ("p0", "p1"):
        second.plug(name)
    for patch in hand.patches:
        assert values(listener, patch.node_id) != expected[patch.node_id]
        boot(listener, patch.node_id, folder / f"{patch.name}.bin")
        assert values(listener, patch.node_id) == expected[patch.node_id]
    guest = changed(hand, bus={"role": "guest", "guest_sends": "sdo"})
    listener.send(0x000, b"\x01\x00")
    with (
        SyncProducer([(listener.send, Ticks(hand.sync.counter_overflow))], hand.sync.period_s),
        Host.from_config(guest) as host,
    ):
        heard(listener)
        for name in ("p0", "p1"):
            take(host.fields(timeout_s=10, patch=name), 4)
        assert all(stream.assembler.scans_complete > 2 for stream in host.stats().patches.values())
        writes = [f for f in heard(listener) if f.can_id in (0x605, 0x606) and f.data[0] >> 5 == 1]
        assert writes == []  # the guest finds nothing to correct


@pytest.mark.long
def test_patches_of_different_sizes_have_their_own_eds(tmp_path: Path) -> None:
    sizes = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
    bus = {"name": "can0", "interface": "socketcan", "channel": 'can"0'}
    patches = [
        {"name": "a-b", "node_id": 127, "layout": sizes},
        {"name": "2nd", "node_id": 126, "code_bits": 24},
    ]
    hand = parse_hand({"name": "3 Däumlinge", "buses": [bus], "patches": patches})
    folder = written(hand, tmp_path)["can0"]
    dcfgen(folder)
    assert {file.stem for file in folder.glob("*.bin")} == {"a_b", "_2nd", "master"}
    assert {file.name for file in folder.glob("*.eds")} == {"skinnode-4x12-u16.eds", "skinnode-10x30-u24.eds"}
    assert master_node_id(hand, hand.buses[0]) == 125
    package = tmp_path / package_name(hand)
    assert package.name == "hand_3_d_umlinge_canopen"  # ROS 2: lower-case letters, digits, underscores
    compile((package / "launch" / "can0.launch.py").read_text(encoding="utf-8"), "launch", "exec")


@pytest.mark.parametrize(
    ("bus", "name", "says"),
    [
        ({"fd": True}, "palm", r"buses\[0\]\.fd: got true, allowed: false for ros2_canopen"),
        ({}, "headmaster", r"patches\[0\]\.name: got 'headmaster', allowed: for ros2_canopen, a name"),
    ],
)
def test_what_ros2_canopen_cannot_do_is_refused(bus: dict[str, bool], name: str, says: str) -> None:
    table = {"buses": [{"name": "can0", **bus}], "patches": [{"name": name, "node_id": 5}]}
    with pytest.raises(ConfigError, match=says):
        package_files(parse_hand(table))


def test_the_planned_inhibit_time_is_that_of_the_patch_not_of_its_eds(
    hand: HandConfig, tmp_path: Path
) -> None:
    folder = written(hand, tmp_path)["can0"]
    found = yaml.safe_load((folder / "bus.yml").read_text(encoding="utf-8"))
    chunks = PatchProfile.from_layout(hand.patches[0].layout.build()).n_chunks
    (inhibit,) = (e["value"] for e in found["p0"]["sdo"] if (e["index"], e["sub_index"]) == (0x1800, 3))
    assert 0.6 * hand.sync.period_ms < 0.1 * inhibit * (chunks + 1) <= 0.8 * hand.sync.period_ms
