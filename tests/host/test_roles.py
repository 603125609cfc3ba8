"""The host as master, and beside another master; frames of other masters; patches found by serial number."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.cli._run_report import faults_and_notes
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import BusError, ConfigError, NodeError
from skinnode.host import Condition, Host
from skinnode.host.accounting import discrepancies
from skinnode.host.sync import SyncProducer, Ticks
from skinnode.model.layout import PatchLayout
from skinnode.node import NmtState
from skinnode.process import clock
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort

from .conftest import SMALL, Rack, eventually, heard
from .test_supervisor import scans, take


def changed(hand: HandConfig, *, bus: Any = None, patch: Any = None, **tables: Any) -> HandConfig:
    """The hand with other keys of its buses and its patches."""
    table = {**hand.model_dump(mode="json"), **tables}
    table["buses"] = [{**one, **(bus or {})} for one in table["buses"]]
    table["patches"] = [{**one, **(patch or {})} for one in table["patches"]]
    return parse_hand(table)


@contextmanager
def robot(port: CanPort, hand: HandConfig) -> Iterator[None]:
    """The robot's own master: it configures the SYNC counter, starts all nodes and sends SYNC."""
    for patch in hand.patches:
        port.send(0x600 + patch.node_id, bytes.fromhex("2f 19 10 00 f0 00 00 00"))
    port.send(0x000, b"\x01\x00")
    with SyncProducer([(port.send, Ticks(240))], hand.sync.period_s):
        yield


def baseline_file(rack: Rack, folder: Path) -> Path:
    """What the robot's integrator measured."""
    path = folder / "baseline.txt"
    np.savetxt(path, rack.sources["p0"].ohm)
    return path


def of_nodes(port: CanPort) -> set[int]:
    """COB-IDs heard that only a node may send, of those of the hand."""
    return {base + node_id for base in (0x080, 0x180, 0x280, 0x580, 0x700) for node_id in (5, 6)}


@pytest.mark.real_time
def test_a_guest_that_may_send_nothing_sends_nothing_and_hears_all(
    crossing_hand: HandConfig, rack_of: Callable[[HandConfig], Rack], tmp_path: Path,
    listener_of: Callable[[HandConfig], CanPort],
) -> None:  # fmt: skip
    rack = rack_of(crossing_hand)
    file = str(baseline_file(rack, tmp_path))
    hand = changed(crossing_hand, bus={"role": "guest"}, patch={"baseline": file}, sync={"period_ms": 100})
    port = listener_of(hand)
    for name in ("p0", "p1"):
        rack.plug(name)
    with robot(port, hand):
        with Host.from_config(hand) as host:
            for name in ("p0", "p1"):
                numbers = scans(take(host.fields(timeout_s=10, patch=name), 6))
                assert numbers == list(range(numbers[0], numbers[0] + 6))
                latest = host.latest(name)
                assert latest is not None
                assert latest.stamp is not None
                assert 0 < latest.stamp.t_sync_ns < latest.stamp.t_receive_ns
            assert host.stats().sync.received > 0
            assert host.stats().sync.irregular == 0
            assert (host.stats().sync.sent, host.stats().buses["can0"].sent) == (0, 0)
        assert {frame.can_id for frame in heard(port)} <= of_nodes(port)
        assert {node.nmt_state for node in rack.nodes.values()} == {NmtState.OPERATIONAL}


def test_a_guest_that_sends_nothing_learns_by_the_flag_who_sends_checks(
    hand: HandConfig, rack_of: Callable[[HandConfig], Rack], tmp_path: Path, listener: CanPort
) -> None:
    """p1 is of revision 1.0. Summaries of both are lost from some time on."""
    lost = clock.event()

    def lets_through(can_id: int, data: bytes) -> bool:
        return not (lost.is_set() and can_id & 0x780 == 0x280)

    rack = rack_of(hand)
    file = str(baseline_file(rack, tmp_path))
    hand = changed(hand, bus={"role": "guest"}, patch={"baseline": file})
    old = replace(PatchProfile.from_layout(hand.patch("p1").layout.build()), checked=False)
    rack.plug("p0", lets_through=lets_through)
    rack.plug("p1", lets_through=lets_through, profile=old)

    def published(host: Host) -> dict[str, tuple[int, int]]:
        assemblers = {name: stream.assembler for name, stream in host.stats().patches.items()}
        return {name: (each.scans_complete, each.scans_unchecked) for name, each in assemblers.items()}

    with robot(listener, hand), Host.from_config(hand) as host:
        assert eventually(lambda: all(complete > 5 for complete, _ in published(host).values()))
        assert all(not unchecked for _, unchecked in published(host).values())
        lost.set()
        assert eventually(lambda: published(host)["p0"][1] > 5)
        assert eventually(lambda: host.stats().patches["p1"].assembler.summaries_lost > 5)
        assert published(host)["p1"][1] == 0
        lost.clear()
        complete = published(host)["p0"][0]
        assert eventually(lambda: published(host)["p0"][0] > complete + 5)
    assert discrepancies(host.stats()) == []


def all_operational(host: Host) -> bool:
    return {host.health(patch.name).condition for patch in host.hand.patches} == {Condition.OPERATIONAL}


@pytest.mark.long
@pytest.mark.real_time
def test_a_guest_that_joins_while_patches_run_tears_no_scan(
    hand: HandConfig, rack: Rack, listener: CanPort, tmp_path: Path
) -> None:
    """Whenever it comes: all but the scan under way is whole, and the command ends with 0."""
    file = str(baseline_file(rack, tmp_path))
    hand = changed(hand, bus={"role": "guest"}, patch={"baseline": file}, sync={"period_ms": 100})
    for patch in hand.patches:
        listener.send(0x600 + patch.node_id, bytes.fromhex("2b 17 10 00 64 00 00 00"))  # a heartbeat
    joined = tries = 0
    with robot(listener, hand):
        assert eventually(lambda: {n.nmt_state for n in rack.nodes.values()} == {NmtState.OPERATIONAL})
        while tries < 8 or (joined == 0 and tries < 40):  # whether it comes during a scan depends on chance
            tries += 1
            clock.sleep(tries * 0.0618 % 0.1)  # at another phase of SYNC: each try ends with a scan
            with Host.from_config(hand) as host:
                take(host.fields(timeout_s=10), 4)
                assert eventually(functools.partial(all_operational, host))
                assert faults_and_notes(host)[0] == []
            assert discrepancies(host.stats()) == []
            joined += sum(stream.assembler.scans_joined for stream in host.stats().patches.values())
    assert joined > 0


def test_a_guest_that_hears_no_sync_says_so(hand: HandConfig, rack: Rack, listener: CanPort) -> None:
    hand = changed(hand, bus={"role": "guest", "guest_sends": "sdo"})
    for patch in hand.patches:  # their master forgets the SYNC
        listener.send(0x600 + patch.node_id, bytes.fromhex("2f 19 10 00 f0 00 00 00"))
    listener.send(0x000, b"\x01\x00")
    assert eventually(lambda: {n.nmt_state for n in rack.nodes.values()} == {NmtState.OPERATIONAL})
    with Host.from_config(hand) as host:
        events = host.events()
        assert eventually(lambda: host.bus_health("can0").no_sync)
        assert faults_and_notes(host)[0] == ["can0: no SYNC received from its master"]
        assert "no SYNC" in {told.what for told in iter(lambda: events.get(0.5), None)}
        with SyncProducer([(listener.send, Ticks(240))], hand.sync.period_s):
            assert eventually(lambda: not host.bus_health("can0").no_sync)
            take(host.fields(timeout_s=10), 4)
            assert "can0: no SYNC received from its master" not in faults_and_notes(host)[0]
        assert eventually(lambda: host.bus_health("can0").no_sync)  # and again


@pytest.mark.long
def test_a_guest_that_may_configure_sends_sdo_and_nothing_else(
    hand: HandConfig, rack: Rack, listener: CanPort
) -> None:
    hand = changed(hand, bus={"role": "guest", "guest_sends": "sdo"})
    with robot(listener, hand):
        assert eventually(lambda: {n.nmt_state for n in rack.nodes.values()} == {NmtState.OPERATIONAL})
        with Host.from_config(hand) as host:
            for name in ("p0", "p1"):
                take(host.fields(timeout_s=10, patch=name), 4)
            rack.pull("p1")
            assert eventually(lambda: host.health("p1").condition is Condition.LOST)
            rack.plug("p1")
            assert eventually(lambda: host.health("p1").condition is Condition.REFUSED)
            listener.send(0x606, bytes.fromhex("2f 19 10 00 f0 00 00 00"))  # its master configures it …
            listener.send(0x000, b"\x01\x06")  # … and starts it, when it likes
            take(host.fields(timeout_s=10, patch="p1"), 4)
            assert host.stats().sync.sent == 0
        sent = {frame.can_id for frame in heard(listener)} - of_nodes(listener)
        assert sent == {0x605, 0x606}
        assert {node.nmt_state for node in rack.nodes.values()} == {NmtState.OPERATIONAL}


def test_a_guest_on_a_bus_with_another_sync_counter_is_told_so(hand: HandConfig, rack: Rack) -> None:
    hand = changed(hand, bus={"role": "guest", "guest_sends": "sdo"})
    complaint = "SYNC counter overflow, set by another master: got 0, expected 240"
    with pytest.raises(NodeError, match=complaint), Host.from_config(hand):
        pass


def test_a_guest_that_sends_nothing_and_hears_nothing(hand: HandConfig, tmp_path: Path) -> None:
    file = str(baseline_file(Rack(hand), tmp_path))
    hand = changed(hand, bus={"role": "guest"}, patch={"baseline": file})
    with (
        pytest.raises(BusError, match=r"no response within 0\.2 s from any node"),
        Host.from_config(hand, boot_deadline_s=0.2),
    ):
        pass


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "baseline: got 0 lines"),
        ("1 " * 12 + "\n1 2\n", "baseline, line 2: got 2 numbers"),
        (("1 " * 12 + "\n\n") * 3, "baseline: got 3 lines"),
        ("root:x:0:0\n", "baseline, line 1: got 'root:x:0:0'"),
        ("\n" + "-1 " * 12, "baseline, line 2: got '-1'"),
        ("1e999 " * 12, "baseline, line 1: got '1e999'"),
        ("\x7fELF\x01\x00", "baseline, line 1: got '\\x7fELF\\x01\\x00'"),
    ],
)
def test_a_baseline_file_that_is_none(hand: HandConfig, tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "baseline.txt"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught, Host.from_config(changed(hand, patch={"baseline": str(file)})):
        pass
    assert str(caught.value) == f"{file}: {says}, allowed: 4 lines of 12 positive resistances in ohms"


@pytest.mark.long
def test_a_baseline_of_a_file_is_written_to_the_node_once(
    hand: HandConfig, rack: Rack, listener: CanPort, tmp_path: Path
) -> None:
    file = tmp_path / "baseline.txt"
    np.savetxt(file, 1.01 * rack.sources["p0"].ohm)
    hand = changed(hand, patch={"baseline": str(file)})
    with Host.from_config(hand) as host:
        field = take(host.fields(timeout_s=10, patch="p0"), 1)[0]
        assert field.displacement_m[..., 2].mean() < 0  # 1 % below rest: pressed
    heard(listener)
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10, patch="p0"), 1)
    downloads = [
        f for f in heard(listener) if f.can_id == 0x605 and f.data[:4] == bytes.fromhex("c6 01 23 00")
    ]
    assert downloads == []  # it has them already


@pytest.mark.long
def test_coordinates_come_from_the_node(hand: HandConfig, rack_of: Callable[[HandConfig], Rack]) -> None:
    """A patch made another way than the preset that stands for it."""
    rack = rack_of(hand)
    real = PatchLayout.preset("staggered", height_m=3e-3, **SMALL)
    for name in ("p0", "p1"):
        rack.plug(name, layout=real)
    with Host.from_config(changed(hand, patch={"layout": {**SMALL, "coordinates": "node"}})) as host:
        take(host.fields(timeout_s=10, patch="p0"), 2)
        layout = host._nodes["p0"].facts.layout
    assert layout.layout_hash == real.layout_hash
    np.testing.assert_allclose(layout.upper_m, real.upper_m, atol=1e-9)


def test_a_second_master_is_named(
    hand: HandConfig, rack: Rack, listener: CanPort, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING), Host.from_config(hand) as host:
        take(host.fields(timeout_s=10), 2)
        for counter in (1, 2, 3):
            listener.send(0x080, bytes([counter]))
        listener.send(0x605, bytes.fromhex("40 00 10 00 00 00 00 00"))
        assert eventually(lambda: host.stats().other_masters["can0"].sdo_requests == 1)
        other_masters = host.stats().other_masters["can0"]
        assert (other_masters.syncs, other_masters.nmt_commands, other_masters.heartbeats) == (3, 0, 0)
    assert [record.getMessage() for record in caplog.records] == [
        "can0: another node sends SYNC: is there a second host or master?",
        "can0: another node sends SDO requests to the hand's nodes: is there a second host or master?",
    ]


def test_nodes_fall_silent_when_a_master_with_a_heartbeat_is_killed(
    hand: HandConfig, rack: Rack, listener: CanPort
) -> None:
    hand = changed(hand, bus={"heartbeat_node_id": 100}, bring_up={"heartbeat_ms": 100})
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10), 8)
        assert eventually(lambda: any(f == (0x764, b"\x05") for f in ((x[0], x[1]) for x in heard(listener))))
        for node in host._nodes.values():  # as if killed: nobody puts the nodes on stand-by
            node.monitor.running = False
        assert {node.nmt_state for node in rack.nodes.values()} == {NmtState.OPERATIONAL}
    assert eventually(lambda: {n.nmt_state for n in rack.nodes.values()} == {NmtState.PRE_OPERATIONAL})
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10), 8)
        assert eventually(lambda: host.health("p0").condition is Condition.OPERATIONAL)


@pytest.mark.long
@pytest.mark.parametrize("node_id", [255, 9])
def test_a_patch_without_its_node_id_is_found_by_its_serial_number(
    crossing_hand: HandConfig, rack_of: Callable[[HandConfig], Rack], node_id: int
) -> None:
    table = crossing_hand.model_dump(mode="json")
    table["patches"][1]["serial"] = 0xCAFE
    hand = parse_hand(table)
    rack = rack_of(hand)
    rack.plug("p0")
    node = rack.plug("p1", node_id=node_id)
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10, patch="p1"), 2)
        assert node.node_id == 6
        # And again while the host runs: nothing was stored in it.
        rack.pull("p1")
        assert eventually(lambda: host.health("p1").condition is Condition.LOST)
        fields = host.fields(timeout_s=10, patch="p1")
        node = rack.plug("p1", node_id=node_id)
        take(fields, 2)
        assert node.node_id == 6
        assert host.stats().nodes["p0"].rejoins == 0


@pytest.mark.parametrize(
    ("bus", "patch", "line"),
    [
        (
            {"role": "slave"},
            {},
            "buses[0].role: got 'slave', allowed: master or guest",
        ),
        (
            {"role": "guest"},
            {},
            "patches[0].baseline: got nothing, "
            "allowed: a file, because the host is a guest that sends nothing on can0",
        ),
        (
            {"role": "guest", "guest_sends": "sdo", "heartbeat_node_id": 3},
            {},
            'buses[0].heartbeat_node_id: got 3, allowed: only with role = "master"',
        ),
        (
            {"heartbeat_node_id": 6},
            {},
            "buses[0].heartbeat_node_id: got 6, allowed: an integer from 1 to 127 that no node uses",
        ),
        (
            {},
            {"baseline": "nowhere.txt"},
            "patches[0].baseline: got 'nowhere.txt', allowed: the path of a file of resistances in ohm; "
            "there is no file nowhere.txt",
        ),
    ],
)
def test_roles_that_contradict_themselves(hand: HandConfig, bus: Any, patch: Any, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        changed(hand, bus=bus, patch=patch)
    assert str(caught.value) == line


def test_a_sync_without_counter_is_for_guests(hand: HandConfig) -> None:
    with pytest.raises(ConfigError, match=r"^sync\.counter_overflow: got 0, allowed: .*; or 0 if the host"):
        changed(hand, sync={"counter_overflow": 0})
