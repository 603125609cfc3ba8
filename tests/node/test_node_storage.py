"""What a node remembers over a power cycle (0x1010, 0x1011, 0x1020, the baseline), as a client sees it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from skinnode.node import FileMemory, VolatileMemory
from skinnode.node.memory import Kept, Parameters

SAVE, LOAD = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")
HARDWARE, CANNOT_STORE = "00 00 06 06", "20 00 00 08"


class Breakable(VolatileMemory):
    broken = False

    def save(self, kept: Kept) -> None:
        if self.broken:
            raise OSError("no space left on device")
        super().save(kept)


@pytest.fixture
def memory() -> Breakable:
    return Breakable()


@pytest.fixture
def desk(make: Callable, memory: Breakable):
    return make(memory=memory)


def cycle(desk) -> list[tuple[int, str]]:
    """Power off and on; returns what is sent."""
    desk.node.power_off()
    desk.power_on()
    return desk.take()


OVER = "00 00 00 00 63 00 00 00"
"""Follows what the memory had to tell: the node goes on without it."""


def emergencies(frames: list[tuple[int, str]]) -> list[str]:
    return [data for can_id, data in frames if can_id == 0x084]


def test_what_the_objects_say(desk, make: Callable) -> None:
    """CiA 301 v4.2, 7.5.2.13: bit 0, saves on command; bit 1, by itself."""
    forgetful = make()
    for index in (0x1010, 0x1011):
        for subindex in (1, 2, 3):
            assert desk.read(index, subindex) == 1
            assert forgetful.read(index, subindex) == 0
    assert forgetful.sdo("23 10 10 01 73 61 76 65") == f"80 10 10 01 {CANNOT_STORE}"
    assert forgetful.sdo("23 11 10 01 6c 6f 61 64") == f"80 11 10 01 {CANNOT_STORE}"


@pytest.mark.parametrize(
    "signature", ["73 61 76 64", "65 76 61 73", "6c 6f 61 64", "01 00 00 00", "00 00 00 00"]
)
def test_wrong_signature_saves_nothing(desk, signature: str) -> None:
    desk.write(0x1017, 0, 100, 2)
    assert desk.sdo(f"23 10 10 01 {signature}") == f"80 10 10 01 {CANNOT_STORE}"
    cycle(desk)
    assert desk.read(0x1017, 0) == 0


def test_wrong_signature_restores_nothing(desk) -> None:
    desk.write(0x1017, 0, 100, 2)
    desk.write(0x1010, 1, SAVE, 4)
    assert desk.sdo("23 11 10 01 73 61 76 65") == f"80 11 10 01 {CANNOT_STORE}"
    cycle(desk)
    assert desk.read(0x1017, 0) == 100


@pytest.mark.parametrize(
    ("subindex", "communication", "application"), [(1, 100, 77), (2, 100, 2), (3, 0, 77)]
)
def test_groups(desk, subindex: int, communication: int, application: int) -> None:
    desk.write(0x1017, 0, 100, 2)
    desk.write(0x2020, 2, 77, 2)
    desk.write(0x1010, subindex, SAVE, 4)
    cycle(desk)
    assert desk.read(0x1017, 0) == communication
    assert desk.read(0x2020, 2) == application


@pytest.mark.parametrize("change", ["an entry", "the count"])
def test_a_mapping_changed_in_one_place_only_survives(desk, change: str) -> None:
    """Either the entries or their count are those of the default."""
    entries = [desk.read(0x1A01, sub) for sub in range(1, desk.read(0x1A01, 0) + 1)]
    wanted = [0x1001_0008, *entries[1:]] if change == "an entry" else entries[:2]
    desk.configure_pdo(0x1801, *wanted, cob_id=0x284)
    desk.write(0x1010, 1, SAVE, 4)
    cycle(desk)
    assert [desk.read(0x1A01, sub) for sub in range(1, desk.read(0x1A01, 0) + 1)] == wanted


def test_without_saving_nothing_survives(desk) -> None:
    desk.write(0x2020, 2, 77, 2)
    cycle(desk)
    assert desk.read(0x2020, 2) == 2


def test_resets_bring_back_what_was_saved(desk) -> None:
    """The power-on values of CiA 301 v4.2, 7.3.2.2.1, are those stored last."""
    desk.write(0x1017, 0, 100, 2)
    desk.write(0x2020, 2, 77, 2)
    desk.write(0x1010, 1, SAVE, 4)
    desk.write(0x1017, 0, 50, 2)
    desk.write(0x2020, 2, 55, 2)
    desk.frame(0, "82 00")
    assert desk.read(0x1017, 0) == 100
    assert desk.read(0x2020, 2) == 55
    desk.frame(0, "81 00")
    assert desk.read(0x2020, 2) == 77


@pytest.mark.parametrize(("subindex", "communication", "application"), [(1, 0, 2), (2, 0, 77), (3, 100, 2)])
def test_defaults_are_valid_after_the_reset(
    desk, subindex: int, communication: int, application: int
) -> None:
    desk.write(0x1017, 0, 100, 2)
    desk.write(0x2020, 2, 77, 2)
    desk.write(0x1010, 1, SAVE, 4)
    desk.write(0x1011, subindex, LOAD, 4)
    assert desk.read(0x1017, 0) == 100
    assert desk.read(0x2020, 2) == 77
    desk.frame(0, "81 00")
    assert desk.read(0x1017, 0) == communication
    assert desk.read(0x2020, 2) == application
    cycle(desk)  # and stay so
    assert desk.read(0x1017, 0) == communication
    assert desk.read(0x2020, 2) == application


def test_hardware_failure(desk, memory: Breakable) -> None:
    desk.write(0x2020, 2, 77, 2)
    desk.write(0x1010, 1, SAVE, 4)
    memory.broken = True
    desk.write(0x2020, 2, 78, 2)
    assert desk.sdo("23 10 10 01 73 61 76 65") == f"80 10 10 01 {HARDWARE}"
    assert desk.sdo("23 11 10 01 6c 6f 61 64") == f"80 11 10 01 {HARDWARE}"
    assert desk.node.memory_problem == ""  # whoever asked has been told
    desk.write(0x2021, 4, int.from_bytes(b"tare", "little"), 4)
    assert desk.node.memory_problem == "baseline not saved: no space left on device"
    cycle(desk)
    assert desk.node.memory_problem == ""
    assert desk.read(0x2020, 2) == 77


def remap(desk) -> None:
    """TPDO1 by the standard's procedure: off, error register and scan counter, other CAN-ID, on."""
    desk.write(0x1800, 1, 0x8000_0184, 4)
    desk.write(0x1A00, 0, 0, 1)
    desk.write(0x1A00, 1, 0x1001_0008, 4)
    desk.write(0x1A00, 2, 0x2011_0108, 4)
    desk.write(0x1A00, 0, 2, 1)
    desk.write(0x1800, 2, 1, 1)
    desk.write(0x1800, 3, 55, 2)
    desk.write(0x1800, 6, 3, 1)
    desk.write(0x1800, 1, 0x1B4, 4)


def snapshot(desk) -> dict[tuple[int, int], int]:
    objects = ((0x1800, (1, 2, 3, 5, 6)), (0x1A00, (0, 1, 2, 3)), (0x1801, (1, 2)), (0x1A01, (0, 1)))
    return {(index, sub): desk.read(index, sub) for index, subs in objects for sub in subs}


class TestPdos:
    def test_mapping_survives(self, desk) -> None:
        remap(desk)
        desk.write(0x1010, 1, SAVE, 4)
        before = snapshot(desk)
        assert emergencies(cycle(desk)) == []
        assert snapshot(desk) == before
        desk.start()
        sent = [can_id for turn in range(3) for can_id, _ in desk.frame(0x80)]
        assert 0x184 not in sent

    def test_a_pdo_that_was_switched_off_stays_off(self, desk) -> None:
        desk.write(0x1801, 1, 0x8000_0284, 4)
        desk.write(0x1010, 2, SAVE, 4)
        cycle(desk)
        assert desk.read(0x1801, 1) == 0x8000_0284
        desk.start()
        desk.node.on_frame(0x80, b"", desk.t_ns)
        desk.run(100)
        assert {can_id for can_id, _ in desk.take()} == {0x184}

    def test_mapping_that_is_not_allowed_any_more(self, desk, memory: Breakable) -> None:
        """As after an update: all of it is left at its default, and told. The rest is there."""
        before = snapshot(desk)
        remap(desk)
        desk.write(0x1017, 0, 100, 2)
        desk.write(0x1010, 1, SAVE, 4)
        kept = memory.load()
        assert kept is not None
        values = {**kept.communication.values, (0x1A00, 2): struct.pack("<I", 0x1008_0020)}
        memory.save(replace(kept, communication=Parameters(4, values)))
        assert emergencies(cycle(desk)) == ["00 63 81 04 00 1a 00 00", OVER]
        after = snapshot(desk)
        assert {key: after[key] for key in after if key[0] == 0x1A00} == {
            key: before[key] for key in before if key[0] == 0x1A00
        }
        assert after[0x1800, 1] == 0x1B4
        assert desk.read(0x1017, 0) == 100

    def test_rpdo_mapping_survives(self, desk) -> None:
        desk.write(0x1400, 1, 0x8000_0204, 4)
        desk.write(0x1400, 2, 1, 1)
        desk.write(0x1600, 0, 0, 1)
        desk.write(0x1600, 1, 0x2020_0108, 4)  # send mode
        desk.write(0x1600, 0, 1, 1)
        desk.write(0x1400, 1, 0x3F0, 4)
        desk.write(0x1010, 2, SAVE, 4)
        cycle(desk)
        desk.start()
        assert desk.frame(0x3F0, "01") == []
        assert desk.read(0x2020, 1) == 0  # synchronous
        desk.frame(0x80)
        assert desk.read(0x2020, 1) == 1

    def test_spare_pdos_survive(self, desk) -> None:
        for number in (2, 3):
            desk.write(0x1A00 + number, 1, 0x1001_0008, 4)
            desk.write(0x1A00 + number, 0, 1, 1)
            desk.write(0x1800 + number, 2, 1, 1)
            desk.write(0x1800 + number, 1, 0x390 + number, 4)
        desk.write(0x1010, 1, SAVE, 4)
        cycle(desk)
        desk.start()
        assert [each for each in desk.frame(0x80) if each[0] & 0x7F0 == 0x390] == [
            (0x392, "00"),
            (0x393, "00"),
        ]


def test_sync_producer_survives(desk) -> None:
    """Its period, counter and COB-ID depend on each other, and it starts with the node."""
    desk.write(0x1019, 0, 10, 1)
    desk.write(0x1006, 0, 20_000, 4)  # 20 ms
    desk.write(0x1005, 0, 0x90, 4)
    desk.write(0x1005, 0, 0x4000_0090, 4)
    desk.write(0x1010, 1, SAVE, 4)
    desk.node.power_off()
    desk.power_on()
    desk.run(60)
    frames = desk.take()
    assert frames[0] == (0x704, "00")
    assert [data for can_id, data in frames if can_id == 0x90] == ["01", "02", "03"]
    assert emergencies(frames) == []


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ((0x1019, 0), b"\x01", "19 10 00"),  # 0, or 2 to 240
        ((0x1019, 0), b"\x05\x00", "19 10 00"),  # not of its length
        ((0x1800, 1), struct.pack("<I", 0x601), "00 18 01"),  # a restricted CAN-ID
        ((0x1014, 0), struct.pack("<I", 0x601), "14 10 00"),
        ((0x1018, 4), bytes(4), "18 10 04"),  # read only
        ((0x1FFF, 1), b"\x01", "ff 1f 01"),  # does not exist
        ((0x1BFF, 1), bytes(4), "ff 1b 01"),
        ((0x15FF, 1), bytes(4), "ff 15 01"),
    ],
)
def test_value_that_is_not_allowed_any_more(
    desk, memory: Breakable, key: tuple[int, int], value: bytes, told: str
) -> None:
    kept = memory.load()
    assert kept is not None
    memory.save(replace(kept, communication=Parameters(4, {key: value, (0x1017, 0): b"\x64\x00"})))
    frames = cycle(desk)
    assert frames[0] == (0x704, "00")  # the boot-up message comes first
    assert emergencies(frames) == [f"00 63 81 04 {told} 00", OVER]
    assert desk.node.memory_problem == f"the stored value of 0x{key[0]:04X}:{key[1]} is not allowed"
    assert desk.read(0x1017, 0) == 100
    assert desk.read(0x1019, 0) == 0
    assert desk.read(0x1014, 0) == 0x84
    assert desk.read(0x1800, 1) == 0x184
    assert desk.read(0x1018, 4) == 0


def test_what_is_refused_leaves_its_neighbours_alone(desk, memory: Breakable) -> None:
    kept = memory.load()
    assert kept is not None
    twice = struct.pack("<I", 0x007F_0064)  # one node monitored twice
    memory.save(replace(kept, communication=Parameters(4, {(0x1016, 1): twice, (0x1016, 2): twice})))
    assert emergencies(cycle(desk)) == ["00 63 81 04 16 10 02 00", OVER]
    assert [desk.read(0x1016, subindex) for subindex in (1, 2)] == [0x007F_0064, 0]


def test_every_parameter_survives(desk) -> None:
    """Each that can be written alone, at another value than its default, all at once."""
    chosen = {
        (0x1005, 0): (0x90, 4),
        (0x1012, 0): (0x8000_00A0, 4),
        (0x1014, 0): (0xA5, 4),
        (0x1015, 0): (7, 2),
        (0x1016, 1): (0x007F_0064, 4),
        (0x1016, 2): (0x0001_0064, 4),
        (0x1017, 0): (200, 2),
        (0x1019, 0): (100, 1),
        (0x1029, 1): (2, 1),
        (0x2020, 1): (1, 1),
        (0x2020, 2): (9, 2),
        (0x2020, 3): (8, 2),
        (0x2021, 1): (500, 2),
        (0x2021, 2): (3, 1),
    }
    desk.write(0x1014, 0, 0x8000_0084, 4)
    for key, (value, size) in chosen.items():
        desk.write(*key, value, size)
    desk.write(0x1010, 1, SAVE, 4)
    cycle(desk)
    desk.frame(0, "82 00")
    assert {key: desk.read(*key) for key in chosen} == {key: value for key, (value, _) in chosen.items()}


class TestBaseline:
    def test_tare_keeps_it_without_being_told(self, desk, rest_ohm) -> None:
        desk.source.ohm = rest_ohm * 1.1
        desk.write(0x2021, 4, int.from_bytes(b"tare", "little"), 4)
        desk.source.ohm = rest_ohm
        cycle(desk)
        assert desk.read(0x2200, 1) == int.from_bytes(struct.pack("<f", rest_ohm[0, 0] * 1.1), "little")

    def test_a_node_that_remembers_does_not_tare_at_power_on(self, make: Callable, tmp_path: Path) -> None:
        make(memory=FileMemory(tmp_path / "n"))
        again = make(memory=FileMemory(tmp_path / "n"))
        assert again.source.reads == 0

    def test_one_value_is_kept_on_command(self, desk) -> None:
        desk.write(0x2200, 1, 0x447A_0000, 4)  # 1000 ohm
        before = desk.read(0x2200, 2)
        cycle(desk)
        assert desk.read(0x2200, 1) != 0x447A_0000
        desk.write(0x2200, 1, 0x447A_0000, 4)
        desk.write(0x1010, 3, SAVE, 4)
        cycle(desk)
        assert desk.read(0x2200, 1) == 0x447A_0000
        assert desk.read(0x2200, 2) == before

    def test_defaults_are_not_the_end_of_it(self, desk) -> None:
        """R0 is measured: it has no default to go back to, and a patch may be pressed at the next start."""
        before, reads = desk.read(0x2200, 1), desk.source.reads
        desk.write(0x1011, 1, LOAD, 4)
        desk.source.ohm = desk.source.ohm / 2
        cycle(desk)
        assert desk.read(0x2200, 1) == before
        assert desk.source.reads == reads

    def test_that_could_not_be_kept_is_told(self, desk, memory: Breakable) -> None:
        memory.broken = True
        desk.source.ohm = desk.source.ohm / 2
        frames = desk.frame(0x604, "23 21 20 04 74 61 72 65")
        assert emergencies(frames) == ["00 63 81 05 00 00 00 00"]
        assert (0x584, "60 21 20 04 00 00 00 00") in frames  # the tare itself was done
        assert desk.read(0x1001, 0) == 0x81
        memory.broken = False
        assert emergencies(desk.frame(0x604, "23 21 20 04 74 61 72 65")) == [OVER]
        assert desk.read(0x1001, 0) == 0

    @pytest.mark.parametrize("rows", [((1.0,) * 6,), ((1.0,) * 6, (1.0,)), ((float("nan"),) * 6,) * 2])
    def test_of_no_use_is_taken_anew(self, desk, memory: Breakable, rows) -> None:
        kept = memory.load()
        assert kept is not None
        memory.save(replace(kept, baseline_ohm=rows))
        before, desk.source.reads = desk.read(0x2200, 1), 0
        node = type(desk)(desk.layout, memory=memory)
        node.power_on()
        assert emergencies(node.take()) == ["00 63 81 04 01 23 00 00", OVER]
        assert node.read(0x2200, 1) == before
        assert node.source.reads == 16


class TestVerifyConfiguration:
    """0x1020 (CiA 301 v4.2, 7.5.2.20): what a tool noted when it configured the node."""

    def note(self, desk) -> None:
        desk.write(0x1020, 1, 15_000, 4)
        desk.write(0x1020, 2, 40_000_000, 4)

    def noted(self, desk) -> bool:
        values = desk.read(0x1020, 1), desk.read(0x1020, 2)
        assert values in ((0, 0), (15_000, 40_000_000))
        return values != (0, 0)

    def test_survives_with_the_configuration(self, desk) -> None:
        remap(desk)
        desk.write(0x2020, 2, 77, 2)
        self.note(desk)
        desk.write(0x1010, 1, SAVE, 4)
        assert self.noted(desk)
        cycle(desk)
        assert self.noted(desk)
        desk.frame(0, "82 00")
        assert self.noted(desk)

    @pytest.mark.parametrize(("index", "sub", "size"), [(0x1017, 0, 2), (0x2020, 2, 2), (0x1800, 5, 2)])
    def test_any_change_takes_it_back(self, desk, index: int, sub: int, size: int) -> None:
        self.note(desk)
        desk.write(index, sub, desk.read(index, sub), size)
        assert self.noted(desk)  # no change
        desk.write(index, sub, 99, size)
        assert not self.noted(desk)

    def test_a_tare_is_no_change_of_the_configuration(self, desk) -> None:
        self.note(desk)
        desk.write(0x2021, 4, int.from_bytes(b"tare", "little"), 4)
        desk.write(0x1003, 0, 0, 1)
        assert self.noted(desk)

    def test_a_refused_write_changes_nothing(self, desk) -> None:
        self.note(desk)
        assert desk.sdo("2f 19 10 00 01 00 00 00").startswith("80")
        assert self.noted(desk)

    def test_half_a_configuration_is_not_the_one_that_was_noted(self, desk) -> None:
        desk.write(0x2020, 2, 77, 2)
        self.note(desk)
        desk.write(0x1010, 2, SAVE, 4)  # the communication parameters alone
        assert self.noted(desk)
        cycle(desk)
        assert desk.read(0x2020, 2) == 2
        assert not self.noted(desk)

    def test_nor_is_one_of_which_half_was_restored(self, desk) -> None:
        self.note(desk)
        desk.write(0x1010, 1, SAVE, 4)
        desk.write(0x2020, 2, 77, 2)
        assert not self.noted(desk)
        desk.frame(0, "82 00")
        assert desk.read(0x2020, 2) == 77
        assert not self.noted(desk)
        desk.frame(0, "81 00")
        assert desk.read(0x2020, 2) == 2
        assert self.noted(desk)

    def test_nor_is_one_of_which_a_value_was_refused(self, desk, memory: Breakable) -> None:
        """The COB-ID that was chosen for TPDO1 is, at another node-ID, the default of TPDO2."""
        desk.write(0x1800, 1, 0x8000_0184, 4)
        desk.write(0x1800, 1, 0x285, 4)
        self.note(desk)
        desk.write(0x1010, 1, SAVE, 4)
        kept = memory.load()
        assert kept is not None
        memory.save(replace(kept, node_id=5))
        assert (0x085, "00 63 81 04 00 18 01 00") in cycle(desk)
        assert desk.read(0x1800, 1) == 0x185
        assert not self.noted(desk)

    def test_gone_with_the_defaults(self, desk) -> None:
        desk.write(0x2020, 2, 77, 2)
        self.note(desk)
        desk.write(0x1010, 1, SAVE, 4)
        desk.write(0x1011, 3, LOAD, 4)
        cycle(desk)
        assert not self.noted(desk)


class TestFilesOfNoUse:
    def save(self, make: Callable, path: Path) -> None:
        with FileMemory(path) as memory:
            desk = make(memory=memory)
            desk.write(0x2020, 2, 77, 2)
            desk.write(0x1010, 1, SAVE, 4)

    def start(self, desk_type, layout, path: Path):
        desk = desk_type(layout, memory=FileMemory(path))
        desk.power_on()
        return desk

    def test_damaged(self, make: Callable, tmp_path: Path) -> None:
        path = tmp_path / "n"
        self.save(make, path)
        damaged = path.read_bytes()[:-20]
        path.write_bytes(damaged)
        desk = make(memory=FileMemory(tmp_path / "other"))
        again = self.start(type(desk), desk.layout, path)
        frames = again.take()
        assert frames[0] == (0x704, "00")
        assert emergencies(frames) == ["00 63 81 02 00 00 00 00"]
        assert again.read(0x1001, 0) == 0x81
        assert again.read(0x2020, 2) == 2
        assert again.read(0x1003, 1) == 0x0002_6300
        # Its tare went to a new file; what could be read of the old one is still there for people.
        (aside,) = tmp_path.glob("n.unused-*")
        assert aside.read_bytes() == damaged
        for reset in ("81 00", "82 00"):  # the parameters are still not those that were stored
            assert emergencies(again.frame(0, reset)) == ["00 63 81 02 00 00 00 00"]
            assert again.read(0x1001, 0) == 0x81
        assert emergencies(cycle(again)) == []
        assert again.read(0x1001, 0) == 0

    @pytest.mark.parametrize("command", ["23 10 10 01 73 61 76 65", "23 11 10 02 6c 6f 61 64"])
    def test_damage_is_over_when_parameters_are_stored_or_restored(
        self, make: Callable, tmp_path: Path, command: str
    ) -> None:
        path = tmp_path / "n"
        path.write_bytes(b"{}")
        desk = make(memory=FileMemory(path))
        assert desk.read(0x1001, 0) == 0x81
        assert emergencies(desk.frame(0x604, command)) == [OVER]
        assert desk.read(0x1001, 0) == 0

    def test_of_another_patch(self, make: Callable, layout, tmp_path: Path) -> None:
        path = tmp_path / "n"
        self.save(make, path)
        good = path.read_bytes()
        desk_type = type(make())
        moved = type(layout)(layout.upper_m * 1.01, layout.lower_m, layout.resistivity_ohm_per_m)
        foreign = self.start(desk_type, moved, path)
        assert emergencies(foreign.take()) == ["00 63 81 03 00 00 00 00"]
        assert foreign.read(0x2020, 2) == 2
        (aside,) = tmp_path.glob("n.unused-*")
        assert aside.read_bytes() == good

    def test_that_cannot_be_read(self, make: Callable, layout, tmp_path: Path) -> None:
        desk = self.start(type(make()), layout, tmp_path)  # a folder
        assert emergencies(desk.take()) == [
            "00 63 81 01 00 00 00 00",
            "00 63 81 05 00 00 00 00",
        ]
        assert desk.sdo("23 10 10 01 73 61 76 65") == f"80 10 10 01 {HARDWARE}"
