"""Frame lengths against frames stuffed by hand, and against a bit-by-bit bus that knows no tables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.bus_load import stuffing
from skinnode.bus_load.timing import (
    BusLoad,
    exact_bits,
    exact_bits_batch,
    fd_bits,
    nominal_bits,
    worst_case_bits,
)
from skinnode.canopen.data_length import fd_length
from skinnode.errors import ConfigError

# Runs of equal bits are what stuffing is about, so bytes are drawn that make them.
BYTE = st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0xE0, 0x07, 0x83, 0x55]) | st.integers(0, 255)
DATA = st.lists(BYTE, max_size=8).map(bytes)
STANDARD = st.sampled_from([0, 1, 0x7FF, 0x185, 0x285, 0x080]) | st.integers(0, 0x7FF)


def bits_on_a_naive_bus(head: str, data: bytes) -> int:
    """Shift the frame out bit by bit, as the standard draws it."""
    frame = [int(bit) for bit in head] + [byte >> shift & 1 for byte in data for shift in range(7, -1, -1)]
    register = [0] * 15
    for bit in frame:
        feedback = bit ^ register[0]
        register = [*register[1:], 0]
        if feedback:  # x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
            register = [value ^ (14 - at in (14, 10, 8, 7, 4, 3, 0)) for at, value in enumerate(register)]
    sent: list[int] = []
    equal = 0
    for bit in frame + register:
        equal = equal + 1 if sent and sent[-1] == bit else 1
        sent.append(bit)
        if equal == 5:
            sent.append(1 - bit)
            equal = 1
    crc_delimiter, ack, ack_delimiter, end_of_frame, space = 1, 1, 1, 7, 3
    return len(sent) + crc_delimiter + ack + ack_delimiter + end_of_frame + space


def standard_head(can_id: int, dlc: int, remote: int = 0) -> str:
    return f"0{can_id:011b}{remote}00{dlc:04b}"


def test_frames_stuffed_by_hand() -> None:
    # Identifier 0, no data: 19 zeros, whose CRC is 0: 34 zeros, a stuff bit after each five: 34 + 6 + 13.
    assert exact_bits(0, b"") == 53
    # Identifier 1, no data: CRC = x^22 mod g = 0x2213. Zeros: 11 (2 stuff bits), then 7 + 1 of the CRC (1),
    # then the CRC 1000 1000 0100 11 without a run of five: 34 + 3 + 13.
    assert exact_bits(1, b"") == 50


@pytest.mark.long
@settings(deadline=None, max_examples=300)
@given(can_id=STANDARD, data=DATA)
def test_data_frames_as_on_the_naive_bus(can_id: int, data: bytes) -> None:
    expected = bits_on_a_naive_bus(standard_head(can_id, len(data)), data)
    assert exact_bits(can_id, data) == expected
    assert nominal_bits(len(data)) <= expected <= worst_case_bits(len(data))


@settings(deadline=None, max_examples=100)
@given(can_id=STANDARD, dlc=st.integers(0, 8))
def test_remote_frames_as_on_the_naive_bus(can_id: int, dlc: int) -> None:
    expected = bits_on_a_naive_bus(standard_head(can_id, dlc, remote=1), b"")
    assert exact_bits(can_id, b"", remote=True, dlc=dlc) == expected


@pytest.mark.long
@settings(deadline=None, max_examples=100)
@given(can_id=st.integers(0, (1 << 29) - 1), data=DATA)
def test_extended_frames_as_on_the_naive_bus(can_id: int, data: bytes) -> None:
    identifier = f"{can_id:029b}"
    head = f"0{identifier[:11]}11{identifier[11:]}000{len(data):04b}"
    expected = bits_on_a_naive_bus(head, data)
    assert exact_bits(can_id, data, extended=True) == expected
    assert nominal_bits(len(data), extended=True) <= expected <= worst_case_bits(len(data), extended=True)


@pytest.mark.long
@settings(deadline=None, max_examples=50)
@given(frames=st.lists(st.tuples(STANDARD, DATA), max_size=30), beyond=st.integers(0, 255))
def test_the_batch_is_the_same_frame_by_frame(frames: list[tuple[int, bytes]], beyond: int) -> None:
    payload = np.full((len(frames), 8), beyond, dtype=np.uint8)
    for row, (_, data) in zip(payload, frames, strict=True):
        row[: len(data)] = list(data)
    bits = exact_bits_batch([can_id for can_id, _ in frames], [len(data) for _, data in frames], payload)
    assert bits.tolist() == [exact_bits(can_id, data) for can_id, data in frames]


def test_an_eight_byte_frame_is_111_to_135_bits() -> None:
    assert (nominal_bits(8), worst_case_bits(8)) == (111, 135)
    assert (nominal_bits(0), worst_case_bits(0)) == (47, 55)
    assert (nominal_bits(8, extended=True), worst_case_bits(8, extended=True)) == (131, 160)


@pytest.fixture(scope="module", params=[False, True], ids=["by Python", "by kernels"])
def either_way(request: pytest.FixtureRequest) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stuffing, "are_loaded", lambda: request.param)
        yield


@pytest.mark.usefixtures("either_way")
@settings(deadline=None, max_examples=30)
@given(frames=st.lists(st.tuples(STANDARD, DATA), max_size=20))
def test_bus_load_is_the_sum_of_its_frames(frames: list[tuple[int, bytes]]) -> None:
    load = BusLoad(500_000)
    for can_id, data in frames:
        load.add(can_id, data)
    expected = sum(bits_on_a_naive_bus(standard_head(can_id, len(data)), data) for can_id, data in frames)
    assert load.frames == len(frames)
    assert load.bits == expected
    assert load.bits == expected  # reading does not change it
    assert load.load(0.25) == pytest.approx(expected / 125_000)


@pytest.mark.usefixtures("either_way")
def test_bus_load_counts_foreign_frames_and_many_of_them() -> None:
    load = BusLoad()
    for _ in range(10_000):  # more than a batch
        load.add(0, b"")
    load.add(0x1234_5678, b"\x01", extended=True)
    load.add(0x705, b"", remote=True, dlc=1)
    assert load.frames == 10_002
    extra = exact_bits(0x1234_5678, b"\x01", extended=True) + exact_bits(0x705, b"", remote=True, dlc=1)
    assert load.bits == 10_000 * 53 + extra
    assert load.load(1.0) == load.bits / 1_000_000  # the bit rate of a bus that says nothing else
    assert load.load(0.0) == load.load(-1.0) == 0.0


def test_kernels_are_not_loaded_in_passing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that receives would stand still for half a second, and answers to questions be late."""
    monkeypatch.setattr(stuffing, "are_loaded", lambda: False)
    for kernel in ("classic_bits", "classic_frame_bits"):
        monkeypatch.delattr(stuffing, kernel)
    load = BusLoad()
    for _ in range(1000):
        load.add(0, b"")
    assert load.bits == 1000 * 53


# --- CAN FD

FD_CODES = {**{n: n for n in range(9)}, 12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}
"""Bytes to length code: ISO 11898-1, table of the data length code."""
FD_DATA = st.sampled_from(sorted(FD_CODES)).flatmap(
    lambda n: st.lists(BYTE, min_size=n, max_size=n).map(bytes)
)


def fd_bits_on_a_naive_bus(can_id: int, data: bytes) -> tuple[int, int]:
    """Nominal and data bits of an FD frame sent bit by bit."""
    bits = f"0{can_id:011b}001" + "01" + f"0{FD_CODES[len(data)]:04b}" + "".join(f"{b:08b}" for b in data)
    counts, fast, equal, last = [0, 0], 0, 0, ""
    for place, bit in enumerate(bits):
        fast = int(place >= 17)  # from ESI on
        equal = equal + 1 if bit == last else 1
        last = bit
        counts[fast] += 1
        if equal == 5 and place + 1 < len(bits):  # after the last there is a fixed stuff bit anyway
            last, equal = "10"[int(bit)], 1
            counts[fast] += 1
    checked = "c" * 4 + "r" * (17 if len(data) <= 16 else 21)
    fixed = len([place for place in range(len(checked)) if place % 4 == 0])  # one before each 4
    return counts[0] + 1 + 1 + 7 + 3, counts[1] + len(checked) + fixed + 1


def fd_frames_as_on_the_naive_bus(frames: list[tuple[int, bytes]]) -> None:
    expected = [fd_bits_on_a_naive_bus(can_id, data) for can_id, data in frames]
    for (can_id, data), bits in zip(frames, expected, strict=True):
        payload = np.frombuffer(data, dtype=np.uint8).reshape(1, -1)
        assert tuple(int(part[0]) for part in fd_bits([can_id], payload)) == bits
        assert bits[0] <= 32
        assert bits[1] <= 33 + 5 * (len(data) > 16) + 10 * len(data)
    load = BusLoad(1_000_000, 5_000_000)
    for can_id, data in frames:
        load.add(can_id, data, fd=True)
    load.add(0, b"")  # a classic one among them: 53 bits
    assert load.frames == len(frames) + 1
    assert load.bits == round(53 + sum(nominal + fast / 5 for nominal, fast in expected))


@pytest.mark.parametrize("examples", [50, pytest.param(300, marks=pytest.mark.long)])
def test_fd_frames_as_on_the_naive_bus(examples: int) -> None:
    check = given(frames=st.lists(st.tuples(STANDARD, FD_DATA), min_size=1, max_size=6))(
        fd_frames_as_on_the_naive_bus
    )
    settings(deadline=None, max_examples=examples)(check)()


def test_an_fd_frame_of_one_wire_takes_about_a_sixth_of_a_millisecond() -> None:
    nominal, fast = fd_bits([0x185], np.arange(64, dtype=np.uint8).reshape(1, 64))
    assert 140 < nominal[0] + fast[0] / 5 < 168


def test_lengths_of_fd_frames() -> None:
    lengths = sorted(FD_CODES)
    for n in range(65):
        assert fd_length(n) == next(length for length in lengths if length >= n)
    with pytest.raises(ValueError, match="got 65 bytes, must be at most 64"):
        fd_length(65)
    with pytest.raises(ValueError, match="got 9 bytes"):
        fd_bits([1], np.zeros((1, 9)))
    with pytest.raises(ValueError, match=r"must be \(n,\)"):
        fd_bits([1], np.zeros((2, 8)))


def test_what_is_no_frame_is_refused() -> None:
    with pytest.raises(ValueError, match="0x800"):
        exact_bits(0x800, b"")
    with pytest.raises(ValueError, match="at most 8"):
        exact_bits(0, bytes(9))
    with pytest.raises(ValueError, match=r"must be \(n,\)"):
        exact_bits_batch([1], [8], [[0] * 7])
    with pytest.raises(ValueError, match="out of range"):
        exact_bits_batch([1], [9], [[0] * 8])
    with pytest.raises(ConfigError, match="bitrate_bps"):
        BusLoad(0)
