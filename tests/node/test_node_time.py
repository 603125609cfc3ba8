"""TIME (CiA 301 v4.2, 7.2.6; object 0x1012): the time of day by messages, and what of them is believed."""

from __future__ import annotations

import datetime

import pytest

EPOCH = datetime.datetime(1984, 1, 1)
MIDNIGHT_MS = 86_400_000


def message(moment: datetime.datetime, reserved: int = 0) -> str:
    """TIME_OF_DAY: u28 ms after midnight, 4 reserved bits, u16 days since 1984-01-01."""
    since = moment - EPOCH
    ms = since.seconds * 1000 + since.microseconds // 1000
    return ((ms | reserved << 28).to_bytes(4, "little") + since.days.to_bytes(2, "little")).hex()


def clock(desk) -> datetime.datetime:
    """What the node thinks it is."""
    return EPOCH + datetime.timedelta(days=desk.read(0x2022, 1), milliseconds=desk.read(0x2022, 2))


@pytest.fixture
def listening(desk):
    """A node that consumes TIME."""
    desk.write(0x1012, 0, 0x8000_0100, 4)
    return desk


def test_knows_no_time_at_start(desk) -> None:
    assert desk.read(0x1012, 0) == 0x100
    assert [desk.read(0x2022, subindex) for subindex in (1, 2, 3, 4)] == [0, 0, 0, 0]


def test_time_runs_on(listening) -> None:
    desk = listening
    noon = datetime.datetime(2024, 2, 29, 12, 0, 0, 250_000)
    desk.run(0.5)
    assert desk.frame(0x100, message(noon)) == []
    assert clock(desk) == noon
    told_us = desk.t_ns // 1000
    desk.run(12 * 3_600_000)
    assert clock(desk) == datetime.datetime(2024, 3, 1, 0, 0, 0, 250_000)
    assert desk.read(0x2022, 3) == 1
    assert desk.read(0x2022, 4) == told_us & 0xFFFF_FFFF


def test_raw_bytes(listening) -> None:
    """1984-01-02, 1 ms before midnight: 86 399 999 = 0x05265BFF."""
    desk = listening
    desk.frame(0x100, "ff 5b 26 05 01 00")
    assert [desk.read(0x2022, 1), desk.read(0x2022, 2)] == [1, 86_399_999]
    desk.run(1)
    assert [desk.read(0x2022, 1), desk.read(0x2022, 2)] == [2, 0]


def test_reserved_bits_say_nothing(listening) -> None:
    moment = datetime.datetime(2026, 1, 1, 1, 2, 3)
    listening.frame(0x100, message(moment, reserved=0xF))
    assert clock(listening) == moment


@pytest.mark.parametrize("data", ["", "00", "ff 5b 26 05 01", "ff 5b 26 05 01 00 00", "00" * 8])
def test_wrong_length_is_ignored_and_counted(listening, data: str) -> None:
    desk = listening
    moment = datetime.datetime(2026, 1, 1)
    desk.frame(0x100, message(moment))
    assert desk.frame(0x100, data) == []
    assert clock(desk) == moment
    assert desk.read(0x2022, 3) == 1
    assert desk.read(0x2040, 3) == 1


def test_a_day_has_no_more_milliseconds(listening) -> None:
    desk = listening
    desk.frame(0x100, (MIDNIGHT_MS).to_bytes(4, "little").hex() + "01 00")
    assert desk.read(0x2022, 3) == 0
    assert desk.read(0x2040, 3) == 1


def test_only_where_it_was_asked_to_listen(desk) -> None:
    moment = message(datetime.datetime(2026, 1, 1))
    desk.frame(0x100, moment)
    assert desk.read(0x2022, 3) == 0
    desk.write(0x1012, 0, 0x8000_0380, 4)
    desk.frame(0x100, moment)
    assert desk.read(0x2022, 3) == 0
    desk.frame(0x380, moment)
    assert desk.read(0x2022, 3) == 1
    desk.write(0x1012, 0, 0x380, 4)
    desk.frame(0x380, moment)
    assert desk.read(0x2022, 3) == 1
    assert desk.read(0x2040, 3) == 0


def test_states(listening) -> None:
    desk = listening
    moment = message(datetime.datetime(2026, 1, 1))
    desk.start()
    desk.frame(0x100, moment)
    desk.frame(0, "02 00")
    desk.frame(0x100, moment)
    desk.frame(0x100, "00")
    desk.frame(0, "80 00")
    assert desk.read(0x2022, 3) == 1
    assert desk.read(0x2040, 3) == 0  # a stopped node does not listen


@pytest.mark.parametrize(
    ("value", "accepted"),
    [
        (0x4000_0100, False),  # producer
        (0xC000_0100, False),
        (0xA000_0100, False),  # 29 bits
        (0x8000_0101, False),  # restricted
        (0x8000_0900, False),
        (0x0000_0100, True),
        (0x8000_0100, True),
        (0x8000_0280, True),
    ],
)
def test_cob_id(desk, value: int, accepted: bool) -> None:
    answer = desk.sdo("23 12 10 00" + value.to_bytes(4, "little").hex())
    assert answer == ("60 12 10 00 00 00 00 00" if accepted else "80 12 10 00 30 00 09 06")
    assert desk.read(0x1012, 0) == (value if accepted else 0x100)


def test_cob_id_is_not_changed_while_it_is_used(listening) -> None:
    assert listening.sdo("23 12 10 00 00 02 00 80") == "80 12 10 00 30 00 09 06"
    listening.write(0x1012, 0, 0x200, 4)
    listening.write(0x1012, 0, 0x8000_0200, 4)


def test_reset_node_forgets_the_time_and_reset_communication_does_not(listening) -> None:
    desk = listening
    desk.frame(0x100, message(datetime.datetime(2026, 1, 1)))
    desk.frame(0, "82 00")
    assert desk.read(0x1012, 0) == 0x100
    assert clock(desk) == datetime.datetime(2026, 1, 1)
    desk.frame(0, "81 00")
    assert [desk.read(0x2022, subindex) for subindex in (1, 2, 3)] == [0, 0, 0]


def test_time_travels_in_a_pdo(listening) -> None:
    desk = listening
    desk.write(0x1A02, 1, 0x2022_0220, 4)
    desk.write(0x1A02, 2, 0x2022_0110, 4)
    desk.write(0x1A02, 0, 2, 1)
    desk.write(0x1802, 2, 1, 1)
    desk.write(0x1802, 1, 0x384, 4)
    desk.frame(0x100, "01 00 00 00 02 00")
    desk.start()
    assert (0x384, "01 00 00 00 02 00") in desk.frame(0x80)
