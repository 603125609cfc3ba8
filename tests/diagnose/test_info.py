"""One node on one screen: what is read is what is in the node, and faults are named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from skinnode.canopen import indices as od
from skinnode.config import BusConfig
from skinnode.diagnose import discovery
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.diagnose.data_sheet import read_profile
from skinnode.diagnose.node_info import read_info
from skinnode.errors import SdoAbort
from skinnode.host.sdo_client import RemoteOd
from skinnode.node import PatchNode
from skinnode.process import clock
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort

from .conftest import LAYOUT, Rest, run

Powered = Callable[..., list[PatchNode]]
ConnectionOn = Callable[[BusConfig], BusConnection]


def test_tells_what_is_in_the_node(any_bus: BusConfig, powered: Powered, connection_on: ConnectionOn) -> None:
    powered(any_bus, 5, serial=4711)
    connection = connection_on(any_bus)
    remote = connection.od(5)
    remote.write(od.HEARTBEAT_PRODUCER, 0, "u16", 100)
    remote.write(od.SEND_POLICY, od.SEND_MODE, "u8", 1)
    remote.write(od.TPDO1_PARAMETER, od.PDO_EVENT_TIMER, "u16", 500)
    remote.write(od.HEARTBEAT_CONSUMER, 1, "u32", 9 << 16 | 1500)
    connection.link.send(0x205, b"\0")  # RPDO1 maps six bytes; a node that is not operational ignores it
    connection.link.send(0x080, b"\0")  # SYNC with a counter that 0x1019 does not announce
    found = read_info(connection, 5)
    assert (found.state, found.state_known_by, found.heartbeat_ms) == ("pre-operational", "heartbeat", 100)
    assert (found.vendor_id, found.product_code, found.serial) == (0, 0x534B494E, 4711)
    assert found.heartbeats_watched == ("node 9 within 1500 ms",)
    assert found.storing == "on command; no verified configuration (0x1020)"
    assert found.errors == ("0x8240 SYNC of unexpected length: 1 byte instead of 0",)
    assert found.pdo_texts[0] == (
        "TPDO1 0x185, on event, at least 1 ms apart, sent at least every 500 ms, 8 bytes: "
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


@pytest.mark.parametrize(
    ("checked", "revision", "mapped"),
    [
        (True, 0x1_0001, "Summary scan counter; Flags; Chunks sent; Device time 64us; Scan check"),
        (False, 0x1_0000, "Summary scan counter; Flags; Chunks sent; Device time us"),
    ],
)
def test_a_summary_is_described_as_its_revision_has_it(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn, checked: bool, revision: int, mapped: str
) -> None:
    profile = replace(PatchProfile.from_layout(LAYOUT), checked=checked)
    powered(bus, 5, profile=profile)
    connection = connection_on(bus)
    found = read_info(connection, 5)
    assert found.revision == revision
    assert found.pdo_texts[1] == f"TPDO2 0x285, every SYNC, 8 bytes: {mapped}"
    assert read_profile(connection.od(5)) == profile


def test_the_baseline_is_read_as_a_block_and_else_in_segments(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn, monkeypatch: pytest.MonkeyPatch
) -> None:
    skin = Rest(LAYOUT)
    powered(bus, 5, source=skin)
    connection, expected = connection_on(bus), np.median(skin.read(0))
    segments = RemoteOd.read_bytes

    def no_segments(remote: RemoteOd, index: int, subindex: int, *most: int) -> bytes:
        assert index != od.BASELINE_DOMAIN
        return segments(remote, index, subindex, *most)

    def no_block(remote: RemoteOd, index: int, *most: int) -> bytes:
        raise SdoAbort(remote.node_id, 0x05040001, "no such command")

    for name, refused in (("read_bytes", no_segments), ("read_block", no_block)):
        with monkeypatch.context() as patched:
            patched.setattr(RemoteOd, name, refused)
            patch = read_info(connection, 5).patch
        assert patch is not None
        assert patch.baseline_ohm is not None
        np.testing.assert_allclose(patch.baseline_ohm[1], expected, rtol=1e-6)


def test_names_wires_at_fault_and_the_history(
    bus: BusConfig, powered: Powered, connection_on: ConnectionOn
) -> None:
    broken = Rest(LAYOUT)
    powered(bus, 5, source=broken)

    def cut(ohm: np.ndarray) -> np.ndarray:
        ohm = ohm.copy()
        ohm[1, :] = np.inf
        ohm[:, 4] = np.where(np.isfinite(ohm[:, 4]), 0.0, np.inf)
        return ohm

    broken.change = cut
    connection = connection_on(bus)
    connection.link.send(0, bytes((1, 5)))
    connection.link.send(0x080, b"")
    assert connection.wait_until(lambda: connection.listener.node(5).emergencies, 5.0)
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
    assert "12 crossings have no baseline; run skinnode tare" in done.stdout


def test_fits_a_terminal_of_80_columns_and_is_whole_in_a_pipe(
    bus: BusConfig, powered: Powered, monkeypatch: pytest.MonkeyPatch
) -> None:
    powered(bus, 5)
    monkeypatch.delenv("COLUMNS", raising=False)
    whole = run(["info", "0x5"], bus)
    assert whole.status == 0
    assert any(len(line.rstrip()) > 80 for line in whole.stdout.splitlines())
    monkeypatch.setenv("COLUMNS", "80")
    wrapped = run(["info", "0x5"], bus)
    assert max(map(len, wrapped.stdout.splitlines())) <= 80
    assert len(wrapped.stdout.splitlines()) > len(whole.stdout.splitlines())
    assert wrapped.stdout.split() == whole.stdout.split()


def test_nobody_there_or_no_node_id(bus: BusConfig) -> None:
    with CanPort(bus):  # acknowledges each frame, which would otherwise be sent again and again
        done = run(["info", "99"], bus)
    assert (done.status, done.stdout) == (2, "")
    assert done.stderr.startswith("error: node 99: does not answer SDO requests")
    assert "got 128, allowed: a node-ID from 1 to 127" in run(["info", "128"], bus).stderr
    assert "got 'thumb', allowed: a node-ID from 1 to 127" in run(["info", "thumb"], bus).stderr


@contextmanager
def _babbler(bus: BusConfig, node_id: int, answer: Callable[[bytes], bytes]) -> Iterator[None]:
    """A node that sends heartbeats, and ``answer`` of each SDO request."""
    over = clock.event()

    def babble(port: CanPort) -> None:
        while not over.is_set():
            port.send(od.heartbeat_cob_id(node_id), b"\x7f")
            frame = port.recv(0.05)
            while frame is not None and not over.is_set():
                if frame.can_id == od.sdo_request_cob_id(node_id):
                    port.send(od.sdo_response_cob_id(node_id), answer(frame.data))
                frame = port.recv(0.05)

    with CanPort(bus) as port:
        thread = clock.thread(babble, "babbler", (port,))
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


@pytest.mark.parametrize(
    ("answer", "shown"),
    [
        (lambda request: bytes(8), "00 00 00 00 00 00 00 00"),
        (lambda request: b"\x13\x37", "13 37"),
        (lambda request: b"", "no data"),
    ],
)
def test_nonsense_is_not_called_silence(
    bus: BusConfig, monkeypatch: pytest.MonkeyPatch, answer: Callable[[bytes], bytes], shown: str
) -> None:
    monkeypatch.setattr(discovery, "LISTEN_S", 0.5)
    monkeypatch.setattr(discovery, "PACE_S", 0.0001)
    said = f"sends SDO frames that are not responses to the request (newest: {shown})"
    with _babbler(bus, 9, answer):
        for command in (["info", "9"], ["od", "9", "1000"], ["od", "9"]):
            done = run(command, bus)
            assert (done.status, done.stdout) == (2, "")
            assert done.stderr.startswith(f"error: node 9: {said}")
            assert len(done.stderr.splitlines()) == 1
        assert said in run(["doctor"], bus).stdout.replace("\n", " ")
        assert "no valid answer" in run(["scan"], bus).stdout
