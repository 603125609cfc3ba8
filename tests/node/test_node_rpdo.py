"""RPDOs: what they write and when, and what is told of those that are wrong (CiA 301 v4.2, 7.5.2.33)."""

from __future__ import annotations

import pytest

PDO, EMCY = 0x304, 0x084  # RPDO2, spare from the start
MODE, SINGLE_SCAN, TARE = 0x2020_0108, 0x2021_0508, 0x2021_0420
U8_DUMMY, U16_DUMMY, U32_DUMMY, I8_DUMMY, I16_DUMMY, I32_DUMMY = (
    0x0005_0008,
    0x0006_0010,
    0x0007_0020,
    0x0002_0008,
    0x0003_0010,
    0x0004_0020,
)


@pytest.fixture
def rpdo2(operational):
    """An OPERATIONAL node whose RPDO2 sets the send mode, or what else is asked for."""

    def make(*entries: int, cob_id: int = PDO, **values: int):
        operational.configure_pdo(0x1401, *(entries or (MODE,)), cob_id=cob_id, **values)
        return operational

    return make


def mode(desk) -> int:
    return desk.read(0x2020, 1)


def emergencies(frames: list[tuple[int, str]]) -> list[str]:
    return [data for can_id, data in frames if can_id == EMCY]


@pytest.mark.parametrize("kind", [254, 255])
def test_event_driven_acts_at_once(rpdo2, kind: int) -> None:
    desk = rpdo2(kind=kind)
    assert desk.frame(PDO, "01") == []
    assert mode(desk) == 1


@pytest.mark.parametrize("kind", [0, 1, 2, 240])
def test_synchronous_acts_at_the_next_sync_whatever_its_number(rpdo2, kind: int) -> None:
    desk = rpdo2(kind=kind)
    desk.frame(PDO, "00")
    desk.frame(PDO, "01")  # the last one counts
    assert mode(desk) == 0
    desk.frame(0x80, "01")
    assert mode(desk) == 1
    desk.write(0x2020, 1, 0, 1)
    desk.frame(0x80, "02")
    assert mode(desk) == 0  # acted upon once


def test_synchronous_acts_before_the_scan_of_that_sync(rpdo2) -> None:
    """A tare received before the SYNC is in the scan of the SYNC: R/R0 = 1 there."""
    desk = rpdo2(TARE, kind=1)
    desk.source.ohm = desk.source.ohm * 0.6
    desk.frame(PDO, "74 61 72 65")
    desk.frame(0x80, "01")
    assert desk.read(0x2100, 1) == round(0.75 * 65532)


@pytest.mark.parametrize("state", ["80 00", "02 00"])
def test_what_waits_for_a_sync_is_void_when_operational_is_left(rpdo2, state: str) -> None:
    desk = rpdo2(kind=1)
    desk.frame(PDO, "01")
    desk.frame(0, state)
    assert desk.frame(PDO, "01") == []  # not taken at all
    desk.start()
    desk.frame(0x80, "01")
    assert mode(desk) == 0


def test_what_waits_is_void_when_the_pdo_is_changed(rpdo2) -> None:
    desk = rpdo2(kind=1)
    desk.frame(PDO, "01")
    desk.configure_pdo(0x1401, U8_DUMMY, MODE, cob_id=PDO, kind=1)
    desk.frame(0x80, "01")
    assert mode(desk) == 0


@pytest.mark.parametrize(
    ("dummies", "n_bytes"),
    [
        ([U8_DUMMY], 1),
        ([I8_DUMMY], 1),
        ([U16_DUMMY], 2),
        ([I16_DUMMY], 2),
        ([U32_DUMMY, U16_DUMMY, U8_DUMMY], 7),
        ([I32_DUMMY], 4),
    ],
)
def test_dummy_entries_are_passed_over(rpdo2, dummies: list[int], n_bytes: int) -> None:
    desk = rpdo2(*dummies, MODE, kind=255)
    assert desk.frame(PDO, "ff " * n_bytes + "01") == []
    assert mode(desk) == 1


@pytest.mark.parametrize("entry", [0x0001_0001, 0x0001_0008, 0x0008_0020, 0x0005_0010, 0x0005_0108])
def test_entries_that_are_no_dummies(desk, entry: int) -> None:
    """BOOLEAN, REAL32, a wrong length, a sub-index."""
    answer = desk.sdo((b"\x23\x01\x16\x01" + entry.to_bytes(4, "little")).hex())
    assert answer[12:] in ("00 00 02 06", "41 00 04 06")


def test_dummies_are_for_rpdos_alone(desk) -> None:
    assert desk.sdo("23 02 1a 01 08 00 05 00") == "80 02 1a 01 00 00 02 06"


def test_two_rpdos_may_share_a_cob_id(rpdo2) -> None:
    desk = rpdo2(MODE, kind=255)
    desk.configure_pdo(0x1402, TARE, cob_id=PDO, kind=255)
    desk.source.ohm = desk.source.ohm * 0.6
    # one byte is enough for the first and too little for the second, RPDO3
    assert emergencies(desk.frame(PDO, "01")) == ["10 82 11 03 01 04 00 00"]
    assert mode(desk) == 1
    frames = desk.frame(PDO, "74 61 72 65")  # too long for the first, and no mode either
    over = ["00 00 11 20 82 00 00 00", "00 00 00 10 82 00 00 00"]  # the register holds what is left
    assert emergencies(frames) == ["20 82 11 02 04 01 00 00", *over]
    assert mode(desk) == 1
    desk.frame(0x80, "01")
    assert desk.read(0x2100, 1) == round(0.75 * 65532)


NOT_TOO_LONG = "00 00 00 20 82 00 00 00"


class TestLength:
    def test_too_short_is_told_once_until_it_is_right(self, rpdo2) -> None:
        desk = rpdo2(TARE, kind=255)
        told = [emergencies(desk.frame(PDO, data)) for data in ("", "01", "01 02 03", "00 00 00 00", "00")]
        assert told == [
            ["10 82 11 02 00 04 00 00"],
            [],
            [],
            ["00 00 00 10 82 00 00 00"],
            ["10 82 11 02 01 04 00 00"],
        ]

    def test_the_error_lasts_until_the_last_one_is_right(self, rpdo2) -> None:
        desk = rpdo2(kind=255)
        desk.frame(PDO)
        desk.frame(0x204)
        assert emergencies(desk.frame(PDO, "00")) == []
        assert desk.read(0x1001, 0) == 0x11
        assert emergencies(desk.frame(0x204, "00 " * 6)) == ["00 00 00 10 82 00 00 00"]
        assert desk.read(0x1001, 0) == 0

    def test_too_long_is_processed_and_told_once(self, rpdo2) -> None:
        desk = rpdo2(kind=255)
        assert emergencies(desk.frame(PDO, "01 ff")) == ["20 82 11 02 02 01 00 00", NOT_TOO_LONG]
        assert mode(desk) == 1
        assert emergencies(desk.frame(PDO, "00 ff")) == []
        assert mode(desk) == 0
        assert emergencies(desk.frame(PDO, "00")) == []
        assert emergencies(desk.frame(PDO, "00 00 00")) == ["20 82 11 02 03 01 00 00", NOT_TOO_LONG]
        assert desk.read(0x1001, 0) == 0  # it does no harm

    def test_changing_the_pdo_ends_its_error(self, rpdo2) -> None:
        desk = rpdo2(kind=255)
        desk.frame(PDO)
        assert emergencies(desk.frame(0x604, "23 01 14 01 04 03 00 80")) == ["00 00 00 10 82 00 00 00"]


class TestDeadline:
    """0x1400:5 watches over the RPDO, from its first frame on."""

    def test_timeout_and_return(self, rpdo2) -> None:
        desk = rpdo2(kind=255, timer=50)
        desk.run(200)
        assert desk.take() == []  # nothing came yet
        desk.frame(PDO, "01")
        start_ns = desk.t_ns
        desk.run(40)
        desk.node.on_frame(PDO, b"\x01", desk.t_ns)
        desk.run(200)
        assert desk.times(EMCY, start_ns) == [90]
        assert desk.take() == [(EMCY, "50 82 11 02 00 00 00 00")]
        assert desk.read(0x1001, 0) == 0x11
        assert desk.frame(PDO, "01") == [(EMCY, "00 00 00 50 82 00 00 00")]
        assert desk.read(0x1001, 0) == 0

    def test_one_too_short_is_none(self, rpdo2) -> None:
        desk = rpdo2(kind=255, timer=50)
        desk.frame(PDO, "01")
        desk.run(40)
        desk.frame(PDO)
        desk.run(10)
        assert [data[:5] for data in emergencies(desk.take())] == ["50 82"]

    def test_nothing_is_missed_outside_operational(self, rpdo2) -> None:
        desk = rpdo2(kind=255, timer=50)
        desk.frame(PDO, "01")
        desk.frame(0, "80 00")
        desk.run(200)
        desk.start()
        desk.run(200)
        assert desk.take() == []

    @pytest.mark.parametrize(("command", "told"), [("80 00", ["00 00 00 50 82 00 00 00"]), ("02 00", [])])
    def test_nothing_is_late_any_more_outside_operational(self, rpdo2, command: str, told: list[str]) -> None:
        """A stopped node may not tell of the end, and does so when it may."""
        desk = rpdo2(kind=255, timer=50)
        desk.frame(PDO, "01")
        desk.run(60)
        assert emergencies(desk.take()) == ["50 82 11 02 00 00 00 00"]
        at_once = emergencies(desk.frame(0, command))
        assert at_once == told
        desk.run(200)
        assert [*at_once, *emergencies(desk.frame(0, "80 00"))] == ["00 00 00 50 82 00 00 00"]
        assert desk.read(0x1001, 0) == 0
        desk.start()
        desk.run(200)
        assert emergencies(desk.take()) == []  # watched over anew from the next one on
        desk.frame(PDO, "01")
        desk.run(60)
        assert emergencies(desk.take()) == ["50 82 11 02 00 00 00 00"]

    def test_switched_off_ends_the_error(self, rpdo2) -> None:
        desk = rpdo2(kind=255, timer=50)
        desk.frame(PDO, "01")
        desk.run(60)
        desk.write(0x1401, 5, 0, 2)
        assert desk.read(0x1001, 0) == 0
        desk.frame(PDO, "01")
        desk.run(100)
        assert emergencies(desk.take()) == []
