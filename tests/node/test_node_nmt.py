"""NMT and boot-up: what a manager sees of a node (CiA 301 v4.2, 7.2.8 and 7.3.2), frames by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from skinnode.errors import BusError
from skinnode.node import NmtState, PatchNode


def test_boot_up_is_one_zero_byte(make: Callable) -> None:
    desk = make()
    desk.node.power_off()
    desk.power_on()
    assert desk.take() == [(0x704, "00")]
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL


@pytest.mark.parametrize("reset", ["81 00", "82 04"])
def test_boot_up_that_the_bus_refuses_is_told_as_soon_as_it_does_not(desk, reset: str) -> None:
    """A queue that is full of chunks when the manager resets the node: it must not fall silent for ever."""
    desk.write(0x1017, 0, 100, 2)
    desk.bus_refuses = True
    desk.node.on_frame(0, bytes.fromhex(reset), desk.t_ns)
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL
    with pytest.raises(BusError):  # the caller learns of it
        desk.run(0)
    desk.bus_refuses = False
    desk.run(500)
    assert desk.take() == [(0x704, "00")]  # once; without a heartbeat, since the reset took 0x1017 back


def test_silent_before_power_on_and_after_power_off(layout) -> None:
    sent: list[int] = []
    node = PatchNode(4, layout, _Flat(layout), send=lambda can_id, _: sent.append(can_id))
    node.on_frame(0x604, bytes.fromhex("4000100000000000"), 0)
    node.on_timer(10)
    assert sent == []
    assert node.next_deadline_ns() is None
    node.power_on(20)
    node.on_frame(0x604, bytes.fromhex("2b17100001000000"), 20)
    node.power_off()
    del sent[:]
    node.on_frame(0x604, bytes.fromhex("4000100000000000"), 30)
    node.on_frame(0x000, bytes((1, 0)), 30)
    node.on_timer(10_000_000)
    assert sent == []
    assert node.next_deadline_ns() is None


# CiA 301 v4.2, figure 49: the command that leads into each state, and where each command leads from there.
INTO = {"7f": "80 00", "05": "01 00", "04": "02 00"}
COMMANDS = {"01": "05", "02": "04", "80": "7f", "81": "7f", "82": "7f"}


def state_of(desk) -> str:
    """As node guarding tells it."""
    ((can_id, data),) = desk.frame(0x704, remote=True)
    assert can_id == 0x704
    return f"{int(data, 16) & 0x7F:02x}"


@pytest.mark.parametrize("address", ["00", "04"])
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("state", INTO)
def test_every_transition(desk, state: str, command: str, address: str) -> None:
    desk.frame(0, INTO[state])
    assert state_of(desk) == state
    boot_up = [(0x704, "00")] if command in ("81", "82") else []
    assert desk.frame(0, f"{command} {address}") == boot_up
    assert state_of(desk) == COMMANDS[command]


@pytest.mark.parametrize("state", INTO)
@pytest.mark.parametrize("data", ["01 05", "81 7f", "82 80", "02 ff"])
def test_commands_for_others(desk, state: str, data: str) -> None:
    desk.frame(0, INTO[state])
    assert desk.frame(0, data) == []
    assert state_of(desk) == state
    desk.frame(0, "80 00")
    assert desk.read(0x2040, 1) == 0


@pytest.mark.parametrize("state", INTO)
@pytest.mark.parametrize(
    "data", ["", "01", "01 04 00", "00 00", "03 04", "7f 00", "83 00", "ff 00", "01 00 00 00 00 00 00 00"]
)
def test_what_is_no_command_is_ignored_and_counted(desk, state: str, data: str) -> None:
    desk.frame(0, INTO[state])
    assert desk.frame(0, data) == []
    assert desk.frame(0, data, remote=True) == []
    assert state_of(desk) == state
    desk.frame(0, "80 00")
    assert desk.read(0x2040, 1) == 1


@pytest.mark.parametrize(
    ("state", "sdo", "pdo", "emcy"),
    [("7f", True, False, True), ("05", True, True, True), ("04", False, False, False)],
)
def test_services_of_a_state(desk, state: str, sdo: bool, pdo: bool, emcy: bool) -> None:
    """CiA 301 v4.2, table 39. TIME: see test_node_time.py; error control: every test here."""
    desk.frame(0, INTO[state])
    answer = [(0x584, "43 00 10 00 00 00 00 00")]
    assert desk.frame(0x604, "40 00 10 00 00 00 00 00") == (answer if sdo else [])
    # a SYNC with a byte too many, and over it is
    told = [(0x084, "40 82 11 01 00 00 00 00"), (0x084, "00 00 00 40 82 00 00 00")]
    assert desk.frame(0x80, "01") == (told if emcy else [])
    desk.node.on_frame(0x80, b"", desk.t_ns)
    desk.run(100)
    assert [can_id for can_id, _ in desk.take()] == ([0x184] * 4 + [0x284] if pdo else [])
    desk.node.on_frame(0x204, bytes.fromhex("00 00 00 00 01 00"), desk.t_ns)  # a single scan
    desk.run(100)
    assert [can_id for can_id, _ in desk.take()] == ([0x184] * 4 if pdo else [])


def test_requests_that_are_no_sdo_are_counted(desk) -> None:
    for length in range(8):
        assert desk.frame(0x604, "40 00 10 00 00 00 00 00"[: 3 * length]) == []
    assert desk.read(0x2040, 5) == 8


def test_counters_survive_reset_communication_but_not_reset_node(desk) -> None:
    desk.frame(0, "01")
    desk.frame(0, "82 00")
    assert desk.read(0x2040, 1) == 1
    desk.frame(0, "81 00")
    assert desk.read(0x2040, 1) == 0


def test_stopped_serves_nothing_but_nmt_and_heartbeat(operational) -> None:
    desk = operational
    desk.write(0x1017, 0, 10, 2)
    desk.frame(0, "02 00")
    assert desk.frame(0x604, "40 00 10 00 00 00 00 00") == []
    assert desk.frame(0x80, "01") == []
    desk.run(15)
    assert desk.take() == [(0x704, "04")] * 2
    desk.frame(0, "01 00")
    assert desk.sdo("40 00 10 00 00 00 00 00") == "43 00 10 00 00 00 00 00"


def test_stopping_ends_a_transfer(desk) -> None:
    desk.sdo("40 08 10 00 00 00 00 00")
    desk.frame(0, "02 00")
    desk.frame(0, "80 00")
    assert desk.sdo("60 00 00 00 00 00 00 00").startswith("80")


def test_pre_operational_takes_no_scan(desk) -> None:
    reads = desk.source.reads
    assert desk.frame(0x80) == []
    desk.run(500)
    assert desk.take() == []
    assert desk.source.reads == reads


def test_reset_communication_keeps_the_application(operational) -> None:
    desk = operational
    desk.write(0x2020, 2, 77, 2)
    desk.write(0x1017, 0, 10, 2)
    assert desk.frame(0, "82 04") == [(0x704, "00")]
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL
    assert desk.read(0x1017, 0) == 0
    assert desk.read(0x1019, 0) == 0
    assert desk.read(0x1018, 2) == 0x534B494E
    assert desk.read(0x2020, 2) == 77
    desk.run(100)
    assert desk.take() == []


def test_reset_communication_restores_the_pdos(operational) -> None:
    desk = operational
    desk.write(0x1800, 1, 0x80000184, 4)
    desk.write(0x1801, 1, 0x80000284, 4)
    desk.write(0x1801, 1, 0x2C4, 4)
    desk.write(0x1005, 0, 0x90, 4)
    desk.frame(0, "82 00")
    desk.start()
    desk.node.on_frame(0x80, b"", desk.t_ns)
    desk.run(20)
    assert [can_id for can_id, _ in desk.take()] == [0x184] * 4 + [0x284]


def test_reset_node_resets_the_application_but_not_the_baseline(operational) -> None:
    desk = operational
    desk.write(0x2020, 2, 77, 2)
    desk.write(0x2200, 1, 0x447A0000, 4)  # 1000 ohm
    assert desk.frame(0, "81 00") == [(0x704, "00")]
    assert desk.read(0x2020, 2) == 2
    assert desk.read(0x2200, 1) == 0x447A0000
    assert desk.read(0x2000, 10) == desk.layout.layout_hash


class _Flat:
    def __init__(self, layout) -> None:
        self.ohm = np.full(layout.shape, 1000.0)

    def read(self, t_ns: int) -> np.ndarray:
        return self.ohm


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"node_id": 0}, "node_id: got 0, must be 1 to 127"),
        ({"node_id": 128}, "node_id: got 128, must be 1 to 127"),
        ({"serial": 1 << 32}, "serial: got 4294967296"),
        ({"baseline_ohm": np.ones((6, 2))}, r"baseline_ohm: got shape \(6, 2\), must be \(2, 6\)"),
        ({"baseline_ohm": -np.ones((2, 6))}, "baseline_ohm: got -1.0, must not be negative"),
    ],
)
def test_arguments_out_of_range(layout, options: dict, message: str) -> None:
    options = {"node_id": 4, **options}
    with pytest.raises(ValueError, match=message):
        PatchNode(options.pop("node_id"), layout, _Flat(layout), send=lambda *_: None, **options)
