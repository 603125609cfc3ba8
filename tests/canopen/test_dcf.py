"""A DCF read by two independent parsers, and a node configured with it by a master of another make."""

from __future__ import annotations

import logging
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import canopen
import dcf
import numpy as np
import pytest

from skinnode.config import BusConfig
from skinnode.errors import ConfigError
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NodeRunner, PatchNode
from skinnode.protocol.eds_files import REFERENCE_PROFILES, dcf_text, eds_name, eds_text
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort

NODE_ID = 77


@pytest.fixture(params=REFERENCE_PROFILES, ids=eds_name)
def profile(request: pytest.FixtureRequest) -> PatchProfile:
    return request.param


@pytest.fixture
def file(profile: PatchProfile, tmp_path: Path) -> Path:
    path = tmp_path / "patch.dcf"
    path.write_text(dcf_text(profile, NODE_ID, 250_000), encoding="ascii")
    return path


def written(profile: PatchProfile) -> dict[tuple[int, int], int]:
    """What a master has to write: all that can be written but commands and histories."""
    return {
        (entry.index, entry.subindex): entry.default + NODE_ID * entry.plus_node_id
        for item in profile.objects()
        for entry in item.entries
        if entry.access.startswith("rw")
        and isinstance(entry.default, int)
        and entry.index not in (0x1003, 0x1010, 0x1011)
    }


@pytest.mark.long
def test_dcfchk_accepts_it_without_a_word(file: Path) -> None:
    tool = shutil.which("dcfchk", path=str(Path(sys.executable).parent)) or shutil.which("dcfchk")
    assert tool is not None
    done = subprocess.run([tool, str(file)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.long
def test_dcf_tools_know_node_and_values(file: Path, profile: PatchProfile) -> None:
    device = dcf.Device.from_dcf(str(file))  # the node-ID is the file's own
    assert device.node_id == NODE_ID
    assert device[0x1014][0].parse_value() == 0x80 + NODE_ID
    values = {
        (index, sub.sub_index): sub.parse_value()
        for index, item in device.items()
        for sub in item.values()
        if hasattr(sub, "parameter_value")
    }
    assert values == written(profile)
    assert not any(0x2200 <= index < 0x2300 for index, _ in values)  # a baseline is measured, not configured
    assert values[0x1800, 1] == 0x180 + NODE_ID


def test_canopen_knows_node_bit_rate_and_values(file: Path, profile: PatchProfile) -> None:
    loaded = canopen.import_od(str(file))
    assert (loaded.node_id, loaded.bitrate) == (NODE_ID, 250_000)
    for (index, subindex), value in written(profile).items():
        assert loaded.get_variable(index, subindex).value == value


def test_it_is_the_eds_with_values(profile: PatchProfile) -> None:
    added = {"LastEDS", "ParameterValue", "NodeID", "NodeName", "Baudrate", "NetNumber", "NetworkName"}
    added |= {"CANopenManager"}
    rest = [
        line
        for line in dcf_text(profile, NODE_ID, 1_000_000).splitlines()
        if line.partition("=")[0] not in added and line != "[DeviceComissioning]"
    ]
    sheet = eds_text(profile).splitlines()
    assert rest[1] == f"FileName={eds_name(profile)[:-4]}-node{NODE_ID}.dcf"
    assert [line for line in rest[2:] if line] == [line for line in sheet[2:] if line]


def eventually(holds: Callable[[], bool]) -> None:
    """Wait, within a bounded time."""
    end_s = time.monotonic() + 5.0
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.005)


class Still:
    def __init__(self, layout: PatchLayout) -> None:
        self.ohm = np.full(layout.shape, 1e4)

    def read(self, t_ns: int) -> Float:
        return self.ohm


@pytest.mark.parametrize("bus", ["classic", "fd"])
def test_a_master_of_another_make_configures_a_node_with_it(
    bus: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The canopen library writes every value; the node refuses none and is back at its defaults."""
    layout = PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=2)
    profile = PatchProfile.from_layout(layout, 16, "fd" if bus == "fd" else "classic")
    path = tmp_path / "patch.dcf"
    path.write_text(dcf_text(profile, NODE_ID, 1_000_000), encoding="ascii")
    config = BusConfig(channel=uuid.uuid4().hex, fd=bus == "fd")
    network = canopen.Network()
    network.connect(interface="virtual", channel=config.channel)
    with CanPort(config) as port:
        node = PatchNode(NODE_ID, layout, Still(layout), send=port.send, profile=profile)
        try:
            remote = network.add_node(NODE_ID, str(path))
            with NodeRunner(port, [node]), caplog.at_level(logging.WARNING, "canopen"):
                eventually(lambda: remote.nmt.state == "PRE-OPERATIONAL")
                remote.sdo[0x2020][3].raw = 77
                remote.sdo[0x1017].raw = 500
                remote.load_configuration()
                assert remote.sdo[0x2020][3].raw == 10
                assert remote.sdo[0x1017].raw == 0
                assert remote.sdo[0x1800][1].raw == 0x180 + NODE_ID
                assert remote.sdo[0x1A00][0].raw == (5 if bus == "classic" else 9)
        finally:
            network.disconnect()
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    # The library has no PDO of more than 64 bits, says so while it reads the mapping, and goes on.
    assert all(bus == "fd" and "exceeded" in line and "> 64)" in line for line in said), said


@pytest.mark.parametrize(
    ("node_id", "bitrate_bps", "key"),
    [
        (0, 1_000_000, "node_id"),
        (128, 1_000_000, "node_id"),
        (4, 999_999, "bitrate"),
        (4, 300_000, "bitrate"),
    ],
)
def test_nodes_and_bit_rates_that_do_not_exist(node_id: int, bitrate_bps: int, key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        dcf_text(REFERENCE_PROFILES[0], node_id, bitrate_bps)
