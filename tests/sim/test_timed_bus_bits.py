"""Lengths and bits of frames against frames that are drawn bit by bit from the standard."""

from __future__ import annotations

import random

import pytest

from skinnode.bus_load.timing import exact_fd_bits
from tests.lanes import some_long
from vcan_sim.timed_bus import CanFrame
from vcan_sim.timed_bus.frame import frame_bits
from vcan_sim.timed_bus.wire_frame import wire_frame

from .naive_can import FD_CODES, draw

FRAMES = 10_000
RUNS = bytes((0x00, 0xFF, 0x0F, 0xF0, 0xE0, 0x07, 0x83, 0x3E, 0xC1, 0x1F, 0xF8))
KINDS = [
    (fd, extended, remote) for fd in (False, True) for extended in (False, True) for remote in (False, True)
]


def random_frame(rng: random.Random, fd: bool, extended: bool, remote: bool) -> CanFrame:
    width = 29 if extended else 11
    can_id = rng.getrandbits(width)
    if rng.random() < 0.3:  # runs of equal bits in the identifier
        can_id = ((1 << width) - 1 if rng.random() < 0.5 else 0) ^ 1 << rng.randrange(width)
    if remote:
        return CanFrame(can_id, b"", extended, remote=True, dlc=rng.randrange(9))
    length = rng.choice(list(FD_CODES)) if fd else rng.randrange(9)
    data = rng.randbytes(length) if rng.random() < 0.5 else bytes(rng.choices(RUNS, k=length))
    return CanFrame(can_id, data, extended, fd=fd, brs=fd and rng.random() < 0.7)


@pytest.mark.long
@pytest.mark.parametrize(
    ("fd", "extended", "remote"),
    some_long(
        [kind for kind in KINDS if not (kind[0] and kind[2])], (False, False, False), (True, True, False)
    ),
)
def test_lengths_are_exact(fd: bool, extended: bool, remote: bool) -> None:
    rng = random.Random(f"{fd} {extended} {remote}")
    for number in range(FRAMES):
        frame, esi = random_frame(rng, fd, extended, remote), fd and rng.random() < 0.5
        drawn = draw(frame, esi)
        assert frame_bits(frame, esi) == drawn.counts, frame
        if number % 10:
            continue
        wire = wire_frame(frame, esi)
        assert "".join(map(str, wire.bits)) == drawn.bits, frame
        assert [place in wire.data_phase for place in range(len(wire.bits))] == drawn.at_data_rate
        assert (wire.stuffed_end, list(wire.fixed_stuff)) == (drawn.stuffed, drawn.fixed)
        place = rng.randrange(len(wire.bits))
        fast = sum(drawn.at_data_rate[: place + 1])
        assert wire.bits_through(place) == (place + 1 - fast, fast)


def test_crc_of_the_bits_and_the_crc_is_zero() -> None:
    """As a receiver checks it, with the polynomials written as in the standard."""
    drawn = draw(CanFrame(0x123, b"\x01\x02\x03"))
    plain = "".join(
        bit
        for place, bit in enumerate(drawn.bits[: drawn.stuffed])
        if not (place >= 5 and len(set(drawn.bits[place - 5 : place])) == 1)
    )
    value = int(plain, 2)
    for shift in range(len(plain) - 16, -1, -1):  # long division by x^15 + ... = 0xC599
        if value >> (shift + 15) & 1:
            value ^= 0xC599 << shift
    assert value == 0


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"can_id": 0x800}, "can_id: got 0x800, must fit 11 bits"),
        ({"can_id": 1 << 29, "extended": True}, "can_id: got 0x20000000, must fit 29 bits"),
        ({"can_id": 1, "data": bytes(9)}, "data: got 9 bytes, must be at most 8"),
        ({"can_id": 1, "data": bytes(9), "fd": True}, r"data: got 9 bytes, must be one of \(0, 1"),
        ({"can_id": 1, "data": b"x", "remote": True}, "data: got 1 byte in a remote frame, must be none"),
        ({"can_id": 1, "remote": True, "dlc": 9}, "dlc: got 9, must be 0 to 8"),
        ({"can_id": 1, "remote": True, "fd": True}, "remote: got a remote CAN FD frame"),
        ({"can_id": 1, "brs": True}, "brs: got a classic frame"),
    ],
)
def test_what_is_no_frame(arguments: dict[str, object], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        CanFrame(**arguments)  # type: ignore[arg-type]


def test_what_is_no_fd_frame() -> None:
    with pytest.raises(ValueError, match="can_id: got 0x800, must fit 11 bits"):
        exact_fd_bits(0x800, b"")
    with pytest.raises(ValueError, match="data: got 65 bytes"):
        exact_fd_bits(0, bytes(65))
