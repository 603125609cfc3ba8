"""NMT, boot-up, heartbeat, EMCY: what a manager sees of a node (CiA 301 v4.2, 7.2.7, 7.2.8 and 7.3.2)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from skinnode.node import NmtState, PatchNode


def test_boot_up_is_one_zero_byte(make: Callable) -> None:
    desk = make()
    desk.node.power_off()
    desk.power_on()
    assert desk.take() == [(0x704, "00")]
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL


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


@pytest.mark.parametrize("address", ["00", "04"])
def test_transitions(desk, address: str) -> None:
    for command, state in (
        ("01", NmtState.OPERATIONAL),
        ("02", NmtState.STOPPED),
        ("80", NmtState.PRE_OPERATIONAL),
        ("02", NmtState.STOPPED),
        ("01", NmtState.OPERATIONAL),
        ("80", NmtState.PRE_OPERATIONAL),
    ):
        assert desk.frame(0, f"{command} {address}") == []
        assert desk.node.nmt_state is state


@pytest.mark.parametrize("data", ["", "01", "01 05", "01 04 00", "03 04", "ff 00", "01 00 00 00 00 00 00 00"])
def test_frames_that_are_no_command_of_ours(desk, data: str) -> None:
    assert desk.frame(0, data) == []
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL


def test_stopped_serves_nothing_but_nmt_and_heartbeat(operational) -> None:
    desk = operational
    desk.write(0x1017, 0, 10, 2)
    desk.frame(0, "02 00")
    assert desk.frame(0x604, "40 00 10 00 00 00 00 00") == []
    assert desk.frame(0x80, "01") == []
    desk.run(10)
    assert desk.take() == [(0x704, "04")]
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


def test_emergency_of_a_stopped_node_waits(operational) -> None:
    desk = operational
    desk.write(0x1029, 1, 2, 1)
    desk.write(0x1016, 1, 0x007F_000A, 4)
    desk.write(0x1015, 0, 10_000, 2)  # 1 s: the second message is held back
    desk.frame(0x80)
    desk.frame(0x77F, "05")
    desk.run(10)
    assert desk.node.nmt_state is NmtState.STOPPED
    desk.run(2000)
    assert desk.take() == []
    assert desk.frame(0, "80 00") == [(0x084, "30 81 11 7f 00 00 00 00")]


def test_reset_node_resets_the_application_but_not_the_baseline(operational) -> None:
    desk = operational
    desk.write(0x2020, 2, 77, 2)
    desk.write(0x2200, 1, 0x447A0000, 4)  # 1000 ohm
    assert desk.frame(0, "81 00") == [(0x704, "00")]
    assert desk.read(0x2020, 2) == 2
    assert desk.read(0x2200, 1) == 0x447A0000
    assert desk.read(0x2000, 10) == desk.layout.layout_hash


def test_reset_forgets_errors(operational) -> None:
    desk = operational
    desk.source.ohm = np.full((2, 6), np.inf)
    desk.frame(0x80, "01")
    assert desk.read(0x1003, 0) == 1
    desk.frame(0, "82 00")
    assert desk.read(0x1003, 0) == 0
    assert desk.read(0x1001, 0) == 0
    desk.start()
    assert [data for can_id, data in desk.frame(0x80) if can_id == 0x084] == ["00 50 81 00 00 08 00 00"]


def test_heartbeat_names_the_state_and_keeps_its_beat(desk) -> None:
    desk.write(0x1017, 0, 100, 2)
    start_ns = desk.t_ns
    desk.run(250)
    desk.node.on_frame(0, b"\x01\x00", desk.t_ns)
    desk.run(100)
    assert [(data[0], t_ns - start_ns) for can_id, data, t_ns in desk.sent if can_id == 0x704] == [
        (0x7F, 100_000_000),
        (0x7F, 200_000_000),
        (0x05, 300_000_000),
    ]


def test_heartbeat_served_late_keeps_its_beat_and_sends_no_bursts(desk) -> None:
    desk.write(0x1017, 0, 100, 2)
    start_ns = desk.t_ns
    for late_ms in (130, 200, 730):
        desk.t_ns = start_ns + late_ms * 1_000_000
        desk.node.on_timer(desk.t_ns)
    assert len(desk.take()) == 3
    assert desk.node.next_deadline_ns() == start_ns + 830_000_000


def test_heartbeat_ends_when_set_to_zero(desk) -> None:
    desk.write(0x1017, 0, 100, 2)
    desk.write(0x1017, 0, 0, 2)
    desk.run(1000)
    assert desk.take() == []


def test_missing_heartbeat_of_the_manager(operational) -> None:
    desk = operational
    desk.write(0x1016, 1, 0x007F_0064, 4)  # node 127 within 100 ms
    desk.run(500)
    assert desk.node.nmt_state is NmtState.OPERATIONAL  # monitoring starts at the first heartbeat
    desk.frame(0x77F, "05")
    desk.run(99)
    desk.frame(0x77F, "05")
    desk.run(99)
    assert desk.node.nmt_state is NmtState.OPERATIONAL
    desk.take()
    desk.run(1)
    assert desk.take() == [(0x084, "30 81 11 7f 00 00 00 00")]
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL


@pytest.mark.parametrize(("behaviour", "state"), [(1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)])
def test_error_behaviour(operational, behaviour: int, state: NmtState) -> None:
    desk = operational
    desk.write(0x1029, 1, behaviour, 1)
    desk.write(0x1016, 2, 0x0001_000A, 4)
    desk.frame(0x701, "05")
    desk.run(10)
    assert desk.node.nmt_state is state


class TestEmergencies:
    def test_open_wire_is_told_once_and_its_end_too(self, operational) -> None:
        desk = operational
        healthy = desk.source.ohm
        broken = healthy.copy()
        broken[1] = np.inf
        desk.source.ohm = broken
        # 0x5000, register: generic and manufacturer, kind 0 (upper open), wire 1, one wire in all
        assert desk.frame(0x80, "01")[0] == (0x084, "00 50 81 00 01 01 00 00")
        desk.run(80)
        desk.take()
        assert all(can_id != 0x084 for can_id, _ in desk.frame(0x80, "02"))
        desk.run(80)
        assert desk.read(0x1001, 0) == 0x81
        assert desk.read(0x1003, 0) == 1
        assert desk.read(0x1003, 1) == 0x0100_5000
        assert desk.read(0x2030, 1) == 0b10
        assert desk.read(0x2031, 1) == 0
        desk.source.ohm = healthy
        desk.take()
        assert desk.frame(0x80, "03")[0] == (0x084, "00 00 00 00 50 00 00 00")
        assert desk.read(0x1001, 0) == 0

    def test_pulled_connector_is_one_message(self, operational) -> None:
        desk = operational
        desk.source.ohm = np.full((2, 6), np.inf)
        emergencies = [data for can_id, data in desk.frame(0x80, "01") if can_id == 0x084]
        assert emergencies == ["00 50 81 00 00 08 00 00"]  # 2 upper and 6 lower wires
        assert desk.read(0x2031, 1) == 0b111111

    def test_shorted_lower_wire(self, operational) -> None:
        desk = operational
        broken = desk.source.ohm.copy()
        broken[:, 5] = 0.0
        desk.source.ohm = broken
        assert desk.frame(0x80, "01")[0] == (0x084, "00 50 81 03 05 01 00 00")
        assert desk.read(0x2031, 2) == 1 << 5

    def test_sync_of_the_wrong_length(self, operational) -> None:
        desk = operational
        assert desk.frame(0x80) == [(0x084, "40 82 11 00 01 00 00 00")]
        assert desk.frame(0x80, "01 02") == [(0x084, "40 82 11 02 01 00 00 00")]
        assert desk.read(0x1001, 0) == 0  # over as soon as told
        assert desk.read(0x1003, 0) == 2

    def test_sync_of_one_wrong_length_is_told_once(self, operational) -> None:
        """A node that was reset hears the SYNC of its master with a counter it knows nothing of, for ever."""
        desk = operational
        told = [desk.frame(0x80) for _ in range(5)]
        assert told == [[(0x084, "40 82 11 00 01 00 00 00")], [], [], [], []]
        desk.frame(0x80, "01")
        assert desk.frame(0x80) == [(0x084, "40 82 11 00 01 00 00 00")]

    def test_history_is_the_newest_first_and_can_be_cleared(self, operational) -> None:
        desk = operational
        for length in range(2, 9):
            desk.frame(0x80, "00" * length)
        desk.frame(0x80, "00 00 00")
        desk.frame(0x204, "00")
        assert desk.read(0x1003, 0) == 8  # nine happened
        assert desk.read(0x1003, 1) & 0xFFFF == 0x8210
        assert desk.read(0x1003, 2) == 0x0103_8240  # three bytes came, one was expected
        desk.write(0x1003, 0, 0, 1)
        assert desk.read(0x1003, 0) == 0

    def test_inhibit_time(self, operational) -> None:
        desk = operational
        desk.write(0x1015, 0, 100, 2)  # 10 ms
        start_ns = desk.t_ns
        for length in (0, 2, 3):
            desk.node.on_frame(0x80, bytes(length), desk.t_ns)
        desk.run(50)
        assert [t_ns - start_ns for can_id, _, t_ns in desk.sent if can_id == 0x084] == [
            0,
            10_000_000,
            20_000_000,
        ]

    def test_disabled_by_its_cob_id(self, operational) -> None:
        desk = operational
        desk.write(0x1014, 0, 0x80000084, 4)
        assert desk.frame(0x80) == []
        assert desk.read(0x1003, 0) == 1


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
