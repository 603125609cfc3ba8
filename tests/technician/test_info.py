"""One node on one screen: what is read is what is in the node, and faults are named."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from skinnode.errors import SdoAbort
from skinnode.host.network import RemoteOd
from skinnode.model.config import BusConfig
from skinnode.node import PatchNode
from skinnode.technician.info import read_info
from skinnode.technician.line import Line
from skinnode.wire import indices as od

from .conftest import LAYOUT, Rest, run

Powered = Callable[..., list[PatchNode]]
LineOn = Callable[[BusConfig], Line]


def test_tells_what_is_in_the_node(any_bus: BusConfig, powered: Powered, line_on: LineOn) -> None:
    powered(any_bus, 5, serial=4711)
    line = line_on(any_bus)
    remote = line.od(5)
    remote.write(od.HEARTBEAT_PRODUCER, 0, "u16", 100)
    remote.write(od.SEND_POLICY, od.SEND_MODE, "u8", 1)
    remote.write(od.TPDO1_PARAMETER, od.PDO_EVENT_TIMER, "u16", 500)
    remote.write(od.HEARTBEAT_CONSUMER, 1, "u32", 9 << 16 | 1500)
    line.link.send(0x205, b"\0")  # RPDO1 maps six bytes; a node that is not operational ignores it
    line.link.send(0x080, b"\0")  # SYNC with a counter that 0x1019 does not announce
    found = read_info(line, 5)
    assert (found.state, found.state_known_by, found.heartbeat_ms) == ("pre-operational", "heartbeat", 100)
    assert (found.vendor_id, found.product_code, found.serial) == (0, 0x534B494E, 4711)
    assert found.heartbeats_watched == ("node 9 within 1500 ms",)
    assert found.storing == "on command; no verified configuration (0x1020)"
    assert found.errors == ("0x8240 SYNC of unexpected length: 1 bytes in place of 0",)
    assert found.pdo_texts[0] == (
        "TPDO1 0x185, on event, 1 ms apart at least, sent every 500 ms at least, 8 bytes: "
        "Chunk index; Chunk scan counter; Code 1 to 3"
    )
    assert found.pdo_texts[1].startswith("TPDO2 0x285, every SYNC, 8 bytes")
    assert found.pdo_texts[2] == "TPDO3 off"
    patch = found.patch
    assert patch is not None
    assert (patch.upper_wires, patch.lower_wires, patch.layout) == (2, 6, "staggered")
    assert (patch.layout_hash, patch.code_bits) == (LAYOUT.layout_hash, 16)
    assert patch.send_changed_only
    assert patch.baseline_missing == 0
    assert patch.rejected == {"SYNC": 1}
    assert found.faults == ()


def test_the_baseline_is_read_as_a_block_and_else_in_segments(
    bus: BusConfig, powered: Powered, line_on: LineOn, monkeypatch: pytest.MonkeyPatch
) -> None:
    skin = Rest(LAYOUT)
    powered(bus, 5, source=skin)
    line, expected = line_on(bus), np.median(skin.read(0))
    segments = RemoteOd.read_bytes

    def no_segments(remote: RemoteOd, index: int, subindex: int) -> bytes:
        assert index != od.BASELINE_DOMAIN
        return segments(remote, index, subindex)

    def no_block(remote: RemoteOd, index: int) -> bytes:
        raise SdoAbort(remote.node_id, 0x05040001, "no such command")

    for name, refused in (("read_bytes", no_segments), ("read_block", no_block)):
        with monkeypatch.context() as patched:
            patched.setattr(RemoteOd, name, refused)
            patch = read_info(line, 5).patch
        assert patch is not None
        assert patch.baseline_ohm is not None
        np.testing.assert_allclose(patch.baseline_ohm[1], expected, rtol=1e-6)


def test_names_wires_at_fault_and_the_history(bus: BusConfig, powered: Powered, line_on: LineOn) -> None:
    broken = Rest(LAYOUT)
    powered(bus, 5, source=broken)

    def cut(ohm: np.ndarray) -> np.ndarray:
        ohm = ohm.copy()
        ohm[1, :] = np.inf
        ohm[:, 4] = np.where(np.isfinite(ohm[:, 4]), 0.0, np.inf)
        return ohm

    broken.change = cut
    line = line_on(bus)
    line.link.send(0, bytes((1, 5)))
    line.link.send(0x080, b"")
    assert line.wait_until(lambda: line.heard.node(5).emergencies, 5.0)
    done = run(["info", 5, "--json"], bus)
    assert done.status == 1
    assert done.json["patch"]["open_upper"] == [1]
    assert done.json["errors"] == ["0x5000 wire open or shorted: upper wire open 1"]
    assert done.json["faults"] == [
        "error register: generic, manufacturer-specific",
        "upper wires open: 1",
    ]


def test_a_patch_without_a_baseline_is_a_fault(bus: BusConfig, powered: Powered) -> None:
    powered(bus, 5, source=Rest(LAYOUT, lambda ohm: np.full_like(ohm, np.inf)))
    done = run(["info", "5"], bus)
    assert done.status == 1
    assert "12 crossings have no baseline: tare" in done.stdout


def test_fits_a_terminal_of_80_columns(bus: BusConfig, powered: Powered) -> None:
    powered(bus, 5)
    done = run(["info", "0x5"], bus)
    assert done.status == 0
    assert max(map(len, done.stdout.splitlines())) <= 80


def test_nobody_there_or_no_node_id(bus: BusConfig) -> None:
    done = run(["info", "99"], bus)
    assert (done.status, done.stdout) == (2, "")
    assert done.stderr.startswith("error: node 99: does not answer by SDO")
    assert "got 128, allowed: a node-ID from 1 to 127" in run(["info", "128"], bus).stderr
    assert "got 'thumb', allowed: a node-ID from 1 to 127" in run(["info", "thumb"], bus).stderr
