"""Codes against exact arithmetic, payloads against bytes written out by hand and against struct."""

from __future__ import annotations

import struct
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.errors import CodecError, ConfigError
from skinnode.protocol.chunk import (
    chunk_indexer,
    chunk_of_code,
    pack_chunk,
    pack_scan,
    unpack_chunk,
    unpack_scan,
)
from skinnode.protocol.codes import MISSING, CodeScale, decode, encode
from skinnode.protocol.command import SendMode, pack_command, unpack_command
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.summary import SummaryFlag, pack_summary, unpack_summary

BITS = st.sampled_from([16, 24])
HALF = 0.5 + 1e-6  # a millionth of a code for double precision


@st.composite
def scales(draw: st.DrawFn) -> CodeScale:
    lo = draw(st.floats(0.0, 0.875, width=32))
    return CodeScale(draw(BITS), lo, draw(st.floats(1.0, 4.0, width=32)))


@settings(deadline=None)
@given(scale=scales(), share=st.floats(0.0, 1.0), baseline=st.floats(1e-2, 1e9))
def test_a_resistance_in_range_comes_back_within_half_a_code(
    scale: CodeScale, share: float, baseline: float
) -> None:
    known = float(np.float32(baseline))  # what the object dictionary keeps of R0
    resistance = (scale.lo + share * (scale.hi - scale.lo)) * known
    if resistance <= 0:
        return
    codes = encode(resistance, baseline, scale)
    back, valid = decode(codes, baseline, scale)
    assert valid
    step_ohm = float((Fraction(scale.hi) - Fraction(scale.lo)) / ((1 << scale.bits) - 4)) * known
    assert abs(back - resistance) <= HALF * step_ohm


@settings(deadline=None)
@given(scale=scales(), baseline=st.floats(1e-2, 1e9), data=st.data())
def test_the_code_is_the_one_of_the_formula(scale: CodeScale, baseline: float, data: st.DataObject) -> None:
    steps = (1 << scale.bits) - 4
    code = data.draw(st.integers(1, steps))
    lo, hi, known = Fraction(scale.lo), Fraction(scale.hi), Fraction(float(np.float32(baseline)))
    off = Fraction(data.draw(st.floats(-0.49, 0.49)))
    resistance = float((lo + (code + off) / steps * (hi - lo)) * known)
    assert encode(resistance, baseline, scale) == code


@pytest.mark.long
@settings(deadline=None, max_examples=300)
@given(
    scale=st.just(CodeScale(16)) | st.just(CodeScale(24)) | scales(),
    baseline=st.integers(1, 1 << 24) | st.floats(1e-2, 1e9),
    nudge=st.sampled_from([0, 0, 1, -1, 5, -5]),
    data=st.data(),
)
def test_between_two_codes_the_exact_value_decides(
    scale: CodeScale, baseline: float, nudge: int, data: st.DataObject
) -> None:
    """Half a code from both, or by a few units in the last place of the resistance more or less."""
    steps, known = (1 << scale.bits) - 4, Fraction(float(np.float32(baseline)))
    lo, per_ratio = Fraction(scale.lo), steps / (Fraction(scale.hi) - Fraction(scale.lo))
    tie = data.draw(st.integers(0, steps)) - Fraction(1, 2)
    resistance = float((lo + tie / per_ratio) * known)
    resistance += nudge * np.spacing(resistance)
    if resistance > 0:
        code = round((Fraction(resistance) / known - lo) * per_ratio)
        assert encode(resistance, baseline, scale) == (code if 0 <= code <= steps else scale.over_range)


def test_a_tie_that_double_precision_misses_goes_to_the_even_code() -> None:
    """R/R0 = 1/4 + (2 k + 1) / (2 steps); nearly half of these are rounded to the odd code otherwise."""
    steps, k = 65532, np.arange(0, 65532, 7)
    resistance = steps + 2 * (2 * k + 1)
    np.testing.assert_array_equal(encode(resistance, 4 * steps, CodeScale(16)), k + k % 2)


@pytest.mark.parametrize(("bits", "stride"), [(16, 1), (24, 257)])
def test_every_measurement_survives_decoding_and_encoding(bits: int, stride: int) -> None:
    scale = CodeScale(bits)
    codes = np.append(np.arange(0, (1 << bits) - 3, stride), (1 << bits) - 4)
    resistance, valid = decode(codes, 12_345.678, scale)
    assert valid.all()
    np.testing.assert_array_equal(encode(resistance, 12_345.678, scale), codes)


@pytest.mark.parametrize("bits", [16, 24])
@pytest.mark.parametrize(
    ("resistance", "baseline", "below_top"),
    [
        (np.inf, 1e4, 0),
        (np.nan, 1e4, 0),
        (np.inf, 0.0, 0),
        (0.0, 1e4, 1),
        (-3.0, 1e4, 1),
        (-np.inf, 1e4, 1),
        (1.26e4, 1e4, 2),
        (0.24e4, 1e4, 2),
        (1e300, 1e4, 2),
        (1e4, 0.0, 2),
        (1e4, np.nan, 2),
        (1e4, np.inf, 2),
        (1e4, -1e4, 2),
    ],
)
def test_what_is_no_measurement_gets_its_reserved_code_and_never_a_value(
    bits: int, resistance: float, baseline: float, below_top: int
) -> None:
    scale = CodeScale(bits)
    code = encode(resistance, baseline, scale)
    top = (1 << bits) - 1
    assert code == top - below_top
    assert code == (scale.open, scale.short, scale.over_range)[below_top]
    back, valid = decode(code, 1e4, scale)
    assert np.isnan(back)
    assert not valid


def test_zero_is_a_short_even_where_the_range_begins_at_zero() -> None:
    scale = CodeScale(16, 0.0, 2.0)
    assert encode(0.0, 1e4, scale) == scale.short
    assert encode(1e4, np.inf, scale) == scale.over_range
    assert encode(1e-6, -0.5, scale) == scale.over_range  # rounds to the code 0, but R0 is no baseline


@pytest.mark.parametrize("bits", [16, 24])
def test_the_highest_measurement_is_just_below_the_reserved_codes(bits: int) -> None:
    scale = CodeScale(bits)
    assert encode(1.25e4, 1e4, scale) == (1 << bits) - 4
    assert encode(0.25e4, 1e4, scale) == 0


def test_what_was_not_received_does_not_decode() -> None:
    for bits in (16, 24):
        resistance, valid = decode(np.array([MISSING, 100]), 1e4, CodeScale(bits))
        assert np.isnan(resistance[0])
        assert valid.tolist() == [False, True]


def test_without_a_baseline_nothing_decodes() -> None:
    resistance, valid = decode(np.full(4, 100), [0.0, np.nan, np.inf, -1.0], CodeScale())
    assert np.isnan(resistance).all()
    assert not valid.any()


def test_rounding_error_has_the_deviation_the_scale_states() -> None:
    scale, rng = CodeScale(), np.random.default_rng(3)
    resistance = rng.uniform(0.3, 1.2, 200_000) * 1e4
    error = decode(encode(resistance, 1e4, scale), 1e4, scale)[0] / 1e4 - resistance / 1e4
    assert error.std() == pytest.approx(scale.relative_std, rel=0.01)  # 6 standard errors
    assert scale.relative_std == pytest.approx(4.405e-6, rel=1e-3)


@pytest.mark.parametrize(
    "arguments",
    [(12, 0.25, 1.25), (16, 1.25, 0.25), (16, -0.1, 1.0), (16, 0.5, np.inf), (16, np.nan, 1.0)],
)
def test_a_scale_that_cannot_be_is_refused(arguments: tuple[int, float, float]) -> None:
    with pytest.raises(ConfigError, match="allowed"):
        CodeScale(*arguments)


# --- payloads


def test_payloads_are_these_bytes() -> None:
    assert pack_chunk(5, 7, [1, 0x0203, 0xFFFF]).hex(" ") == "05 07 01 00 03 02 ff ff"
    assert pack_chunk(255, 240, [0x010203, 0xFFFFFE], 24).hex(" ") == "ff f0 03 02 01 fe ff ff"
    assert pack_chunk(99, 1, [0x1234]).hex(" ") == "63 01 34 12 00 00 00 00"
    flags = SummaryFlag.CHANGED_ONLY | SummaryFlag.OVERRUN
    assert pack_summary(7, flags, 100, 0x12345678).hex(" ") == "07 03 64 00 78 56 34 12"
    assert pack_summary(7, 0, 0, 2**32 + 5).hex(" ") == "07 00 00 00 05 00 00 00"
    assert pack_command(tare=True, single_scan=True, send_mode=SendMode.CHANGED) == b"tare\x01\x01"
    assert pack_command() == bytes(6)


def test_payloads_read_back() -> None:
    assert unpack_chunk(bytes.fromhex("0507010003 02ffff")) == (5, 7, (1, 0x0203, 0xFFFF))
    assert unpack_chunk(bytes.fromhex("fff0030201feffff"), 24) == (255, 240, (0x010203, 0xFFFFFE))
    assert unpack_summary(bytes.fromhex("0703640078563412")) == (7, 3, 100, 0x12345678, None)
    assert unpack_command(b"tare\x01\x01") == (int.from_bytes(b"tare", "little"), 1, 1)
    assert unpack_command(b"tare\x01\x01\x99\x99") == unpack_command(b"tare\x01\x01")


@settings(deadline=None, max_examples=60)
@given(
    rows=st.integers(1, 9), columns=st.integers(1, 28), bits=BITS, scan=st.integers(0, 255), data=st.data()
)
def test_a_scan_is_packed_in_row_major_order_and_reads_back(
    rows: int, columns: int, bits: int, scan: int, data: st.DataObject
) -> None:
    profile = PatchProfile(rows, columns, 1, 1, bits)
    seed = data.draw(st.integers(0, 2**32 - 1))
    codes = np.random.default_rng(seed).integers(0, 1 << bits, (rows, columns))
    frames = pack_scan(codes, scan, profile)
    flat = codes.ravel().tolist()
    for index, frame in enumerate(frames):
        if bits == 16:
            part = [*flat[3 * index : 3 * index + 3], 0, 0][:3]
            expected = struct.pack("<BBHHH", index, scan, *part)
        else:
            part = [*flat[2 * index : 2 * index + 2], 0][:2]
            expected = bytes([index, scan]) + b"".join(struct.pack("<I", code)[:3] for code in part)
        assert frame == expected
    assert len(frames) == profile.n_chunks
    np.testing.assert_array_equal(unpack_scan(b"".join(frames), profile), codes)


@pytest.mark.parametrize(
    ("columns", "bits", "starts", "length"),
    [
        (1, 16, [0], 6),
        (2, 16, [0], 8),
        (4, 24, [0], 16),
        (30, 16, [0], 64),
        (20, 24, [0], 64),
        (30, 24, [0, 15], 64),  # 4 + 45 bytes
        (31, 16, [0, 16], 48),  # 4 + 32 bytes
        (254, 16, [29 * n for n in range(9)], 64),
        (254, 24, [20 * n for n in range(13)], 64),
    ],
)
def test_over_can_fd_a_frame_is_a_part_of_one_wire(
    columns: int, bits: int, starts: list[int], length: int
) -> None:
    profile = PatchProfile(3, columns, 1, 1, bits, bus="fd")
    codes = np.random.default_rng(columns).integers(0, 1 << bits, (3, columns))
    frames = pack_scan(codes, 200, profile)
    ends = [*starts[1:], columns]
    expected = [
        struct.pack("<BBH", wire, 200, start)
        + b"".join(struct.pack("<I", code)[: bits // 8] for code in codes[wire, start:end].tolist())
        for wire in range(3)
        for start, end in zip(starts, ends, strict=True)
    ]
    assert frames == [frame.ljust(length, b"\0") for frame in expected]
    assert profile.chunk_bytes == length
    np.testing.assert_array_equal(unpack_scan(b"".join(frames), profile), codes)
    indexed = [chunk_indexer(profile)(frame) for frame in frames]
    assert indexed == list(range(profile.n_chunks))
    for chunk, (frame, wire_start) in enumerate(
        zip(frames, [(wire, start) for wire in range(3) for start in starts], strict=True)
    ):
        assert (frame[0], int.from_bytes(frame[2:4], "little")) == wire_start
        assert chunk_of_code(profile)[wire_start] == chunk


@pytest.mark.parametrize(
    ("wire", "column"), [(0, 256), (2, 512), (0, 0x8000), (0, 30), (1, 58), (0, 87), (3, 0)]
)
def test_over_can_fd_a_frame_of_no_chunk_has_the_number_after_the_last(wire: int, column: int) -> None:
    """The first column is beyond the wire (also where its low byte is that of a chunk) or inside a chunk, or
    the wire does not exist."""
    profile = PatchProfile(3, 58, 1, 1, 16, bus="fd")
    index = chunk_indexer(profile)
    assert [index(struct.pack("<BBH", *at).ljust(64)) for at in ((0, 9, 29), (2, 9, 0))] == [1, 4]
    assert index(struct.pack("<BBH", wire, 9, column).ljust(64)) == profile.n_chunks


@pytest.mark.parametrize("length", [0, 1, 7, 9, 64])
def test_a_payload_of_the_wrong_length_is_refused_in_one_line(length: int) -> None:
    data = bytes(length)
    for unpack in (unpack_chunk, unpack_summary):
        with pytest.raises(CodecError) as caught:
            unpack(data, cob_id=0x185)
        assert caught.value.cob_id == 0x185
        assert caught.value.data == data
        unit = "byte" if length == 1 else "bytes"
        assert str(caught.value).startswith(f"COB-ID 0x185: got {length} {unit} (")
        assert "allowed: 8 bytes" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_short_command_is_refused() -> None:
    with pytest.raises(CodecError, match="allowed: at least 6 bytes"):
        unpack_command(b"tare\x01", cob_id=0x205)


def test_numbers_that_do_not_fit_are_refused() -> None:
    profile = PatchProfile(1, 3, 1, 1)
    with pytest.raises(ValueError, match="must be from 0 to 65535"):
        pack_chunk(0, 0, [65536])
    with pytest.raises(ValueError, match="at most 3"):
        pack_chunk(0, 0, [1, 2, 3, 4])
    with pytest.raises(ValueError, match="must be from 0 to 255"):
        pack_chunk(256, 0, [1])
    with pytest.raises(ValueError, match="scan 256"):
        pack_summary(256, 0, 0, 0)
    with pytest.raises(ValueError, match="below 65536"):
        pack_scan([[1, 2, 65536]], 0, profile)
    with pytest.raises(ValueError, match=r"must be \(1, 3\)"):
        pack_scan([1, 2, 3], 0, profile)
