"""A running host and nodes that come, go, restart, change, or are not what they should be."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skinnode.config import HandConfig, parse_hand
from skinnode.host import Condition, Host, Subscription
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.node import NmtState
from skinnode.process import clock
from skinnode.transport import CanPort
from tests.lanes import some_long

from .conftest import SMALL, Rack, eventually, heard
from .processor import ProcessorWait

BACK_S = 1.0
"""A node that comes back runs again within this time of its boot-up or first answer."""


def take(fields: Subscription, count: int) -> list[FieldFrame]:
    taken = []
    for field in fields:
        taken.append(field)
        if len(taken) == count:
            break
    return taken


def scans(fields: list[FieldFrame]) -> list[int]:
    return [field.stamp.scan for field in fields if field.stamp is not None]


def runs(host: Host, patch: str) -> bool:
    health = host.health(patch)
    return health.nmt_state == NmtState.OPERATIONAL and host.stats().nodes[patch].phase == "running"


def waiting(hand: HandConfig, **tables: Any) -> HandConfig:
    table = hand.model_dump(mode="json")
    return parse_hand({**table, "bring_up": {"missing": "wait"}, **tables})


def gaps(numbers: list[int]) -> int:
    """How many scans are missing between the first and the last, which rise."""
    assert numbers == sorted(numbers)
    return numbers[-1] - numbers[0] + 1 - len(numbers)


@pytest.mark.real_time
def test_a_node_that_is_replugged_runs_again_and_the_other_does_not_notice(
    crossing_hand: HandConfig, rack_of: Callable[[HandConfig], Rack]
) -> None:
    rack = rack_of(crossing_hand)
    for name in ("p0", "p1"):
        rack.plug(name)
    with Host.from_config(crossing_hand) as host:
        undisturbed = host.fields(timeout_s=10, capacity=10_000, patch="p0")
        take(host.fields(timeout_s=10, patch="p1"), 4)
        rack.pull("p1")
        assert eventually(lambda: host.health("p1").condition is Condition.LOST)
        fields = host.fields(timeout_s=10, patch="p1")
        rack.plug("p1")
        t_plugged_ns, processor = clock.monotonic_ns(), ProcessorWait()
        (first,) = take(fields, 1)
        assert first.stamp is not None
        assert first.stamp.t_receive_ns - t_plugged_ns < (BACK_S + processor.seconds()) * 1e9
        assert eventually(lambda: runs(host, "p1"))
        after = scans(take(fields, 10))
        stats = host.stats()
        # if the machine stands still, a scan is overtaken, or the node skips one; both are counted
        assert gaps(after) <= stats.patches["p1"].skipped + rack.nodes["p1"].overruns
        assert (stats.nodes["p1"].rejoins, stats.nodes["p0"].rejoins) == (1, 0)
        assert host.health("p1").rejoins == 1
        other = stats.patches["p0"]
        numbers = scans(take(undisturbed, other.solved - 10))
        missed = other.assembler.scans_missed
        assert other.withheld == 0
        assert missed + other.assembler.scans_torn <= rack.nodes["p0"].overruns
        assert other.skipped + missed < other.offered / 10
        assert gaps(numbers) <= other.skipped + missed


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "booted"), some_long([(0x81, 1), (0x82, 1), (0x80, 0), (0x02, 0)], (0x81, 1), (0x02, 0))
)
def test_a_node_that_somebody_resets_or_stops_runs_again(
    hand: HandConfig, rack: Rack, listener: CanPort, command: int, booted: int
) -> None:
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10, patch="p1"), 2)
        boot_ups = host.health("p1").boot_ups
        listener.send(0x000, bytes([command, 6]))
        assert eventually(lambda: host.stats().nodes["p1"].rejoins == 1)
        take(host.fields(timeout_s=10, patch="p1"), 4)
        assert host.health("p1").boot_ups == boot_ups + booted
        assert host.stats().nodes["p0"].rejoins == 0
        assert host.stats().other_masters["can0"].nmt_commands == 1


def reset_by(host: Host, patch: str) -> bool:
    """Whether a node that the host resets runs again."""
    rejoins = host.stats().nodes[patch].rejoins
    host.reset_node(patch)
    return eventually(lambda: host.stats().nodes[patch].rejoins == rejoins + 1)


@pytest.mark.long
def test_resets_that_the_host_commands_are_no_restart_loop(
    hand: HandConfig, rack: Rack, caplog: pytest.LogCaptureFixture
) -> None:
    with Host.from_config(hand) as host:
        boot_ups = host.health("p0").boot_ups
        assert all(reset_by(host, "p0") for _ in range(4))
        assert host.health("p0").boot_ups == boot_ups + 4
        assert not host.health("p0").restarts_in_a_loop
    assert "restarted without a command" not in caplog.text


@pytest.mark.long
def test_heartbeats_of_an_earlier_period_are_no_second_node(
    hand: HandConfig, rack: Rack, listener: CanPort
) -> None:
    with Host.from_config(hand) as host:
        listener.send(0x605, bytes.fromhex("2b 17 10 00 14 00 00 00"))  # a heartbeat every 20 ms
        assert eventually(lambda: host.health("p0").duplicate_id)  # as often as of many nodes
        assert reset_by(host, "p0")  # every 250 ms again
        assert not host.health("p0").duplicate_id


@pytest.mark.long
def test_a_node_whose_boot_up_nobody_heard_is_found_by_asking(hand: HandConfig, rack: Rack) -> None:
    """After a reset it sends no heartbeat either."""
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10, patch="p1"), 2)
        boot_ups = host.health("p1").boot_ups
        rack.pull("p1")
        rack.plug("p1", lets_through=lambda can_id, data: not (can_id == 0x706 and data == b"\0"))
        assert eventually(lambda: host.stats().nodes["p1"].rejoins == 1)
        take(host.fields(timeout_s=10, patch="p1"), 4)
        assert host.health("p1").boot_ups == boot_ups


@pytest.mark.long
def test_searches_for_absent_nodes_do_not_delay_a_node_that_is_back(
    make_hand: Callable[..., HandConfig], rack_of: Callable[[HandConfig], Rack]
) -> None:
    """An LSS search takes a fifth of a second, and a bus carries one at a time."""
    hand = make_hand(patches=24, sync={"period_ms": 250}, bring_up={"missing": "wait"})
    table = hand.model_dump(mode="json")
    for number, patch in enumerate(table["patches"][1:], 1):
        patch["serial"] = 1000 + number
    hand = parse_hand(table)
    rack_of(hand).plug("p0")
    with Host.from_config(hand, boot_deadline_s=0.2) as host:
        take(host.fields(timeout_s=10, patch="p0"), 8)
        for _ in range(3):
            begun_s = clock.monotonic()
            assert reset_by(host, "p0")
            assert clock.monotonic() - begun_s < BACK_S


@pytest.mark.long
def test_a_node_that_restarts_in_a_loop_is_taken_up_when_it_has_calmed_down(
    hand: HandConfig, rack: Rack
) -> None:
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10, patch="p1"), 2)
        for _ in range(8):
            rack.pull("p1")
            rack.plug("p1")
            clock.sleep(0.05)  # long enough to be asked who it is, too short to be configured
        assert host.health("p1").condition is Condition.RESTARTING
        assert eventually(lambda: runs(host, "p1"))
        take(host.fields(timeout_s=10, patch="p1"), 4)
        assert host.stats().nodes["p0"].rejoins == 0


def test_start_without_a_patch_that_comes_later(
    crossing_hand: HandConfig, rack_of: Callable[[HandConfig], Rack]
) -> None:
    rack = rack_of(crossing_hand)
    rack.plug("p0")
    with Host.from_config(waiting(crossing_hand), boot_deadline_s=0.5) as host:
        take(host.fields(timeout_s=10, patch="p0"), 2)
        assert host.health("p1").condition is Condition.NEVER_SEEN
        assert host.stats().nodes["p1"].phase == "awaited"
        node = rack.plug("p1")
        take(host.fields(timeout_s=10, patch="p1"), 4)
        assert eventually(lambda: host.stats().nodes["p1"].rejoins == 1)
        assert host.stats().nodes["p0"].rejoins == 0
    assert eventually(lambda: node.nmt_state is NmtState.PRE_OPERATIONAL)


@pytest.mark.long
def test_start_with_nobody_there(hand: HandConfig, rack_of: Callable[[HandConfig], Rack]) -> None:
    rack = rack_of(hand)
    with Host.from_config(waiting(hand), boot_deadline_s=0.2) as host:
        for name in ("p1", "p0"):
            rack.plug(name)
        for name in ("p1", "p0"):
            take(host.fields(timeout_s=10, patch=name), 2)


@pytest.mark.long
def test_another_patch_in_its_place_is_refused_until_the_right_one_comes(
    hand: HandConfig, rack: Rack, listener: CanPort
) -> None:
    other = PatchLayout.preset("staggered", height_m=3e-3, **SMALL)
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10, patch="p1"), 2)
        rack.pull("p1")
        heard(listener)
        rack.plug("p1", layout=other)
        assert eventually(lambda: host.health("p1").condition is Condition.REFUSED)
        refusal = host.health("p1").refusal
        assert refusal is not None
        assert refusal.startswith("node 6: patch 'p1' on can0: layout hash: got 0x")
        requests = [frame.data for frame in heard(listener) if frame.can_id == 0x606]
        assert {data[0] & 0xE0 for data in requests} == {0x40}  # read; it could be somebody else's
        rack.pull("p1")
        rack.plug("p1")
        take(host.fields(timeout_s=10, patch="p1"), 4)
        assert eventually(lambda: host.health("p1").refusal is None)
        assert host.stats().nodes["p1"].failures >= 1


def test_a_tare_is_followed_and_no_scan_is_decoded_with_the_wrong_baseline(
    hand: HandConfig, rack: Rack, listener: CanPort
) -> None:
    layout = hand.patch("p1").layout.build()
    pressed_m = layout.upper_m.copy()
    pressed_m[1:3, 1:3, 2] -= 100e-6
    rack.sources["p1"].ohm = resistance_ohm(layout, pressed_m)
    rack.pull("p1")
    rack.plug("p1", baseline_ohm=resistance_ohm(layout, layout.upper_m))
    with Host.from_config(hand) as host:
        fields = host.fields(timeout_s=10, capacity=10_000, patch="p1")
        before = take(fields, 4)
        assert before[-1].displacement_m[1, 1, 2] < -50e-6
        request = b"\x23\x21\x20\x04" + b"tare"
        listener.send(0x606, request)
        assert eventually(lambda: host.stats().nodes["p1"].baselines == 1)
        after = [field.displacement_m[1, 1, 2] for field in take(fields, 30)]
        # Before the tare pressed, after it at rest; never anything else.
        tared = next(i for i, depth in enumerate(after) if depth > -50e-6)
        assert all(depth < -50e-6 for depth in after[:tared])
        assert np.abs(after[tared:]).max() < 1e-6
        stats = host.stats()
        assert stats.patches["p1"].withheld >= 1
        assert stats.patches["p0"].withheld == 0
        assert stats.nodes["p1"].rejoins == 0
        assert stats.other_masters["can0"].sdo_requests == 1


@pytest.mark.real_time
@pytest.mark.vcan
def test_an_interface_that_goes_down_and_comes_up_again(
    make_hand: Callable[..., HandConfig], rack_of: Callable[[HandConfig], Rack]
) -> None:
    """The other bus does not notice."""
    hand = make_hand(sync={"period_ms": 100})
    table = hand.model_dump(mode="json")
    table["buses"].append({"name": "kernel", "interface": "socketcan", "channel": "vcan0"})
    table["patches"][1]["bus"] = "kernel"
    hand = parse_hand(table)
    rack = rack_of(hand)
    for name in ("p0", "p1"):
        rack.plug(name)
    with Host.from_config(hand) as host:
        take(host.fields(timeout_s=10, patch="p1"), 2)
        try:
            subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
            assert eventually(lambda: host.stats().buses["kernel"].outages == 1)
            take(host.fields(timeout_s=10, patch="p0"), 12)  # more than a second
        finally:
            subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
        take(host.fields(timeout_s=10, patch="p1"), 10)
        assert eventually(lambda: runs(host, "p1"))
        stats = host.stats()
        assert (stats.buses["can0"].outages, stats.nodes["p0"].rejoins) == (0, 0)
        assert (stats.patches["p0"].withheld, stats.patches["p0"].assembler.scans_torn) == (0, 0)
