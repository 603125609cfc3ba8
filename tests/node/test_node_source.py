"""A source that fails, and the self-test that says what a patch is like."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest

from skinnode.model.layout import Float

from ..scan_crc import check_of_scan

CHUNK, SUMMARY, EMCY = 0x184, 0x284, 0x084


class Failing:
    """Takes the place of a desk's source: ``error`` is raised, or ``reading`` given, in place of its own."""

    def __init__(self, ohm: Float) -> None:
        self.ohm = ohm
        self.error: Exception | None = None
        self.reading: object = None

    def read(self, t_ns: int) -> object:
        if self.error is not None:
            raise self.error
        return self.ohm if self.reading is None else self.reading


@pytest.fixture
def failing(operational, rest_ohm):
    source = Failing(rest_ohm)
    operational.source.read = source.read
    operational.failing = source
    return operational


def scan(desk, counter: int) -> list[tuple[int, str]]:
    desk.take()
    desk.node.on_frame(0x80, bytes((counter,)), desk.t_ns)
    desk.run(50)
    return desk.take()


def test_a_failing_source_is_told_once_and_each_scan_says_that_it_is_empty(failing) -> None:
    failing.failing.error = OSError("the converter\n is gone")
    t_us = failing.t_ns // 1000
    codes = [failing.read(0x2100 + row, sub) for row in range(2) for sub in range(1, 7)]
    head = struct.pack("<BBHH", 1, 0x30, 0, t_us >> 6 & 0xFFFF)  # CHECKED, SOURCE_FAILED, no chunk
    frames = scan(failing, 1)
    assert frames == [
        (EMCY, "00 ff 81 01 01 00 00 00"),  # 0xFF00, manufacturer's error, raised, the first
        (SUMMARY, (head + struct.pack("<H", check_of_scan(codes, 16, head))).hex(" ")),
    ]
    assert [can_id for can_id, _ in scan(failing, 2)] == [SUMMARY]
    assert failing.read(0x1001, 0) == 0x81
    assert failing.read(0x1003, 0) == 1
    assert failing.node.source_failures == 2
    assert failing.node.source_error == "source.read(): OSError: the converter is gone"
    failing.failing.error = None
    frames = scan(failing, 3)
    assert frames[0] == (EMCY, "00 00 00 00 ff 00 00 00")
    assert [can_id for can_id, _ in frames[1:]] == [CHUNK] * 4 + [SUMMARY]
    assert frames[-1][1][:5] == "03 20"
    assert failing.read(0x1001, 0) == 0


@pytest.mark.parametrize("reading", [np.ones((6, 2)), np.ones(12), "twelve", 7.0, np.ones((2, 6)) * 1j])
def test_a_reading_that_is_none(failing, reading: object) -> None:
    failing.failing.reading = reading
    frames = scan(failing, 1)
    assert frames[0] == (EMCY, "00 ff 81 02 01 00 00 00")
    assert [can_id for can_id, _ in frames[1:]] == [SUMMARY]
    assert failing.node.source_error.startswith("source.read(): ")
    failing.failing.reading = None
    assert len(scan(failing, 2)) == 6


def test_after_a_failure_a_scan_is_full_again(failing) -> None:
    failing.write(0x2020, 1, 1, 1)
    assert len(scan(failing, 1)) == 5
    assert len(scan(failing, 2)) == 1
    failing.failing.error = TimeoutError()
    scan(failing, 3)
    failing.failing.error = None
    assert len(scan(failing, 4)) == 6
    assert failing.node.source_error == "source.read(): TimeoutError"


def test_averaging_over_a_failure_is_a_failure(failing) -> None:
    failing.write(0x2021, 2, 3, 1)
    readings = iter([failing.failing.ohm, failing.failing.ohm])
    failing.source.read = lambda t_ns: next(readings)  # StopIteration the third time
    assert [can_id for can_id, _ in scan(failing, 1)] == [EMCY, SUMMARY]


def test_a_source_may_reuse_its_array(failing, rest_ohm) -> None:
    """The mean of two readings, 1 % up and 1 % down, is the baseline."""
    array, turns = rest_ohm.copy(), iter(range(100))

    def read(t_ns: int) -> Float:
        array[:] = rest_ohm * (1.01 if next(turns) % 2 else 0.99)
        return array

    failing.source.read = read
    failing.write(0x2021, 2, 2, 1)
    scan(failing, 1)
    assert abs(failing.read(0x2100, 1) - round(0.75 * 65532)) <= 1
    assert failing.sdo(TestSelfTest.RUN).startswith("60")
    (noise,) = struct.unpack("<f", failing.read(0x2023, 4).to_bytes(4, "little"))
    assert noise == pytest.approx(0.01 * (16 / 15) ** 0.5, rel=1e-6)  # 16 readings, one degree of freedom


def test_a_source_that_calls_exit_is_a_failure_and_ends_nothing(failing) -> None:
    failing.failing.error = SystemExit(3)
    assert [can_id for can_id, _ in scan(failing, 1)] == [EMCY, SUMMARY]
    assert failing.node.source_error == "source.read(): SystemExit: 3"


def test_numbers_that_no_converter_gives_warn_nobody(failing) -> None:
    """Warnings are errors here, as in a program that wants it so: nothing may come out of the node."""
    signs = iter([1.0, -1.0] * 50)
    row = [1e300, 1e-300, np.nan, -5.0, 0.0, np.inf]

    def read(t_ns: int) -> Float:
        return np.array([row, [1.7e308, 1.7e308, 1e4, 1e4, 1e4, next(signs) * np.inf]])

    failing.source.read = read
    failing.write(0x2021, 2, 4, 1)
    assert failing.sdo("23 21 20 04 74 61 72 65").startswith("60")
    assert [can_id for can_id, _ in scan(failing, 1)] == [EMCY] + [CHUNK] * 4 + [SUMMARY]
    codes = [failing.read(0x2100, column) for column in range(1, 7)]
    assert codes[2:] == [0xFFFF, 0xFFFE, 0xFFFE, 0xFFFF]  # open, shorted, shorted, open
    assert failing.sdo(TestSelfTest.RUN).startswith("60")
    assert failing.read(0x2023, 1) == 2


def test_a_tare_without_a_converter_is_refused_and_changes_nothing(failing, rest_ohm) -> None:
    failing.failing.error = OSError()
    answer = failing.sdo("23 21 20 04 74 61 72 65")
    assert answer.endswith("00 00 06 06")  # access failed due to a hardware error
    assert failing.read(0x2021, 4) == 0
    (kept,) = struct.unpack("<f", failing.read(0x2200, 1).to_bytes(4, "little"))
    assert kept == pytest.approx(rest_ohm[0, 0], rel=1e-6)


def test_tare_is_made_up_for_if_the_source_was_not_there_at_power_on(make: Callable, rest_ohm) -> None:
    desk = make(ohm=np.ones(3))
    assert desk.read(0x1001, 0) == 0x81
    assert desk.read(0x2200, 1) == 0
    desk.frame(0, "81 00")  # a reset does not mend it: told again
    assert desk.read(0x1001, 0) == 0x81
    desk.source.ohm = rest_ohm
    desk.start()
    desk.node.on_frame(0x80, b"", desk.t_ns)
    desk.run(50)
    frames = desk.take()
    assert frames[-1][1][3:5] == "28"  # BASELINE_CHANGED
    assert desk.read(0x1001, 0) == 0
    (first,) = struct.unpack("<H", bytes.fromhex(next(d for c, d in frames if c == CHUNK))[2:4])
    assert abs(first - round(0.75 * 65532)) <= 1


def test_a_baseline_written_meanwhile_is_not_tared_over(make: Callable, rest_ohm) -> None:
    desk = make(ohm=np.ones(3))
    (pattern,) = struct.unpack("<I", struct.pack("<f", 2 * rest_ohm[0, 0]))
    desk.write(0x2200, 1, pattern, 4)
    desk.source.ohm = rest_ohm
    desk.start()
    desk.frame(0x80)
    assert desk.read(0x2200, 1) == pattern
    assert desk.read(0x2200, 2) == 0


class TestSelfTest:
    """0x2021:3 runs it, 0x2023 says what it found."""

    RUN = "23 21 20 03 74 65 73 74"

    def result(self, desk) -> tuple[int, ...]:
        assert desk.sdo(self.RUN) == "60 21 20 03 00 00 00 00"
        assert desk.read(0x2021, 3) == 0
        values = [desk.read(0x2023, sub) for sub in range(1, 9)]
        (values[3],) = struct.unpack("<f", values[3].to_bytes(4, "little"))
        return tuple(values)

    def test_never_run(self, desk) -> None:
        assert [desk.read(0x2023, sub) for sub in range(9)] == [8, 0, 0, 0, 0, 0, 0, 0, 0]

    def test_a_good_patch_passes(self, desk) -> None:
        reads = desk.source.reads
        assert self.result(desk) == (1, 0, 16, 0.0, 0, 0, 0, 0)
        assert desk.source.reads == reads + 16

    def test_needs_its_signature(self, desk) -> None:
        reads = desk.source.reads
        assert desk.sdo("23 21 20 03 73 61 76 65").endswith("20 00 00 08")
        assert desk.read(0x2023, 1) == 0
        assert desk.source.reads == reads

    @pytest.mark.parametrize("noise", [1e-5, 5e-4, 5e-3])
    def test_noise_is_measured(self, desk, rest_ohm, noise: float) -> None:
        random = np.random.default_rng(7)
        desk.source.read = lambda t_ns: rest_ohm * (1 + noise * random.standard_normal((2, 6)))
        status, faults, _, measured, *_ = self.result(desk)
        # 12 crossings of 16 readings: the estimate is within 1/√(2·180) = 5 % of the truth, 1 σ.
        assert measured == pytest.approx(noise, rel=0.2)
        assert (status, faults) == ((2, 2) if noise > 1e-3 else (1, 0))

    def test_wires_and_crossings(self, desk, rest_ohm) -> None:
        ohm = rest_ohm.copy()
        ohm[:, 1] = np.inf  # a lower wire is open,
        ohm[:, 4] = 0.0  # another one shorted,
        ohm[0, 2] *= 2  # and one crossing out of range
        desk.source.ohm = ohm
        assert self.result(desk) == (2, 0x04 | 0x08 | 0x10, 16, 0.0, 1, 1, 5, 0)

    def test_no_baseline(self, make: Callable, rest_ohm) -> None:
        ohm = rest_ohm.copy()
        ohm[0] = np.inf
        desk = make(ohm=ohm)
        assert self.result(desk) == (2, 0x04 | 0x20, 16, 0.0, 1, 0, 0, 6)

    def test_source_that_fails_now_and_then_or_always(self, desk, rest_ohm) -> None:
        turns = iter(range(100))

        def read(t_ns: int) -> Float:
            if next(turns) % 4 == 0:
                raise OSError
            return rest_ohm

        desk.source.read = read
        result = self.result(desk)
        assert result[:3] == (2, 1, 12)
        assert result[3:] == (pytest.approx(0.0, abs=1e-12), 0, 0, 0, 0)
        desk.source.ohm = np.ones(2)
        del desk.source.read
        assert self.result(desk) == (2, 1, 0, 0.0, 0, 0, 0, 0)

    def test_reset_node_forgets_and_reset_communication_does_not(self, desk) -> None:
        result = self.result(desk)
        desk.frame(0, "82 00")
        assert [desk.read(0x2023, sub) for sub in (1, 3)] == [result[0], result[2]]
        desk.frame(0, "81 00")
        assert desk.read(0x2023, 1) == 0
