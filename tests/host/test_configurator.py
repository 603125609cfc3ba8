"""Bring-up: a node that is not what the hand file says is named in one line, and nothing is left running."""

from __future__ import annotations

import struct
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from skinnode.canopen.nmt import NmtState
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import BusError, ConfigError, NodeError, NodeTimeout, ProfileError, SdoAbort
from skinnode.host import BringUpCancelled, Host
from skinnode.host.hand_files import check_eds
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node.patch.patch_node import PatchNode
from skinnode.node.runner import NodeRunner
from skinnode.process import clock
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from vcan_sim.fleet import Fleet

from .conftest import SMALL, eventually, heard
from .test_roles import changed

LAYOUT = PatchLayout.preset("staggered", **SMALL)


class Rest:
    """A patch that nobody touches."""

    def __init__(self, layout: PatchLayout) -> None:
        self._resistance_ohm = resistance_ohm(layout, layout.upper_m)

    def read(self, t_ns: int) -> Float:
        return self._resistance_ohm


Tamper = Callable[[int, bytes], bytes]


def node(
    port: CanPort, node_id: int, layout: PatchLayout = LAYOUT, tamper: Tamper | None = None, **options: Any
) -> PatchNode:
    """The real node; ``tamper`` may change what it sends."""

    def send(can_id: int, data: bytes) -> None:
        port.send(can_id, data if tamper is None else tamper(can_id, data))

    return PatchNode(node_id, layout, Rest(layout), send=send, **options)


def answer_instead(index: int, subindex: int, value: bytes) -> Tamper:
    """Another value in the answer to an expedited SDO upload."""
    key = struct.pack("<HB", index, subindex)

    def tamper(can_id: int, data: bytes) -> bytes:
        is_answer = can_id & 0x780 == 0x580 and data[0] & 0xE0 == 0x40 and data[1:4] == key
        return data[:4] + value.ljust(4, b"\0") if is_answer else data

    return tamper


def abort_instead(index: int, subindex: int, code: int) -> Tamper:
    """An abort in place of the answer to an SDO download."""
    key = struct.pack("<HB", index, subindex)

    def tamper(can_id: int, data: bytes) -> bytes:
        is_answer = can_id & 0x780 == 0x580 and data[0] == 0x60 and data[1:4] == key
        return b"\x80" + key + code.to_bytes(4, "little") if is_answer else data

    return tamper


def failure_of(
    hand: HandConfig, *make: Callable[[CanPort], PatchNode], deadline_s: float = 3.0
) -> BaseException:
    """What bring-up raises with these nodes on the bus."""
    with (
        CanPort(hand.buses[0]) as port,
        NodeRunner(port, [one(port) for one in make]),
        pytest.raises((BusError, ConfigError)) as caught,
        Host.from_config(hand, boot_deadline_s=deadline_s),
    ):
        pass
    assert "\n" not in str(caught.value)
    return caught.value


def test_brings_a_hand_up_and_down(hand: HandConfig, fleet: Fleet, listener: CanPort) -> None:
    with Host.from_config(hand) as host:
        assert {report.nmt_state for report in fleet.report()} == {NmtState.OPERATIONAL}
        assert host.fields(timeout_s=10).get(10) is not None
    assert eventually(lambda: {report.nmt_state for report in fleet.report()} == {NmtState.PRE_OPERATIONAL})
    heard(listener)
    clock.sleep(0.3)
    # Heartbeats of two pre-operational nodes, and nothing else: no SYNC, no PDO.
    assert {(frame.can_id, frame.data) for frame in heard(listener)} == {(0x705, b"\x7f"), (0x706, b"\x7f")}


def test_configuration_is_in_the_node(hand: HandConfig, fleet: Fleet) -> None:
    from skinnode.host.link import BusLink
    from skinnode.host.mainline import Mainline

    with Host.from_config(hand):
        pass
    with BusLink(hand.buses[0], {}, lambda error: None) as link, Mainline([link]):
        od = link.remote_od(5)
        assert od.read(0x1005, 0, "u32") == 0x80
        assert od.read(0x1006, 0, "u32") == 25_000
        assert od.read(0x1019, 0, "u8") == 240
        assert od.read(0x1017, 0, "u16") == 250
        assert (od.read(0x1800, 1, "u32"), od.read(0x1800, 2, "u8")) == (0x185, 254)
        assert od.read(0x1800, 3, "u16") == 11  # 0.8 · 25 ms over 16 chunks and a summary, in 100 µs
        assert (od.read(0x1801, 1, "u32"), od.read(0x1801, 2, "u8")) == (0x285, 1)


def test_the_inhibit_time_fits_its_object_however_far_apart_the_scans_are(
    make_hand: Callable[..., HandConfig],
) -> None:
    layout = {"upper_wires": 2, "upper_electrodes": 2, "lower_wires": 6, "lower_electrodes": 2}
    hand = changed(make_hand(patches=1), patch={"layout": layout}, sync={"period_ms": 60_000})
    with Fleet(hand), Host.from_config(hand) as host:  # 0.8 of a minute over 4 chunks and a summary
        assert host.health("p0").nmt_state == NmtState.OPERATIONAL


def test_what_an_integrator_has_set_does_not_stand_in_the_way(
    make_hand: Callable[..., HandConfig],
) -> None:
    """A stored synchronous window would discard the summaries of scans, and an entry of 0x1016 that watches
    this host already would have entry 1 refused. Other entries stay."""
    from skinnode.host.link import BusLink
    from skinnode.host.mainline import Mainline

    table = {
        "name": "can0",
        "interface": "timed",
        "channel": uuid.uuid4().hex[:8],
        "heartbeat_node_id": 100,
    }
    hand = make_hand(1, buses=[table])
    with Fleet(hand):
        with BusLink(hand.buses[0], {}, lambda error: None) as link, Mainline([link]):
            od = link.remote_od(5)
            od.write(0x1007, 0, "u32", 100)
            od.write(0x1016, 7, "u32", 100 << 16 | 9000)
            od.write(0x1016, 8, "u32", 101 << 16 | 9000)
        with Host.from_config(hand) as host:
            assert host.fields(timeout_s=10).get(10) is not None
        with BusLink(hand.buses[0], {}, lambda error: None) as link, Mainline([link]):
            od = link.remote_od(5)
            assert od.read(0x1007, 0, "u32") == 0
            assert [od.read(0x1016, sub, "u32") >> 16 for sub in (1, 7, 8)] == [100, 0, 101]


def test_a_host_that_was_killed_is_followed_by_another(
    hand: HandConfig, fleet: Fleet, listener: CanPort
) -> None:
    """Its nodes are still operational, and somebody's SYNC still comes."""
    listener.send(0x000, b"\x01\x00")
    assert eventually(lambda: {report.nmt_state for report in fleet.report()} == {NmtState.OPERATIONAL})
    listener.send(0x080, b"\x11")
    with Host.from_config(hand) as host:
        field = host.fields(timeout_s=10).get(10)
        assert field is not None
        assert field.stamp is not None
        assert field.stamp.scan < 10  # counted from this host's start, not from the counter of that SYNC, 17
        assert eventually(lambda: all(p.solved > 3 for p in host.stats().patches.values()))
        assert all(patch.assembler.scans_torn == 0 for patch in host.stats().patches.values())


@pytest.mark.long
def test_no_node_at_all(hand: HandConfig) -> None:
    start_s = clock.monotonic()
    with pytest.raises(BusError) as caught, Host.from_config(hand, boot_deadline_s=0.5):
        pass
    assert str(caught.value) == (
        f"can0: interface 'timed', channel '{hand.buses[0].channel}': no response within "
        "0.5 s from any node: 5 (p0), 6 (p1)"
    )
    assert clock.monotonic() - start_s < 10  # no hang


def test_one_node_missing(hand: HandConfig) -> None:
    failure = failure_of(hand, lambda port: node(port, 5), deadline_s=0.5)
    assert isinstance(failure, NodeTimeout)
    assert failure.node_id == 6
    assert str(failure) == ("node 6: patch 'p1' on can0: no response within 0.5 s from 6 (p1)")


@pytest.mark.parametrize(
    ("subindex", "value", "line"),
    [
        (1, 0x1234, "vendor-ID: got 0x00001234, expected 0x00000000 (a skinnode patch)"),
        (2, 0x0192_0402, "product code: got 0x01920402, expected 0x534B494E (a skinnode patch)"),
        (3, 0x0002_0003, "revision: got 2.3, expected 1.x"),
    ],
)
def test_identity_differs(
    make_hand: Callable[..., HandConfig],
    listener_of: Callable[[HandConfig], CanPort],
    subindex: int,
    value: int,
    line: str,
) -> None:
    hand = make_hand(patches=1)
    listener = listener_of(hand)
    tamper = answer_instead(0x1018, subindex, value.to_bytes(4, "little"))
    failure = failure_of(hand, lambda port: node(port, 5, tamper=tamper))
    assert isinstance(failure, NodeError)
    assert str(failure) == f"node 5: patch 'p0' on can0: {line}"
    # It could be a drive: nothing was written to it, and no NMT command was sent to it.
    frames = heard(listener)
    assert {frame.data[0] & 0xE0 for frame in frames if frame.can_id == 0x605} == {0x40}
    assert not [frame for frame in frames if frame.can_id == 0x000]


def test_serial_number_differs(make_hand: Callable[..., HandConfig]) -> None:
    patches = [{"name": "p0", "node_id": 5, "layout": SMALL, "tolerances": "exact", "serial": 7}]
    hand = parse_hand({**make_hand(patches=1).model_dump(mode="json"), "patches": patches})
    assert str(failure_of(hand, lambda port: node(port, 5, serial=8))) == (
        "node 5: patch 'p0' on can0: serial number: got 8, expected 7 as in the hand file"
    )


def test_layout_hash_differs(make_hand: Callable[..., HandConfig]) -> None:
    other = PatchLayout.preset("staggered", height_m=3e-3, **SMALL)
    failure = failure_of(make_hand(patches=1), lambda port: node(port, 5, other))
    assert isinstance(failure, NodeError)
    assert str(failure) == (
        f"node 5: patch 'p0' on can0: layout hash: got 0x{other.layout_hash:08X}, "
        f"expected 0x{LAYOUT.layout_hash:08X} (staggered as in the hand file)"
    )


def test_size_differs(make_hand: Callable[..., HandConfig]) -> None:
    other = PatchLayout.preset("staggered", **{**SMALL, "lower_wires": 9})
    assert str(failure_of(make_hand(patches=1), lambda port: node(port, 5, other))) == (
        "node 5: patch 'p0' on can0: lower wires: got 9, expected 12 as in the hand file"
    )


def test_code_width_differs(make_hand: Callable[..., HandConfig]) -> None:
    wide = PatchProfile.from_layout(LAYOUT, 24)
    assert str(failure_of(make_hand(patches=1), lambda port: node(port, 5, profile=wide))) == (
        "node 5: patch 'p0' on can0: code bits: got 24, expected 16 as in the hand file"
    )


def test_frames_of_the_bus_differ(make_hand: Callable[..., HandConfig]) -> None:
    """The hand file says CAN FD, the node sends its PDOs in classic frames."""
    hand = make_hand(
        patches=1, buses=[{"name": "can0", "interface": "timed", "channel": uuid.uuid4().hex, "fd": True}]
    )
    assert str(failure_of(hand, lambda port: node(port, 5))) == (
        "node 5: patch 'p0' on can0: bytes of a PDO: got 8, expected 64 as in the hand file"
    )


def test_configuration_that_is_not_kept(make_hand: Callable[..., HandConfig]) -> None:
    tamper = answer_instead(0x1017, 0, b"\x00\x00")
    assert str(failure_of(make_hand(patches=1), lambda port: node(port, 5, tamper=tamper))) == (
        "node 5: object 0x1017:0: read back 0x0 after writing 0xFA"
    )


def test_configuration_that_is_refused(make_hand: Callable[..., HandConfig]) -> None:
    tamper = abort_instead(0x1019, 0, 0x0800_0022)
    failure = failure_of(make_hand(patches=1), lambda port: node(port, 5, tamper=tamper))
    assert isinstance(failure, SdoAbort)
    assert failure.code == 0x0800_0022
    assert str(failure).startswith("node 5: SDO abort 0x08000022: write of object 0x1019:0: ")
    assert "present device state" in str(failure)


def test_baseline_that_is_no_resistance(make_hand: Callable[..., HandConfig]) -> None:
    baseline_ohm = Rest(LAYOUT).read(0).copy()
    baseline_ohm[2, 3] = 0.0  # a wire that was open when the patch was tared
    assert str(failure_of(make_hand(patches=1), lambda port: node(port, 5, baseline_ohm=baseline_ohm))) == (
        "node 5: patch 'p0' on can0: baseline of upper wire 2, lower wire 3: got 0 ohm, "
        "expected a positive resistance (tare the patch)"
    )


def test_other_mapping(make_hand: Callable[..., HandConfig]) -> None:
    tamper = answer_instead(0x1A00, 2, bytes.fromhex("08 02 11 20"))
    assert str(failure_of(make_hand(patches=1), lambda port: node(port, 5, tamper=tamper))) == (
        "node 5: patch 'p0' on can0: object mapped by 0x1A00:2: got 0x20110208, expected 0x20100208"
    )


OLD = replace(PatchProfile.from_layout(LAYOUT), checked=False)


def test_mapping_of_the_other_revision(make_hand: Callable[..., HandConfig]) -> None:
    """A node says that it is of 1.1 and maps as 1.0 does, and the other way round."""
    new = answer_instead(0x1018, 3, bytes.fromhex("01 00 01 00"))
    assert str(failure_of(make_hand(patches=1), lambda port: node(port, 5, tamper=new, profile=OLD))) == (
        "node 5: patch 'p0' on can0: entries mapped in 0x1A01: got 4, expected 5"
    )
    old = answer_instead(0x1018, 3, bytes.fromhex("00 00 01 00"))
    assert str(failure_of(make_hand(patches=1), lambda port: node(port, 5, tamper=old))) == (
        "node 5: patch 'p0' on can0: entries mapped in 0x1A01: got 5, expected 4"
    )


@pytest.mark.parametrize("checked", [False, True])
def test_bring_up_knows_whether_a_node_sends_checks(hand: HandConfig, checked: bool) -> None:
    """p1 is of revision 1.0 in one case."""
    with Fleet(hand, unchecked=() if checked else ("p1",)), Host.from_config(hand) as host:
        assert eventually(lambda: all(p.solved > 3 for p in host.stats().patches.values()))
        facts = {name: host._nodes[name].facts for name in ("p0", "p1")}
    assert {name: each is not None and each.checked for name, each in facts.items()} == {
        "p0": True,
        "p1": checked,
    }


def test_the_other_nodes_are_pre_operational_when_one_fails(hand: HandConfig) -> None:
    other = PatchLayout.preset("staggered", height_m=3e-3, **SMALL)
    with CanPort(hand.buses[0]) as port, CanPort(hand.buses[0]) as listener:
        good, bad = node(port, 5), node(port, 6, other)
        with NodeRunner(port, [good, bad]):
            complaint = pytest.raises(NodeError, match=r"^node 6: patch 'p1' on can0: layout hash: ")
            with complaint, Host.from_config(hand):
                pass
            assert good.nmt_state is bad.nmt_state is NmtState.PRE_OPERATIONAL
            heard(listener)
            clock.sleep(0.1)
            assert [frame for frame in heard(listener) if frame.can_id < 0x700] == []


def test_node_that_never_goes_operational(make_hand: Callable[..., HandConfig]) -> None:
    def tamper(can_id: int, data: bytes) -> bytes:
        return b"\x7f" if can_id == 0x705 and data == b"\x05" else data

    failure = failure_of(make_hand(patches=1), lambda port: node(port, 5, tamper=tamper))
    assert isinstance(failure, NodeTimeout)
    assert str(failure) == (
        "node 5: patch 'p0' on can0: got NMT state 127 after the start command, "
        "expected 5 (operational) within 1 s"
    )


def test_interface_that_does_not_open(hand: HandConfig) -> None:
    with pytest.raises(BusError) as caught, Host.from_config(hand, interface="socketcan", channel="nocan0"):
        pass
    line = str(caught.value)
    assert line.startswith("can0: interface 'socketcan', channel 'nocan0': cannot be opened (")
    assert ", allowed: " in line
    assert "\n" not in line


def test_interface_that_is_not_known(hand: HandConfig) -> None:
    with pytest.raises(BusError) as caught, Host.from_config(hand, interface="carrier-pigeon"):
        pass
    assert str(caught.value).startswith("can0: interface 'carrier-pigeon', channel ")
    assert "no such interface, allowed: " in str(caught.value)


@pytest.mark.system_time  # on a bus with exact times, the two answers collide
def test_two_nodes_with_one_node_id_are_named(hand: HandConfig) -> None:
    """Both answer each request: some transfer fails, or all happen to succeed and the heartbeats tell."""
    second = hand.model_copy(update={"patches": hand.patches[:1]})
    refusal = None
    with Fleet(hand), Fleet(second):
        try:
            with Host.from_config(hand) as host:
                assert eventually(lambda: host.health(hand.patches[0].name).duplicate_id)
        except NodeError as error:
            refusal = str(error)
    if refusal is not None:
        assert refusal.startswith("node 5: ")
        assert refusal.endswith("; one request got 2 responses: two nodes have node-ID 5 (see skinnode scan)")


def test_cancelled(hand: HandConfig) -> None:
    with pytest.raises(BringUpCancelled), Host.from_config(hand, cancelled=lambda: True):
        pass


def with_eds(hand: HandConfig, path: Path) -> HandConfig:
    patches = tuple(patch.model_copy(update={"eds": path}) for patch in hand.patches)
    return hand.model_copy(update={"patches": patches})


@pytest.mark.long
def test_eds_of_the_profile_is_accepted(hand: HandConfig, fleet: Fleet, tmp_path: Path) -> None:
    path = tmp_path / "patch.eds"
    path.write_text(eds_text(PatchProfile.from_layout(LAYOUT)))
    with Host.from_config(with_eds(hand, path)):
        pass


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8-sig", "utf-16"])
def test_eds_in_another_encoding(tmp_path: Path, encoding: str) -> None:
    profile = PatchProfile.from_layout(LAYOUT)
    text = eds_text(profile).replace("VendorName=", "VendorName=Müller, once ")
    (tmp_path / "patch.eds").write_text(text, encoding=encoding)
    check_eds(tmp_path / "patch.eds", profile)


@pytest.mark.parametrize(
    ("profile", "line"),
    [
        (PatchProfile(4, 9, 4, 4), "0x2000:2 Lower wires: got 9, allowed: 12"),
        (PatchProfile(4, 12, 4, 4, code_bits=24), "0x2000:5 Code bits: got 24, allowed: 16"),
    ],
)
def test_eds_of_another_patch(hand: HandConfig, tmp_path: Path, profile: PatchProfile, line: str) -> None:
    path = tmp_path / "patch.eds"
    path.write_text(eds_text(profile))
    with pytest.raises(ProfileError) as caught, Host.from_config(with_eds(hand, path)):
        pass
    assert str(caught.value) == f"{path}: {line} in a patch of 4x12 wires at 16 bits"


def test_eds_with_an_object_missing(hand: HandConfig, tmp_path: Path) -> None:
    path = tmp_path / "patch.eds"
    text = eds_text(PatchProfile.from_layout(LAYOUT))
    head, tail = text.split("[1019]\n")
    path.write_text(head + tail[tail.index("[") :])
    with pytest.raises(ProfileError) as caught, Host.from_config(with_eds(hand, path)):
        pass
    assert str(caught.value) == (
        f"{path}: 0x1019:0: got 'no such object', "
        "allowed: Synchronous counter overflow value of a patch of 4x12 wires at 16 bits"
    )


def test_eds_that_is_none(hand: HandConfig, tmp_path: Path) -> None:
    path = tmp_path / "patch.eds"
    path.write_text("once upon a time\n")
    with pytest.raises(ProfileError) as caught, Host.from_config(with_eds(hand, path)):
        pass
    assert str(caught.value).startswith(f"{path}:1: EDS: got 'once upon a time', ")
    assert "allowed: a file in CiA 306 format" in str(caught.value)
    assert "\n" not in str(caught.value)
