"""SDO server against the frames of CiA 301 v4.2, 7.2.4.3, written out byte by byte."""

from __future__ import annotations

from collections.abc import Callable

import pytest

ABORTS = {
    "toggle": "00 00 03 05",
    "timeout": "00 00 04 05",
    "command": "01 00 04 05",
    "block size": "02 00 04 05",
    "access": "00 00 01 06",
    "write only": "01 00 01 06",
    "read only": "02 00 01 06",
    "no object": "00 00 02 06",
    "not mappable": "41 00 04 06",
    "pdo too long": "42 00 04 06",
    "incompatible": "43 00 04 06",
    "too long": "12 00 07 06",
    "too short": "13 00 07 06",
    "no sub-index": "11 00 09 06",
    "value": "30 00 09 06",
    "too high": "31 00 09 06",
    "too low": "32 00 09 06",
    "store": "20 00 00 08",
    "state": "22 00 00 08",
    "no data": "24 00 00 08",
}


@pytest.mark.parametrize(
    ("request_", "response"),
    [
        ("40 00 10 00 00 00 00 00", "43 00 10 00 00 00 00 00"),  # device type, u32
        ("40 01 10 00 00 00 00 00", "4f 01 10 00 00 00 00 00"),  # error register, u8
        ("40 18 10 00 00 00 00 00", "4f 18 10 00 04 00 00 00"),
        ("40 18 10 02 00 00 00 00", "43 18 10 02 4e 49 4b 53"),  # "SKIN" as a number
        ("40 17 10 00 00 00 00 00", "4b 17 10 00 00 00 00 00"),  # heartbeat, u16
        ("40 14 10 00 00 00 00 00", "43 14 10 00 84 00 00 00"),  # EMCY: 0x80 + 4
        ("40 00 12 01 00 00 00 00", "43 00 12 01 04 06 00 00"),
        ("40 00 12 02 00 00 00 00", "43 00 12 02 84 05 00 00"),
        ("40 00 18 01 00 00 00 00", "43 00 18 01 84 01 00 00"),
        ("40 00 14 01 00 00 00 00", "43 00 14 01 04 02 00 00"),
        ("40 00 1a 01 00 00 00 00", "43 00 1a 01 08 01 10 20"),  # 0x2010:1, 8 bits
        ("40 00 20 06 00 00 00 00", "43 00 20 06 00 00 80 3e"),  # lo = 0.25f
    ],
)
def test_expedited_upload(desk, request_: str, response: str) -> None:
    assert desk.frame(0x604, request_) == [(0x584, response)]


def test_serial_number_reaches_identity_and_descriptor(make: Callable) -> None:
    desk = make(serial=0x12345678)
    assert desk.sdo("40 18 10 04 00 00 00 00") == "43 18 10 04 78 56 34 12"
    assert desk.read(0x2000, 11) == 0x12345678


def test_segmented_upload_of_the_device_name(desk) -> None:
    assert desk.sdo("40 08 10 00 00 00 00 00") == "41 08 10 00 0e 00 00 00"
    assert desk.sdo("60 00 00 00 00 00 00 00") == "00 " + b"skinnod".hex(" ")
    assert desk.sdo("70 00 00 00 00 00 00 00") == "11 " + b"e patch".hex(" ")  # c = 1, n = 0
    assert desk.sdo("60 00 00 00 00 00 00 00")[:2] == "80"  # nothing is left to read


def test_last_segment_says_how_many_bytes_it_lacks(desk) -> None:
    assert desk.sdo("40 09 10 00 00 00 00 00") == "43 09 10 00 " + b"none".hex(
        " "
    )  # four bytes are expedited
    assert desk.sdo("40 0a 10 00 00 00 00 00") == "41 0a 10 00 05 00 00 00"
    assert desk.sdo("60 00 00 00 00 00 00 00") == "05 " + b"0.1.0".hex(" ") + " 00 00"  # n = 2, c = 1


def test_expedited_download_is_stored(desk) -> None:
    assert desk.sdo("2b 17 10 00 e8 03 00 00") == "60 17 10 00 00 00 00 00"
    assert desk.read(0x1017, 0) == 1000
    # Without an indicated size (s = 0) the object's size counts.
    assert desk.sdo("22 17 10 00 f4 01 00 00") == "60 17 10 00 00 00 00 00"
    assert desk.read(0x1017, 0) == 500


def test_segmented_download_of_two_bytes(desk) -> None:
    assert desk.sdo("21 17 10 00 02 00 00 00") == "60 17 10 00 00 00 00 00"
    assert desk.read(0x1005, 0) == 0x80  # another transfer ends it
    assert desk.sdo("21 17 10 00 02 00 00 00") == "60 17 10 00 00 00 00 00"
    assert desk.sdo("0b e8 03 00 00 00 00 00") == "20 00 00 00 00 00 00 00"  # n = 5, c = 1
    assert desk.read(0x1017, 0) == 1000


def test_download_in_two_segments_toggles(desk) -> None:
    desk.sdo("20 17 10 00 00 00 00 00")  # size not given
    assert desk.sdo("0c e8 00 00 00 00 00 00") == "20 00 00 00 00 00 00 00"  # n = 6: one byte, more follow
    assert desk.sdo("1d 03 00 00 00 00 00 00") == "30 00 00 00 00 00 00 00"
    assert desk.read(0x1017, 0) == 1000


@pytest.mark.parametrize(
    ("request_", "abort"),
    [
        ("40 ff 1f 00 00 00 00 00", "no object"),
        ("40 18 10 05 00 00 00 00", "no sub-index"),
        ("40 00 10 01 00 00 00 00", "no sub-index"),
        ("40 03 10 01 00 00 00 00", "no data"),
        ("2f 00 10 00 00 00 00 00", "read only"),
        ("23 18 10 01 00 00 00 00", "read only"),
        ("21 00 23 00 08 00 00 00", "read only"),
        ("23 17 10 00 e8 03 00 00", "too long"),
        ("2f 17 10 00 e8 00 00 00", "too short"),
        ("21 17 10 00 03 00 00 00", "too long"),
        ("21 17 10 00 01 00 00 00", "too short"),
        ("2f 29 10 01 03 00 00 00", "too high"),
        ("2f 21 20 02 00 00 00 00", "too low"),
        ("2f 19 10 00 01 00 00 00", "value"),  # 0 or 2 to 240
        ("2f 19 10 00 f1 00 00 00", "too high"),
        ("2f 03 10 00 01 00 00 00", "value"),  # only 0 clears the error history
        ("23 06 10 00 63 00 00 00", "too low"),  # SYNC every 99 µs
        ("23 05 10 00 80 00 00 20", "value"),  # no extended identifiers
        ("23 05 10 00 01 06 00 00", "value"),  # an SDO's identifier
        ("23 14 10 00 85 00 00 00", "value"),  # in use
        ("23 10 10 01 73 61 76 65", "store"),  # nothing is stored yet, and 0x1010 says so
        ("23 10 10 01 00 00 00 00", "store"),
        ("23 21 20 04 00 00 00 01", "store"),  # not the signature "tare"
        ("23 00 22 01 00 00 00 00", "value"),  # R0 = 0
        ("23 00 22 01 00 00 c0 7f", "value"),  # R0 = NaN
        ("40 18 10 ff 00 00 00 00", "no sub-index"),  # 0xFF, the structure, is not offered
        ("40 00 22 ff 00 00 00 00", "no sub-index"),
        ("2f 00 22 00 05 00 00 00", "read only"),  # sub-index 0 of an array
        ("40 05 00 00 00 00 00 00", "no object"),  # dummy entries are for PDO mappings alone
        ("2f 05 00 00 01 00 00 00", "no object"),
        ("23 01 23 00 00 00 7a 44", "too short"),  # the baseline is written whole
        ("21 01 23 00 2f 00 00 00", "too short"),
        ("21 01 23 00 31 00 00 00", "too long"),
        ("a4 ff 1f 00 7f 00 00 00", "no object"),
        ("a4 18 10 05 7f 00 00 00", "no sub-index"),
        ("a4 08 10 00 00 00 00 00", "block size"),
        ("a4 08 10 00 80 00 00 00", "block size"),
        ("c6 00 23 00 08 00 00 00", "read only"),
        ("c6 17 10 00 03 00 00 00", "too long"),
        ("c6 17 10 00 01 00 00 00", "too short"),
        ("c6 ff 1f 00 01 00 00 00", "no object"),
        ("e0 08 10 00 00 00 00 00", "command"),
        ("81 08 10 00 00 00 00 00", "command"),
        ("60 00 00 00 00 00 00 00", "command"),  # a segment of no transfer
        ("00 00 00 00 00 00 00 00", "command"),
        ("a1 00 00 00 00 00 00 00", "command"),  # the rest of a block transfer of no transfer
        ("a2 7f 7f 00 00 00 00 00", "command"),
        ("a3 00 00 00 00 00 00 00", "command"),
        ("c1 00 00 00 00 00 00 00", "command"),
    ],
)
def test_abort_codes(desk, request_: str, abort: str) -> None:
    asked = bytes.fromhex(request_)
    goes_on = asked[0] in (0x00, 0x60, 0xA1, 0xA2, 0xA3, 0xC1)  # names no object
    where = bytes(3) if goes_on else asked[1:4]
    assert desk.frame(0x604, request_) == [(0x584, f"80 {where.hex(' ')} {ABORTS[abort]}")]


def test_capability_of_storing_is_denied(desk) -> None:
    assert desk.read(0x1010, 1) == 0
    assert desk.read(0x1011, 1) == 0


def test_wrong_toggle_ends_the_transfer(desk) -> None:
    desk.sdo("40 08 10 00 00 00 00 00")
    assert desk.sdo("70 00 00 00 00 00 00 00") == f"80 08 10 00 {ABORTS['toggle']}"
    assert desk.sdo("60 00 00 00 00 00 00 00") == f"80 00 00 00 {ABORTS['command']}"
    desk.sdo("21 17 10 00 02 00 00 00")
    assert desk.sdo("1b e8 03 00 00 00 00 00") == f"80 17 10 00 {ABORTS['toggle']}"
    assert desk.read(0x1017, 0) == 0


@pytest.mark.parametrize(
    ("segment", "abort"), [("07 e8 03 00 00 00 00 00", "too long"), ("0d e8 00 00 00 00 00 00", "too short")]
)
def test_segments_that_do_not_add_up(desk, segment: str, abort: str) -> None:
    desk.sdo("21 17 10 00 02 00 00 00")
    assert desk.sdo(segment) == f"80 17 10 00 {ABORTS[abort]}"
    assert desk.read(0x1017, 0) == 0


def test_client_abort_is_not_answered_and_ends_the_transfer(desk) -> None:
    desk.sdo("40 08 10 00 00 00 00 00")
    assert desk.frame(0x604, "80 08 10 00 00 00 04 05") == []
    assert desk.sdo("60 00 00 00 00 00 00 00") == f"80 00 00 00 {ABORTS['command']}"


def test_silent_client_is_aborted(desk) -> None:
    desk.sdo("40 08 10 00 00 00 00 00")
    desk.run(999)
    assert desk.take() == []
    desk.run(1)
    assert desk.take() == [(0x584, f"80 08 10 00 {ABORTS['timeout']}")]
    desk.run(10_000)
    assert desk.take() == []


def test_slow_client_that_goes_on_is_not_aborted(desk) -> None:
    desk.sdo("20 17 10 00 00 00 00 00")
    desk.run(900)
    assert desk.sdo("0c e8 00 00 00 00 00 00") == "20 00 00 00 00 00 00 00"
    desk.run(900)
    assert desk.sdo("1d 03 00 00 00 00 00 00") == "30 00 00 00 00 00 00 00"
    desk.sdo("40 08 10 00 00 00 00 00")
    desk.run(900)
    desk.sdo("60 00 00 00 00 00 00 00")
    desk.run(900)
    assert desk.sdo("70 00 00 00 00 00 00 00").startswith("11")
    desk.run(5000)
    assert all(can_id == 0x704 for can_id, _ in desk.take())  # the heartbeat just set, and no abort


def test_refused_initiate_ends_the_transfer_before(desk) -> None:
    desk.sdo("40 08 10 00 00 00 00 00")
    assert desk.sdo("40 ff 1f 00 00 00 00 00").endswith(ABORTS["no object"])
    assert desk.sdo("60 00 00 00 00 00 00 00") == f"80 00 00 00 {ABORTS['command']}"


@pytest.mark.parametrize("request_", ["", "40", "40 00 10 00", "40 00 10 00 00 00 00"])
def test_what_is_no_sdo_is_not_answered(desk, request_: str) -> None:
    assert desk.frame(0x604, request_) == []


def test_remote_frames_and_other_nodes_are_not_answered(desk) -> None:
    assert desk.frame(0x604, remote=True) == []
    assert desk.frame(0x605, "40 00 10 00 00 00 00 00") == []


def test_refused_write_changes_nothing(desk) -> None:
    desk.write(0x1017, 0, 250, 2)
    for request in ("23 17 10 00 01 00 00 00", "2f 17 10 00 01 00 00 00", "21 17 10 00 09 00 00 00"):
        assert desk.sdo(request).startswith("80")
    assert desk.read(0x1017, 0) == 250


class TestRemapping:
    """The procedure of CiA 301 v4.2, 7.5.2.36, and everything that is not the procedure."""

    def test_by_the_procedure(self, desk) -> None:
        desk.write(0x1801, 1, 0x80000284, 4)
        desk.write(0x1A01, 0, 0, 1)
        desk.write(0x1A01, 1, 0x20110208, 4)
        desk.write(0x1A01, 2, 0x10010008, 4)
        desk.write(0x1A01, 0, 2, 1)
        desk.write(0x1801, 1, 0x2C4, 4)
        assert desk.read(0x1A01, 0) == 2

    @pytest.mark.parametrize(
        ("request_", "abort"),
        [
            ("2f 01 1a 00 00 00 00 00", "access"),  # while the TPDO is valid
            ("23 01 1a 01 08 00 01 10", "access"),
            ("23 01 18 01 85 02 00 00", "value"),  # another COB-ID while valid
            ("2b 01 18 03 0a 00 00 00", "value"),  # inhibit time while valid
            ("2f 01 18 06 01 00 00 00", "value"),  # SYNC start value while valid
            ("2f 01 18 02 f1 00 00 00", "value"),  # reserved transmission type
            ("23 01 18 01 84 02 00 a0", "value"),  # extended
        ],
    )
    def test_while_valid(self, desk, request_: str, abort: str) -> None:
        assert desk.sdo(request_).endswith(ABORTS[abort])

    @pytest.mark.parametrize(
        ("entry", "abort"),
        [
            ("08 00 ff 1f", "no object"),
            ("08 09 11 20", "no sub-index"),
            ("20 00 00 10", "not mappable"),
            ("10 01 10 20", "not mappable"),  # 16 bits of a u8
            ("20 04 21 20", "not mappable"),  # tare may be received, not sent
        ],
    )
    def test_entries_that_cannot_be(self, desk, entry: str, abort: str) -> None:
        desk.write(0x1801, 1, 0x80000284, 4)
        desk.write(0x1A01, 0, 0, 1)
        assert desk.sdo(f"23 01 1a 01 {entry}").endswith(ABORTS[abort])

    def test_entries_while_the_count_is_set(self, desk) -> None:
        desk.write(0x1801, 1, 0x80000284, 4)
        assert desk.sdo("23 01 1a 01 08 00 01 10").endswith(ABORTS["access"])

    def test_more_than_eight_bytes(self, desk) -> None:
        desk.write(0x1801, 1, 0x80000284, 4)
        desk.write(0x1A01, 0, 0, 1)
        for slot in (1, 2, 3):
            desk.write(0x1A01, slot, 0x20110420, 4)
        assert desk.sdo("2f 01 1a 00 03 00 00 00").endswith(ABORTS["pdo too long"])
        assert desk.sdo("2f 01 1a 00 09 00 00 00").endswith(ABORTS["pdo too long"])  # nine objects
        desk.write(0x1A01, 0, 2, 1)

    @pytest.mark.parametrize("cob_id", [0x000, 0x07F, 0x101, 0x180, 0x581, 0x604, 0x6E0, 0x704, 0x7FF])
    def test_restricted_identifiers(self, desk, cob_id: int) -> None:
        desk.write(0x1801, 1, 0x80000284, 4)
        assert desk.sdo(f"23 01 18 01 {cob_id.to_bytes(4, 'little').hex()}").endswith(ABORTS["value"])


def test_sync_counter_may_change_only_without_a_cycle_period(desk) -> None:
    desk.write(0x1006, 0, 80_000, 4)
    assert desk.sdo("2f 19 10 00 0a 00 00 00").endswith(ABORTS["state"])
    desk.write(0x1006, 0, 0, 4)
    desk.write(0x1019, 0, 10, 1)


def test_one_node_may_not_have_two_heartbeat_times(desk) -> None:
    desk.write(0x1016, 1, 0x007F_0064, 4)
    assert desk.sdo("23 16 10 02 c8 00 7f 00").endswith(ABORTS["incompatible"])
    desk.write(0x1016, 1, 0x007F_00C8, 4)  # but another one
