"""Emergencies: what is told, once, and where it can be read (CiA 301 v4.2, 7.2.7, 0x1001, 0x1003, 0x1014,
0x1015). Frames by hand."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.canopen.communication import communication_objects
from skinnode.errors import BusError
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout
from skinnode.node import NmtState
from skinnode.node.emcy import EmcyCode, EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.transport.bus_state import BusState


def test_open_wire_is_told_once_and_its_end_too(operational) -> None:
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


def test_pulled_connector_is_one_message(operational) -> None:
    desk = operational
    desk.source.ohm = np.full((2, 6), np.inf)
    emergencies = [data for can_id, data in desk.frame(0x80, "01") if can_id == 0x084]
    assert emergencies == ["00 50 81 00 00 08 00 00"]  # 2 upper and 6 lower wires
    assert desk.read(0x2031, 1) == 0b111111


def test_shorted_lower_wire(operational) -> None:
    desk = operational
    broken = desk.source.ohm.copy()
    broken[:, 5] = 0.0
    desk.source.ohm = broken
    assert desk.frame(0x80, "01")[0] == (0x084, "00 50 81 03 05 01 00 00")
    assert desk.read(0x2031, 2) == 1 << 5


def test_each_word_of_wire_faults_has_32_wires(make) -> None:
    layout = PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=2, lower_wires=70)
    ohm = np.array(resistance_ohm(layout, layout.upper_m))
    desk = make(layout, ohm=ohm)
    broken = ohm.copy()
    broken[:, [0, 31, 33, 64]] = np.inf
    broken[:, [32, 69]] = 0.0
    desk.source.ohm = broken
    desk.start()
    desk.frame(0x80)
    open_wires, shorted = (
        [desk.read(0x2031, sub) for sub in (first, first + 2, first + 4)] for first in (1, 2)
    )
    assert open_wires == [1 << 31 | 1, 1 << 1, 1]
    assert shorted == [0, 1, 1 << 69 - 64]


SYNC_IS_OVER = (0x084, "00 00 00 40 82 00 00 00")


def test_sync_of_the_wrong_length(operational) -> None:
    desk = operational
    assert desk.frame(0x80) == [(0x084, "40 82 11 00 01 00 00 00"), SYNC_IS_OVER]
    assert desk.frame(0x80, "01 02") == [(0x084, "40 82 11 02 01 00 00 00"), SYNC_IS_OVER]
    assert desk.read(0x1001, 0) == 0  # as the last message said
    assert desk.read(0x1003, 0) == 2


def test_sync_of_one_wrong_length_is_told_once(operational) -> None:
    """A node that was reset hears the SYNC of its master with a counter it knows nothing of, for ever."""
    desk = operational
    told = [desk.frame(0x80) for _ in range(5)]
    assert told == [[(0x084, "40 82 11 00 01 00 00 00"), SYNC_IS_OVER], [], [], [], []]
    desk.frame(0x80, "01")
    assert desk.frame(0x80) == [(0x084, "40 82 11 00 01 00 00 00"), SYNC_IS_OVER]


def test_history_is_the_newest_first_and_can_be_cleared(operational) -> None:
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


def test_inhibit_time(operational) -> None:
    desk = operational
    desk.write(0x1015, 0, 100, 2)  # 10 ms
    start_ns = desk.t_ns
    for length in (0, 2, 3):
        desk.node.on_frame(0x80, bytes(length), desk.t_ns)
    desk.run(50)
    sent_ns = [t_ns - start_ns for can_id, _, t_ns in desk.sent if can_id == 0x084]
    assert sent_ns == [0, 10_000_000, 20_000_000, 30_000_000, 40_000_000, 50_000_000]


def test_disabled_by_its_cob_id(operational) -> None:
    desk = operational
    desk.write(0x1014, 0, 0x80000084, 4)
    assert desk.frame(0x80) == []
    assert desk.read(0x1003, 0) == 1


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
    assert desk.frame(0, "80 00") == [SYNC_IS_OVER]
    desk.run(1000)
    assert desk.take() == [(0x084, "30 81 11 7f 00 00 00 00")]


def set_cob_id(desk, value: int) -> str:
    """The answer to writing 0x1014."""
    return desk.sdo("23 14 10 00" + value.to_bytes(4, "little").hex())


ACCEPTED, INVALID = "60 14 10 00 00 00 00 00", "80 14 10 00 30 00 09 06"


def test_cob_id_at_start(desk) -> None:
    assert desk.read(0x1014, 0) == 0x084


def test_cob_id_changes_only_while_it_is_invalid(operational) -> None:
    desk = operational
    assert set_cob_id(desk, 0x085) == INVALID
    assert set_cob_id(desk, 0x8000_0085) == ACCEPTED
    assert set_cob_id(desk, 0x086) == ACCEPTED
    assert set_cob_id(desk, 0x087) == INVALID
    assert desk.read(0x1014, 0) == 0x086
    assert desk.frame(0x80) == [(0x086, "40 82 11 00 01 00 00 00"), (0x086, SYNC_IS_OVER[1])]


@pytest.mark.parametrize(
    "can_id",
    # the restricted ones (CiA 301 v4.2, table 41), at their limits
    [0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x77F, 0x780, 0x7FF],
)
def test_restricted_cob_ids(desk, can_id: int) -> None:
    set_cob_id(desk, 0x8000_0084)
    assert set_cob_id(desk, can_id) == INVALID
    assert desk.read(0x1014, 0) == 0x8000_0084


@pytest.mark.parametrize("can_id", [0x080, 0x100, 0x181, 0x580, 0x600, 0x680, 0x6DF, 0x700])
def test_cob_ids_that_are_free(desk, can_id: int) -> None:
    set_cob_id(desk, 0x8000_0084)
    assert set_cob_id(desk, can_id) == ACCEPTED


@pytest.mark.parametrize("value", [0x2000_0084, 0x4000_0084, 0xC000_0084, 0x0000_0884, 0x1000_0084])
def test_bits_that_are_no_part_of_the_cob_id(desk, value: int) -> None:
    assert set_cob_id(desk, value) == INVALID


def test_what_was_told_to_nobody_is_not_told_later(operational) -> None:
    desk = operational
    set_cob_id(desk, 0x8000_0084)
    desk.frame(0x80)
    desk.frame(0x80, "01 02")
    desk.take()
    assert desk.frame(0x604, "23 14 10 00 84 00 00 00") == [(0x584, ACCEPTED)]
    desk.run(1000)
    assert [can_id for can_id, _ in desk.take() if can_id == 0x084] == []
    assert desk.read(0x1003, 0) == 2


def test_what_waits_is_forgotten_with_the_cob_id(operational) -> None:
    desk = operational
    desk.write(0x1015, 0, 1000, 2)  # 100 ms
    desk.frame(0x80)
    desk.frame(0x80, "01 02")
    set_cob_id(desk, 0x8000_0084)
    set_cob_id(desk, 0x084)
    desk.run(1000)
    assert desk.take() == []


class TestLastingErrors:
    """What the parts of a node may rely on: errors are told when they come, change and go."""

    @pytest.fixture
    def told(self) -> list[str]:
        return []

    @pytest.fixture
    def emcy(self, told: list[str]) -> EmcyProducer:
        store = ObjectStore(communication_objects([], [], 8), 4)
        producer = EmcyProducer(store, lambda can_id, data: told.append(f"{can_id:03x} {data.hex(' ')}"))
        producer.allow(True, 0)
        return producer

    def test_told_once(self, emcy: EmcyProducer, told: list[str]) -> None:
        for t_ns in range(5):
            emcy.report(EmcyCode.HARDWARE, b"\x01", t_ns)
        assert told == ["084 00 50 81 01 00 00 00 00"]

    def test_told_again_with_something_new_to_say(self, emcy: EmcyProducer, told: list[str]) -> None:
        emcy.report(EmcyCode.HARDWARE, b"\x01", 0)
        emcy.report(EmcyCode.HARDWARE, b"\x02", 1)
        emcy.clear(EmcyCode.HARDWARE, 2)
        assert told[1:] == ["084 00 50 81 02 00 00 00 00", "084 00 00 00 00 50 00 00 00"]

    def test_what_is_over_at_once_leaves_the_others(self, emcy: EmcyProducer, told: list[str]) -> None:
        emcy.report(EmcyCode.HARDWARE, b"", 0)
        emcy.report_once(EmcyCode.BUS_OFF_RECOVERED, b"", 1)
        assert told[1:] == ["084 40 81 91 00 00 00 00 00", "084 00 00 81 40 81 00 00 00"]

    def test_register_holds_what_is_left(self, emcy: EmcyProducer, told: list[str]) -> None:
        emcy.report(EmcyCode.HARDWARE, b"", 0)
        emcy.report(EmcyCode.HEARTBEAT, b"\x05", 1, 5)
        emcy.report(EmcyCode.HEARTBEAT, b"\x06", 2, 6)
        assert emcy.register == 0x91
        for t_ns, who in ((3, 5), (4, 6)):
            emcy.clear(EmcyCode.HEARTBEAT, t_ns, who)
            emcy.clear(EmcyCode.HEARTBEAT, t_ns, who)  # says nothing
        assert told[3:] == ["084 00 00 91 30 81 00 00 00", "084 00 00 81 30 81 00 00 00"]


@pytest.mark.parametrize("value", [1, 8, 9, 255])
def test_history_is_cleared_by_nothing_but_zero(operational, value: int) -> None:
    desk = operational
    desk.frame(0x80)
    assert desk.sdo(f"2f 03 10 00 {value:02x} 00 00 00") == "80 03 10 00 30 00 09 06"
    assert desk.read(0x1003, 0) == 1


def test_history_holds_no_more_than_there_was(operational) -> None:
    desk = operational
    assert desk.sdo("40 03 10 01 00 00 00 00") == "80 03 10 01 24 00 00 08"
    desk.frame(0x80)
    assert desk.sdo("40 03 10 01 00 00 00 00") == "43 03 10 01 40 82 00 01"
    assert desk.sdo("40 03 10 02 00 00 00 00") == "80 03 10 02 24 00 00 08"
    assert desk.sdo("40 03 10 09 00 00 00 00") == "80 03 10 09 11 00 09 06"
    assert desk.sdo("23 03 10 01 00 00 00 00") == "80 03 10 01 02 00 01 06"


def test_inhibit_time_that_is_shortened_lets_go_at_once(operational) -> None:
    desk = operational
    desk.write(0x1015, 0, 0xFFFF, 2)  # 6.5 s
    desk.frame(0x80)
    assert desk.frame(0x80, "01 02") == []
    desk.write(0x1015, 0, 0, 2)
    desk.run(0)
    assert desk.take() == [SYNC_IS_OVER, (0x084, "40 82 11 02 01 00 00 00"), SYNC_IS_OVER]


def test_more_emergencies_than_can_wait_are_counted(operational) -> None:
    desk = operational
    desk.write(0x1015, 0, 10, 2)  # 1 ms
    for number in range(10):
        desk.node.on_frame(0x80, bytes(2 + number % 2), desk.t_ns)
    desk.run(30)
    told = [data for _, data in desk.take()]
    assert told[0] == "40 82 11 02 01 00 00 00"
    assert told[1] == "10 81 11 00 00 03 00 00"  # of 20 one was told, 16 waited, 3 gave way
    assert told[2::2] == [f"40 82 11 {2 + number % 2:02x} 01 00 00 00" for number in range(2, 10)]
    assert told[3::2] == [SYNC_IS_OVER[1]] * 8  # so the last one has the register as it is
    assert desk.read(0x1003, 1) == 0x8110  # the newest: it was said after all those were known


def test_emergency_that_the_bus_refuses_is_told_later(operational) -> None:
    desk = operational
    desk.bus_refuses = True
    desk.node.on_frame(0x80, b"", desk.t_ns)
    with pytest.raises(BusError):  # the caller learns of it
        desk.run(0)
    desk.bus_refuses = False
    desk.run(0)
    assert desk.take() == [(0x084, "40 82 11 00 01 00 00 00"), SYNC_IS_OVER]


def test_what_could_not_wait_is_in_the_history_once_however_often_it_is_tried(operational) -> None:
    """The interface refuses frames for a while: the history still has what happened."""
    desk = operational
    desk.bus_refuses = True
    for number in range(10):
        desk.node.on_frame(0x80, bytes(2 + number % 2), desk.t_ns)
    for _ in range(20):
        with pytest.raises(BusError):
            desk.run(0)
    desk.bus_refuses = False
    desk.run(0)
    assert desk.take()[0] == (0x084, "10 81 11 00 00 04 00 00")  # of 20, 16 waited
    codes = [desk.read(0x1003, sub) & 0xFFFF for sub in range(1, 9)]
    assert codes == [0x8110] + [0x8240] * 7


def test_controller_that_becomes_error_passive(operational) -> None:
    desk = operational
    desk.node.on_bus(BusState.PASSIVE, desk.t_ns)
    desk.node.on_bus(BusState.PASSIVE, desk.t_ns)
    assert desk.take() == [(0x084, "20 81 11 00 00 00 00 00")]
    assert desk.node.nmt_state is NmtState.OPERATIONAL
    assert desk.frame(0, "82 00") == [(0x704, "00"), (0x084, "20 81 11 00 00 00 00 00")]  # it still is
    desk.node.on_bus(BusState.ACTIVE, desk.t_ns)
    assert desk.take() == [(0x084, "00 00 00 20 81 00 00 00")]


@pytest.mark.parametrize(
    ("behaviour", "state"),
    [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)],
)
def test_bus_off(operational, behaviour: int, state: NmtState) -> None:
    desk = operational
    desk.write(0x1029, 1, behaviour, 1)
    desk.node.on_bus(BusState.OFF, desk.t_ns)
    assert desk.node.nmt_state is state
    assert desk.take() == []  # there is no bus to tell it on
    desk.node.on_bus(BusState.ACTIVE, desk.t_ns)
    recovered = [(0x084, "40 81 11 00 00 00 00 00"), (0x084, "00 00 00 40 81 00 00 00")]
    assert desk.take() == ([] if state is NmtState.STOPPED else recovered)
    assert (desk.frame(0, "80 00") == recovered) is (state is NmtState.STOPPED)
