"""SDO block transfer against the frames of CiA 301 v4.2, 7.2.4.3.9 to 7.2.4.3.15, written out byte by byte.

The CRC is that of ITU-T V.41 with start value 0, also called XMODEM; its check value is well known.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest

from skinnode.model.layout import PatchLayout
from skinnode.protocol.coordinates import pack_coordinates

MS = 1_000_000
TIMED_OUT = "00 00 04 05"
UNKNOWN_COMMAND = "01 00 04 05"
BLOCK_SIZE = "02 00 04 05"
SEQUENCE = "03 00 04 05"
CRC = "04 00 04 05"
INVALID_VALUE = "30 00 09 06"
TOO_LONG = "12 00 07 06"
TOO_SHORT = "13 00 07 06"


def crc16(data: bytes) -> int:
    """CRC-16 with polynomial x¹⁶ + x¹² + x⁵ + 1, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


def test_the_crc_of_this_test_is_the_one_of_the_standard() -> None:
    assert crc16(b"123456789") == 0x31C3


def answers(desk, request: str, ms: float = 0) -> list[str]:
    """What the server says to a request, at once and within some milliseconds."""
    sent = desk.frame(0x604, request)
    desk.run(ms)
    return [data for can_id, data in sent + desk.take() if can_id == 0x584]


def segment(number: int, data: bytes) -> str:
    return (bytes((number,)) + data.ljust(7, b"\0")).hex(" ")


NAME = b"skinnode patch"


class TestUpload:
    def test_frame_by_frame(self, desk) -> None:
        """0x1008 is 14 bytes long: two segments."""
        assert answers(desk, "a4 08 10 00 7f 00 00 00") == ["c6 08 10 00 0e 00 00 00"]
        assert answers(desk, "a3 00 00 00 00 00 00 00", ms=1) == [
            segment(0x01, NAME[:7]),
            segment(0x82, NAME[7:]),
        ]
        end = struct.pack("<BH5x", 0xC1, crc16(NAME)).hex(" ")
        assert answers(desk, "a2 02 7f 00 00 00 00 00") == [end]
        assert answers(desk, "a1 00 00 00 00 00 00 00") == []
        desk.run(5000)
        assert desk.take() == []

    def test_without_crc(self, desk) -> None:
        assert answers(desk, "a0 08 10 00 7f 00 00 00") == ["c2 08 10 00 0e 00 00 00"]
        answers(desk, "a3 00 00 00 00 00 00 00", ms=1)
        assert answers(desk, "a2 02 7f 00 00 00 00 00") == ["c1 00 00 00 00 00 00 00"]

    def test_end_says_how_many_bytes_the_last_segment_lacks(self, desk) -> None:
        assert answers(desk, "a0 17 10 00 7f 00 00 00") == ["c2 17 10 00 02 00 00 00"]
        assert answers(desk, "a3 00 00 00 00 00 00 00", ms=1) == ["81 00 00 00 00 00 00 00"]
        assert answers(desk, "a2 01 7f 00 00 00 00 00") == ["d5 00 00 00 00 00 00 00"]  # n = 5
        assert answers(desk, "a1 00 00 00 00 00 00 00") == []

    @pytest.mark.parametrize(
        ("threshold", "answer"),
        [
            ("00", "c2 17 10 00 02 00 00 00"),  # may not be switched
            ("01", "c2 17 10 00 02 00 00 00"),
            ("02", "4b 17 10 00 00 00 00 00"),
        ],
    )
    def test_small_value_is_expedited_below_the_threshold(self, desk, threshold: str, answer: str) -> None:
        assert answers(desk, f"a0 17 10 00 7f {threshold} 00 00") == [answer]

    def test_value_is_segmented_below_the_threshold(self, desk) -> None:
        assert answers(desk, "a4 08 10 00 7f 0d 00 00") == ["c6 08 10 00 0e 00 00 00"]
        assert answers(desk, "a4 08 10 00 7f 0e 00 00") == ["41 08 10 00 0e 00 00 00"]
        assert answers(desk, "60 00 00 00 00 00 00 00") == [segment(0x00, NAME[:7])]

    def test_block_size_is_the_clients_at_each_block(self, desk) -> None:
        value = pack_coordinates(desk.layout)  # 16 electrodes, 192 bytes, 28 segments
        assert len(value) == 192
        parts = [value[at : at + 7] for at in range(0, 192, 7)]
        answers(desk, "a4 00 23 00 02 00 00 00")
        assert answers(desk, "a3 00 00 00 00 00 00 00", ms=50) == [segment(i, parts[i - 1]) for i in (1, 2)]
        assert answers(desk, "a2 02 01 00 00 00 00 00", ms=50) == [segment(1, parts[2])]
        assert answers(desk, "a2 01 05 00 00 00 00 00", ms=50) == [
            segment(i, parts[2 + i]) for i in range(1, 6)
        ]
        assert answers(desk, "a2 05 7f 00 00 00 00 00", ms=50) == [
            segment(i | (i == 20) << 7, parts[7 + i]) for i in range(1, 21)
        ]
        end = struct.pack("<BH5x", 0xC1 | 4 << 2, crc16(value)).hex(" ")
        assert answers(desk, "a2 14 7f 00 00 00 00 00") == [end]

    def test_lost_segments_are_sent_again(self, desk) -> None:
        value = pack_coordinates(desk.layout)
        parts = [value[at : at + 7] for at in range(0, 192, 7)]
        answers(desk, "a4 00 23 00 0a 00 00 00")
        answers(desk, "a3 00 00 00 00 00 00 00", ms=50)
        assert answers(desk, "a2 04 03 00 00 00 00 00", ms=50) == [
            segment(i, parts[3 + i]) for i in (1, 2, 3)
        ]
        assert answers(desk, "a2 00 03 00 00 00 00 00", ms=50) == [
            segment(i, parts[3 + i]) for i in (1, 2, 3)
        ]

    def test_lost_last_segment_is_sent_again(self, desk) -> None:
        answers(desk, "a4 08 10 00 7f 00 00 00")
        answers(desk, "a3 00 00 00 00 00 00 00", ms=10)
        assert answers(desk, "a2 01 7f 00 00 00 00 00", ms=10) == [segment(0x81, NAME[7:])]

    def test_client_that_sees_a_gap_need_not_wait_for_the_end_of_the_block(self, desk) -> None:
        value = pack_coordinates(desk.layout)
        answers(desk, "a4 00 23 00 7f 00 00 00")
        sent = answers(desk, "a3 00 00 00 00 00 00 00", ms=5)
        assert len(sent) == 11  # one each 0.5 ms
        for _ in range(3):  # and may have to say the same again
            assert answers(desk, "a2 00 7f 00 00 00 00 00", ms=5)[0] == segment(1, value[:7])
        assert answers(desk, "a2 03 7f 00 00 00 00 00")[0] == segment(1, value[21:28])

    @pytest.mark.parametrize("size", ["00", "80", "ff"])
    def test_invalid_block_size_in_an_acknowledgement(self, desk, size: str) -> None:
        answers(desk, "a4 00 23 00 02 00 00 00")
        answers(desk, "a3 00 00 00 00 00 00 00", ms=10)
        assert answers(desk, f"a2 02 {size} 00 00 00 00 00") == [f"80 00 23 00 {BLOCK_SIZE}"]

    def test_acknowledgement_of_what_was_never_sent(self, desk) -> None:
        answers(desk, "a4 00 23 00 02 00 00 00")
        answers(desk, "a3 00 00 00 00 00 00 00", ms=10)
        assert answers(desk, "a2 03 02 00 00 00 00 00") == [f"80 00 23 00 {SEQUENCE}"]

    @pytest.mark.parametrize(
        ("so_far", "request_"),
        [
            ([], "a1 00 00 00 00 00 00 00"),
            ([], "a2 01 7f 00 00 00 00 00"),
            (["a3 00 00 00 00 00 00 00"], "a1 00 00 00 00 00 00 00"),
            (["a3 00 00 00 00 00 00 00", "a2 02 7f 00 00 00 00 00"], "a3 00 00 00 00 00 00 00"),
            ([], "60 00 00 00 00 00 00 00"),
            (["a3 00 00 00 00 00 00 00"], "00 00 00 00 00 00 00 00"),
            (["a3 00 00 00 00 00 00 00"], "e0 00 00 00 00 00 00 00"),
            (["a3 00 00 00 00 00 00 00"], "c1 00 00 00 00 00 00 00"),
        ],
    )
    def test_what_does_not_belong_here(self, desk, so_far: list[str], request_: str) -> None:
        answers(desk, "a4 08 10 00 7f 00 00 00")
        for earlier in so_far:
            answers(desk, earlier, ms=10)
        assert answers(desk, request_) == [f"80 08 10 00 {UNKNOWN_COMMAND}"]
        assert answers(desk, "a3 00 00 00 00 00 00 00") == [f"80 00 00 00 {UNKNOWN_COMMAND}"]

    def test_frames_the_bus_delivers_twice(self, desk) -> None:
        """CAN may do so (ISO 11898-1, error in the last bit of a frame); the value arrives all the same."""
        value = pack_coordinates(desk.layout)
        answers(desk, "a4 00 23 00 0e 00 00 00")
        sent = answers(desk, "a3 00 00 00 00 00 00 00")
        sent += answers(desk, "a3 00 00 00 00 00 00 00", ms=50)
        sent += answers(desk, "a2 0e 0e 00 00 00 00 00")
        sent += answers(desk, "a2 0e 0e 00 00 00 00 00", ms=50)
        data = b"".join(bytes.fromhex(frame)[1:] for frame in sent)
        assert len(sent) == 28
        assert data[:192] == value
        assert answers(desk, "a2 0e 0e 00 00 00 00 00")[0][:2] == "d1"
        assert answers(desk, "a2 0e 0e 00 00 00 00 00") == []
        assert answers(desk, "a1 00 00 00 00 00 00 00") == []

    def test_silence_is_aborted_in_every_phase(self, desk) -> None:
        script = ["a4 08 10 00 7f 00 00 00", "a3 00 00 00 00 00 00 00", "a2 02 7f 00 00 00 00 00"]
        for phase in range(1, len(script) + 1):
            for request in script[:phase]:
                answers(desk, request, ms=10)
            desk.run(980)
            assert desk.take() == []
            desk.run(20)
            assert desk.take() == [(0x584, f"80 08 10 00 {TIMED_OUT}")]
            desk.run(5000)
            assert desk.take() == []

    def test_abort_of_the_client_ends_it_in_every_phase(self, desk) -> None:
        script = ["a4 00 23 00 7f 00 00 00", "a3 00 00 00 00 00 00 00", "a2 02 7f 00 00 00 00 00"]
        for phase in range(1, len(script) + 1):
            for request in script[:phase]:
                answers(desk, request, ms=1)
            assert answers(desk, "80 00 23 00 00 00 00 08", ms=5000) == []
            assert answers(desk, "a2 00 7f 00 00 00 00 00") == [f"80 00 00 00 {UNKNOWN_COMMAND}"]

    def test_initiate_of_another_transfer_ends_it_in_every_phase(self, desk) -> None:
        script = ["a4 00 23 00 7f 00 00 00", "a3 00 00 00 00 00 00 00", "a2 02 7f 00 00 00 00 00"]
        for phase in range(1, len(script) + 1):
            for request in script[:phase]:
                answers(desk, request, ms=1)
            assert answers(desk, "40 00 10 00 00 00 00 00", ms=5000) == ["43 00 10 00 00 00 00 00"]

    def test_stopped_node_falls_silent(self, desk) -> None:
        answers(desk, "a4 00 23 00 7f 00 00 00")
        answers(desk, "a3 00 00 00 00 00 00 00", ms=2)
        desk.frame(0, "02 04")
        desk.run(5000)
        assert desk.take() == []

    def test_pace(self, make: Callable) -> None:
        """No burst that a queue of ten frames could not take, and a block far within a client's time-out."""
        desk = make()
        answers(desk, "a4 00 23 00 7f 00 00 00")
        desk.node.on_frame(0x604, bytes.fromhex("a300000000000000"), desk.t_ns)
        assert len(desk.sent) == 1
        begun_ns = desk.t_ns
        while len(desk.sent) < 13:  # driven by a thread that wakes 3 ms late
            before = len(desk.sent)
            desk.t_ns += 3 * MS
            desk.node.on_timer(desk.t_ns)
            assert 0 < len(desk.sent) - before <= 4
        assert (desk.t_ns - begun_ns) / 13 * 127 < 100 * MS
        before = len(desk.sent)
        desk.t_ns += 100 * MS  # and once much later
        desk.node.on_timer(desk.t_ns)
        assert len(desk.sent) - before <= 4


def begin(desk, size: int | None, *, crc: bool = True) -> None:
    """Initiate the download of the baseline, 12 REAL32."""
    command = 0xC0 | crc << 2 | (size is not None) << 1
    request = struct.pack("<BHBI", command, 0x2301, 0, size or 0).hex()
    assert answers(desk, request) == [f"{0xA0 | crc << 2:x} 01 23 00 7f 00 00 00"]


BASELINE = struct.pack("<12f", *range(1000, 1012))
PARTS = [BASELINE[at : at + 7] for at in range(0, 48, 7)]  # 7 segments, the last of 6 bytes
END = struct.pack("<BH5x", 0xC1 | 1 << 2, crc16(BASELINE)).hex()


def end(data: bytes, unused: int) -> str:
    return struct.pack("<BH5x", 0xC1 | unused << 2, crc16(data)).hex()


def baseline(desk) -> list[int]:
    """As the other objects have it: sub-index by sub-index."""
    return [desk.read(0x2200 + row, column) for row in range(2) for column in range(1, 7)]


WRITTEN = list(struct.unpack("<12I", BASELINE))


class TestDownload:
    @pytest.mark.parametrize("size", [48, None])
    @pytest.mark.parametrize("crc", [True, False])
    def test_frame_by_frame(self, desk, size: int | None, crc: bool) -> None:
        before = baseline(desk)
        assert before != WRITTEN
        begin(desk, size, crc=crc)
        for number in range(1, 7):
            assert answers(desk, segment(number, PARTS[number - 1])) == []
        assert answers(desk, segment(0x87, PARTS[6])) == ["a2 07 7f 00 00 00 00 00"]
        assert answers(desk, END if crc else "c5 00 00 00 00 00 00 00") == ["a1 00 00 00 00 00 00 00"]
        assert baseline(desk) == WRITTEN
        desk.run(5000)
        assert desk.take() == []

    def test_segments_after_a_gap_are_asked_for_again(self, desk) -> None:
        begin(desk, 48)
        for number in (1, 2, 4, 5, 6):
            assert answers(desk, segment(number, PARTS[number - 1])) == []
        assert answers(desk, segment(0x87, PARTS[6])) == ["a2 02 7f 00 00 00 00 00"]
        for number in (1, 2, 3, 4):
            assert answers(desk, segment(number, PARTS[number + 1])) == []
        assert answers(desk, segment(0x85, PARTS[6])) == ["a2 05 7f 00 00 00 00 00"]
        assert answers(desk, END) == ["a1 00 00 00 00 00 00 00"]
        assert baseline(desk) == WRITTEN

    def test_all_segments_again_when_the_first_is_lost(self, desk) -> None:
        begin(desk, 48)
        for number in range(2, 7):
            answers(desk, segment(number, PARTS[number - 1]))
        assert answers(desk, segment(0x87, PARTS[6])) == ["a2 00 7f 00 00 00 00 00"]

    def test_frames_the_bus_delivers_twice(self, desk) -> None:
        begin(desk, 48)
        for number in range(1, 7):
            for _ in range(2):
                assert answers(desk, segment(number, PARTS[number - 1])) == []
        assert answers(desk, segment(0x87, PARTS[6])) == ["a2 07 7f 00 00 00 00 00"]
        assert answers(desk, segment(0x87, PARTS[6])) == []
        assert answers(desk, END) == ["a1 00 00 00 00 00 00 00"]
        assert baseline(desk) == WRITTEN

    def test_a_full_block_is_acknowledged_at_its_end(self, make: Callable) -> None:
        """300 R0 are 1200 bytes: blocks of 127 and 45 segments. Equal values make equal segments in both."""
        desk = make(PatchLayout.preset("staggered"))
        value = struct.pack("<f", 0x10101 / 2**16) * 300
        assert answers(desk, "c6 01 23 00 b0 04 00 00") == ["a4 01 23 00 7f 00 00 00"]
        for number in range(127):
            got = answers(desk, segment(number + 1, value[number * 7 : number * 7 + 7]))
            assert got == (["a2 7f 7f 00 00 00 00 00"] if number == 126 else [])
        for number in range(45):
            part = value[889 + number * 7 : 896 + number * 7]
            got = answers(desk, segment(number + 1 | (number == 44) << 7, part))
            assert got == (["a2 2d 7f 00 00 00 00 00"] if number == 44 else [])
        assert answers(desk, end(value, 4)) == ["a1 00 00 00 00 00 00 00"]
        assert desk.read(0x2209, 30).to_bytes(4, "little") == value[:4]

    def test_wrong_crc(self, desk) -> None:
        before = baseline(desk)
        begin(desk, 48)
        for number in range(1, 8):
            answers(desk, segment(number | (number == 7) << 7, PARTS[number - 1]))
        wrong = struct.pack("<BH5x", 0xC1 | 1 << 2, crc16(BASELINE) ^ 1).hex()
        assert answers(desk, wrong) == [f"80 01 23 00 {CRC}"]
        assert baseline(desk) == before

    def test_sequence_number_zero(self, desk) -> None:
        begin(desk, 48)
        answers(desk, segment(1, PARTS[0]))
        assert answers(desk, segment(0, PARTS[1])) == [f"80 01 23 00 {SEQUENCE}"]
        assert answers(desk, segment(2, PARTS[1])) == [f"80 00 00 00 {UNKNOWN_COMMAND}"]

    @pytest.mark.parametrize("size", [48, None])
    def test_more_than_fits(self, desk, size: int | None) -> None:
        before = baseline(desk)
        begin(desk, size)
        for number in range(1, 7):
            assert answers(desk, segment(number, PARTS[number - 1])) == []
        assert answers(desk, segment(7, PARTS[6])) == [f"80 01 23 00 {TOO_LONG}"]
        assert baseline(desk) == before

    @pytest.mark.parametrize("size", [48, None])
    def test_one_byte_more_than_fits(self, desk, size: int | None) -> None:
        begin(desk, size)
        for number in range(1, 8):
            answers(desk, segment(number | (number == 7) << 7, PARTS[number - 1]))
        assert answers(desk, end(BASELINE + b"\0", 0)) == [f"80 01 23 00 {TOO_LONG}"]

    @pytest.mark.parametrize("size", [48, None])
    def test_less_than_is_wanted(self, desk, size: int | None) -> None:
        before = baseline(desk)
        begin(desk, size)
        answers(desk, segment(1, PARTS[0]))
        answers(desk, segment(0x82, PARTS[1]))
        assert answers(desk, end(BASELINE[:14], 0)) == [f"80 01 23 00 {TOO_SHORT}"]
        assert baseline(desk) == before

    def test_one_impossible_value_keeps_all_out(self, desk) -> None:
        before = baseline(desk)
        for bad in (0.0, -1.0, float("nan"), float("inf")):
            value = BASELINE[:-4] + struct.pack("<f", bad)
            begin(desk, 48)
            for number in range(1, 8):
                part = value[number * 7 - 7 : number * 7]
                answers(desk, segment(number | (number == 7) << 7, part))
            assert answers(desk, end(value, 1)) == [f"80 01 23 00 {INVALID_VALUE}"]
            assert baseline(desk) == before

    def test_object_of_two_bytes(self, desk) -> None:
        assert answers(desk, "c2 17 10 00 02 00 00 00") == ["a0 17 10 00 7f 00 00 00"]
        assert answers(desk, "81 e8 03 00 00 00 00 00") == ["a2 01 7f 00 00 00 00 00"]
        assert answers(desk, "d5 00 00 00 00 00 00 00") == ["a1 00 00 00 00 00 00 00"]
        assert desk.read(0x1017, 0) == 1000

    def test_nothing_is_written_before_the_end(self, desk) -> None:
        answers(desk, "c2 17 10 00 02 00 00 00")
        answers(desk, "81 e8 03 00 00 00 00 00")
        assert desk.read(0x1017, 0) == 0  # and the upload ends the download
        assert answers(desk, "d5 00 00 00 00 00 00 00") == [f"80 00 00 00 {UNKNOWN_COMMAND}"]
        assert desk.read(0x1017, 0) == 0

    def test_segment_where_the_end_is_due(self, desk) -> None:
        answers(desk, "c2 17 10 00 02 00 00 00")
        answers(desk, "81 e8 03 00 00 00 00 00")
        assert answers(desk, "02 00 00 00 00 00 00 00") == [f"80 17 10 00 {UNKNOWN_COMMAND}"]

    def test_silence_is_aborted_in_every_phase(self, desk) -> None:
        script = [
            "c6 01 23 00 30 00 00 00",
            segment(1, PARTS[0]),
            *(segment(number | (number == 7) << 7, PARTS[number - 1]) for number in range(2, 8)),
        ]
        for phase in (1, 2, 5, len(script)):
            for request in script[:phase]:
                answers(desk, request)
            desk.run(999)
            assert desk.take() == []
            desk.run(1)
            assert desk.take() == [(0x584, f"80 01 23 00 {TIMED_OUT}")]
            desk.run(5000)
            assert desk.take() == []

    def test_segments_out_of_sequence_do_not_keep_it_alive(self, desk) -> None:
        """A client that restarted knows of no transfer; its requests look like segments, but not for ever."""
        begin(desk, 48)
        answers(desk, segment(1, PARTS[0]))
        assert answers(desk, "40 00 10 00 00 00 00 00", ms=999) == []  # segment 64
        assert answers(desk, "40 00 10 00 00 00 00 00", ms=1) == [f"80 01 23 00 {TIMED_OUT}"]
        assert answers(desk, "40 00 10 00 00 00 00 00") == ["43 00 10 00 00 00 00 00"]

    def test_abort_of_the_client_ends_it_in_every_phase(self, desk) -> None:
        before = baseline(desk)
        for segments in (0, 1, 7):
            begin(desk, 48)
            for number in range(1, segments + 1):
                answers(desk, segment(number | (number == 7) << 7, PARTS[number - 1]))
            assert answers(desk, "80 01 23 00 00 00 00 08", ms=5000) == []
            assert answers(desk, END) == [f"80 00 00 00 {UNKNOWN_COMMAND}"]
        assert baseline(desk) == before


def test_baseline_written_whole_counts_from_the_next_scan_on(desk) -> None:
    """Half of R/R0 where R0 is twice what it was, and the summary tells of the change."""

    def scan() -> tuple[list[int], str]:
        frames = desk.frame(0x80)
        desk.run(100)
        frames += desk.take()
        codes = [struct.unpack("<3H", bytes.fromhex(data)[2:]) for can_id, data in frames if can_id == 0x184]
        return [code for chunk in codes for code in chunk], [d for i, d in frames if i == 0x284][-1][3:5]

    desk.start()
    assert scan() == ([49149] * 12, "20")  # (R/R0 − 0.25) · 65532
    doubled = struct.pack("<12f", *(2 * desk.source.ohm).ravel())
    assert desk.sdo("21 01 23 00 30 00 00 00") == "60 01 23 00 00 00 00 00"
    for number in range(7):
        part = doubled[number * 7 : number * 7 + 7]
        desk.sdo(segment((number & 1) << 4 | (7 - len(part)) << 1 | (number == 6), part))
    assert scan() == ([16383] * 12, "28")  # BASELINE_CHANGED


def test_baseline_is_read_whole(desk) -> None:
    assert desk.sdo("40 01 23 00 00 00 00 00") == "41 01 23 00 30 00 00 00"
    requests = ["60" if number % 2 == 0 else "70" for number in range(7)]
    value = b"".join(bytes.fromhex(desk.sdo(f"{command}{'00' * 7}"))[1:] for command in requests)
    assert value[:48] == struct.pack("<12f", *desk.source.ohm.ravel())
