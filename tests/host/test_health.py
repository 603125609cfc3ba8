"""One word for a patch, drawn from what its node says and does."""

from __future__ import annotations

import pytest

from skinnode.host.health import Condition
from skinnode.host.node_monitor import NodeMonitor

MS = 1_000_000


def condition(monitor: NodeMonitor, now_ms: int) -> Condition:
    return monitor.health(now_ms * MS, heartbeat_s=0.25, scan_s=0.08).condition


@pytest.fixture
def monitor() -> NodeMonitor:
    return NodeMonitor("thumb", 11)


def test_life_of_a_node(monitor: NodeMonitor) -> None:
    assert condition(monitor, 0) is Condition.NEVER_SEEN
    monitor.on_heartbeat(b"\x00", 10 * MS)
    assert condition(monitor, 11) is Condition.BOOTING
    monitor.on_heartbeat(b"\x7f", 260 * MS)
    assert condition(monitor, 261) is Condition.BOOTING
    monitor.running = True
    monitor.on_heartbeat(b"\x05", 510 * MS)
    assert condition(monitor, 511) is Condition.STALE
    monitor.on_scan(590 * MS)
    assert condition(monitor, 600) is Condition.OPERATIONAL
    monitor.on_heartbeat(b"\x05", 760 * MS)
    assert condition(monitor, 590 + 240) is Condition.OPERATIONAL  # three periods of 80 ms
    assert condition(monitor, 590 + 241) is Condition.STALE
    assert condition(monitor, 760 + 751) is Condition.LOST  # three of 250 ms


def restarted(monitor: NodeMonitor, t_ms: int) -> None:
    """It boots by itself, and runs again a quarter of a second later."""
    monitor.on_heartbeat(b"\x00", t_ms * MS)
    assert condition(monitor, t_ms + 1) in (Condition.BOOTING, Condition.RESTARTING)
    monitor.on_heartbeat(b"\x05", (t_ms + 250) * MS)
    monitor.on_scan((t_ms + 250) * MS)


def test_a_node_that_restarted_once_is_what_it_does(monitor: NodeMonitor) -> None:
    monitor.running = True
    monitor.on_heartbeat(b"\x05", 0)
    restarted(monitor, 100)
    assert condition(monitor, 351) is Condition.OPERATIONAL
    assert monitor.health(351 * MS, 0.25, 0.08).boot_ups == 1


def test_restarting_is_a_loop_until_it_is_operational_again(
    monitor: NodeMonitor,
) -> None:
    monitor.running = True
    for t_ms in (100, 4000, 8000):
        restarted(monitor, t_ms)
    assert condition(monitor, 8251) is Condition.RESTARTING
    assert monitor.health(8251 * MS, 0.25, 0.08).restarts_in_a_loop
    for t_ms in range(8300, 13301, 200):
        monitor.on_heartbeat(b"\x05", t_ms * MS)
        monitor.on_scan(t_ms * MS)
    assert condition(monitor, 8500) is Condition.RESTARTING
    assert condition(monitor, 8501) is Condition.OPERATIONAL
    assert monitor.health(12999 * MS, 0.25, 0.08).restarts_in_a_loop
    assert not monitor.health(13301 * MS, 0.25, 0.08).restarts_in_a_loop
    assert monitor.health(13301 * MS, 0.25, 0.08).boot_ups == 3


def test_a_node_of_a_loop_that_is_not_operational_is_restarting(monitor: NodeMonitor) -> None:
    monitor.running = True
    for t_ms in (100, 300, 500):
        monitor.on_heartbeat(b"\x00", t_ms * MS)
    monitor.on_heartbeat(b"\x7f", 1500 * MS)
    assert condition(monitor, 1501) is Condition.RESTARTING


def test_a_loop_of_restarts_is_remembered_for_five_seconds(monitor: NodeMonitor) -> None:
    monitor.running = True
    for t_ms in (100, 200, 300):
        monitor.on_heartbeat(b"\x00", t_ms * MS)
    assert monitor.health(5300 * MS, 0.25, 0.08).restarts_in_a_loop
    assert not monitor.health(5300 * MS + 1, 0.25, 0.08).restarts_in_a_loop


def test_restarts_far_apart_are_no_loop(monitor: NodeMonitor) -> None:
    monitor.running = True
    for t_ms in (100, 5000, 10100):
        restarted(monitor, t_ms)
    assert condition(monitor, 10351) is Condition.OPERATIONAL


def test_a_boot_up_that_was_waited_for_is_no_restart(monitor: NodeMonitor) -> None:
    monitor.on_heartbeat(b"\x00", 100 * MS)
    monitor.running = True
    monitor.on_heartbeat(b"\x05", 200 * MS)
    monitor.on_scan(200 * MS)
    assert condition(monitor, 201) is Condition.OPERATIONAL


def test_emergency_makes_faulty_until_it_is_over(monitor: NodeMonitor) -> None:
    monitor.on_heartbeat(b"\x05", 0)
    monitor.on_scan(0)
    monitor.on_emergency(bytes.fromhex("00 50 81 00 03 01 00 00"), 1 * MS)
    health = monitor.health(2 * MS, 0.25, 0.08)
    assert health.condition is Condition.FAULTY
    assert (health.emergencies, health.last_emergency, health.error_register) == (1, 0x5000, 0x81)
    assert health.emergency_text == "wire open or shorted: upper wire open 3"
    monitor.refusal = "product code: got 0x1234"  # it may be another device
    assert monitor.health(1, 0.25, 0.08).emergency_text == "hardware"
    monitor.refusal = None
    monitor.on_emergency(bytes(8), 3 * MS)
    health = monitor.health(4 * MS, 0.25, 0.08)
    assert health.condition is Condition.OPERATIONAL
    assert (health.emergencies, health.last_emergency, health.error_register) == (1, 0x5000, 0)


def test_boot_up_ends_all_errors(monitor: NodeMonitor) -> None:
    """Those that are still there are told anew."""
    monitor.on_emergency(bytes.fromhex("00 50 81 00 03 01 00 00"), 0)
    monitor.on_heartbeat(b"\x00", 1 * MS)
    assert monitor.health(2 * MS, 0.25, 0.08).error_register == 0


def test_register_that_was_asked_for_is_older_than_what_came_meanwhile(monitor: NodeMonitor) -> None:
    monitor.on_emergency(bytes.fromhex("00 50 81 00 03 01 00 00"), 0)
    said = monitor.registers_said
    monitor.on_emergency(bytes.fromhex("20 81 91 00 00 00 00 00"), 1 * MS)
    monitor.on_register_read(0x81, said)
    assert monitor.error_register == 0x91
    monitor.on_register_read(0x00, monitor.registers_said)
    assert monitor.error_register == 0


def test_toggle_bit_of_node_guarding_is_not_state(monitor: NodeMonitor) -> None:
    monitor.on_heartbeat(b"\x85", 0)
    assert monitor.health(0, 0.25, 0.08).nmt_state == 5


@pytest.mark.parametrize("data", [b"", b"\x05\x00"])
def test_malformed_heartbeat_says_nothing(monitor: NodeMonitor, data: bytes) -> None:
    monitor.on_heartbeat(data, 0)
    assert condition(monitor, 1) is Condition.NEVER_SEEN


def reason(monitor: NodeMonitor, now_ms: int, **more: int) -> str:
    return monitor.health(now_ms * MS, heartbeat_s=0.25, scan_s=0.08, **more).reason


def test_the_reason_names_what_holds_a_patch_back(monitor: NodeMonitor) -> None:
    assert reason(monitor, 0) == "node 11 has sent nothing"
    monitor.on_heartbeat(b"\x7f", 0)
    assert reason(monitor, 1) == "node 11 is pre-operational, not operational yet"
    monitor.complaint = "read of object 0x1018:1: no response"
    assert reason(monitor, 1).endswith("; read of object 0x1018:1: no response")
    assert (
        reason(monitor, 2000) == "no heartbeat from node 11 for 2.0 s; read of object 0x1018:1: no response"
    )
    monitor.complaint = None
    monitor.on_heartbeat(b"\x05", 2000 * MS)
    assert reason(monitor, 2001) == "no scan from node 11 received yet"
    monitor.on_scan(2010 * MS)
    assert reason(monitor, 2011) == ""
    assert reason(monitor, 2510) == "no scan from node 11 for 0.50 s"
    monitor.on_emergency(bytes.fromhex("10 81 11 02 00 00 00 00"), 2511 * MS)
    assert reason(monitor, 2512) == (
        "error register 0x11 (generic, communication); newest emergency 0x8110 overrun: messages or scans "
        "lost: 2 scans skipped so far"
    )
    monitor.refusal = "layout hash: got 0x1, allowed: 0x2"
    assert reason(monitor, 2512) == "layout hash: got 0x1, allowed: 0x2"


def test_scans_that_are_withheld_make_a_patch_stale(monitor: NodeMonitor) -> None:
    """Nobody gets a field of them."""
    monitor.on_heartbeat(b"\x05", 0)
    monitor.on_scan(0)
    for passed_ms, state in ((0, Condition.STALE), (100, Condition.STALE), (600, Condition.OPERATIONAL)):
        monitor.on_scan(700 * MS)
        health = monitor.health(700 * MS, 0.25, 0.08, t_passed_ns=passed_ms * MS)
        assert health.condition is state
        assert health.withheld is (state is Condition.STALE)
    held = "its scans are withheld until its configuration and baseline have been read"
    assert reason(monitor, 700, t_passed_ns=100 * MS) == held
