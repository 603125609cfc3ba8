"""Codes, baselines and wire faults of the C99 kit: exact arithmetic, and the Python node."""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.node.patch.wire_faults import find_faults
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.profile import PatchProfile

from ..c_kit import Kit

OPEN_CIRCUIT = 0xFFFF_FFFF
U32 = st.integers(0, 0xFFFF_FFFF)


@pytest.fixture(scope="module", params=[16, 24])
def kit(request: pytest.FixtureRequest) -> Iterator[Kit]:
    with Kit(PatchProfile(3, 40, 1, 1, request.param)) as running:
        yield running


@functools.cache
def scale(bits: int) -> CodeScale:
    return CodeScale(bits)


def expected(resistance: int, fraction_bits: int, baseline: float, bits: int) -> int:
    """The formula in exact fractions; Python rounds them to even."""
    steps, r0 = (1 << bits) - 4, Fraction(baseline) if np.isfinite(baseline) else Fraction(0)
    if resistance == OPEN_CIRCUIT:
        return steps + 3
    if resistance == 0:
        return steps + 2
    if r0 <= 0:
        return steps + 1
    code = round((Fraction(resistance, 1 << fraction_bits) / r0 - Fraction(1, 4)) * steps)
    return code if 0 <= code <= steps else steps + 1


def assert_codes(kit: Kit, resistances: list[int], fraction_bits: int, baselines: list[float]) -> None:
    bits = kit.profile.code_bits
    got = kit.encode(resistances, fraction_bits, baselines)
    ohm = [np.inf if r == OPEN_CIRCUIT else r / (1 << fraction_bits) for r in resistances]
    np.testing.assert_array_equal(got, encode(ohm, baselines, scale(bits)))
    truth = [expected(r, fraction_bits, b, bits) for r, b in zip(resistances, baselines, strict=True)]
    np.testing.assert_array_equal(got, truth)


def any_resistance_and_any_real32_pattern(
    kit: Kit, pairs: list[tuple[int, float]], fraction_bits: int
) -> None:
    assert_codes(kit, [r for r, _ in pairs], fraction_bits, [b for _, b in pairs])


@pytest.mark.parametrize("examples", [60, pytest.param(400, marks=pytest.mark.long)])
def test_any_resistance_and_any_real32_pattern(kit: Kit, examples: int) -> None:
    check = given(
        pairs=st.lists(
            st.tuples(U32, st.one_of(st.floats(width=32), st.floats(0.5, 1e6, width=32))),
            min_size=1,
            max_size=20,
        ),
        fraction_bits=st.integers(0, 31),
    )(any_resistance_and_any_real32_pattern)
    settings(deadline=None, max_examples=examples)(check)(kit=kit)


def test_resistances_around_a_baseline(kit: Kit) -> None:
    random = np.random.default_rng(1)
    baselines = random.uniform(1e2, 1e5, 5000).astype(np.float32)
    resistances = (baselines * random.uniform(0.2, 1.3, 5000) * 2**8).astype(np.int64)
    assert_codes(kit, resistances.tolist(), 8, baselines.tolist())


def test_reserved_codes(kit: Kit) -> None:
    baselines = [1e4, 0.0, -0.0, -1e4, np.inf, -np.inf, np.nan, 1e-40, 3e38]
    for resistance in (0, 1, 10_000 << 8, OPEN_CIRCUIT - 1, OPEN_CIRCUIT):
        assert_codes(kit, [resistance] * len(baselines), 8, baselines)


def test_ties_go_to_the_even_code(kit: Kit) -> None:
    """R/R0 exactly between two codes, which double precision misses every other time."""
    steps = (1 << kit.profile.code_bits) - 4
    ties = np.arange(-1, steps + 1, 13 if kit.profile.code_bits == 16 else 4099)
    r0, resistances = 4 * steps, steps + 2 * (2 * ties + 1)  # r0 is exact in REAL32
    for resistance in resistances.tolist():
        kit.add("q", "II", resistance, r0)
    got = kit.ask().words()
    even = ties + ties % 2
    even[0] = 0  # half a step below code 0
    np.testing.assert_array_equal(got, even)
    np.testing.assert_array_equal(got, encode(resistances, r0, scale(kit.profile.code_bits)))


@settings(deadline=None)
@given(resistance=U32, baseline=U32)
def test_a_ratio_of_any_two_numbers(kit: Kit, resistance: int, baseline: int) -> None:
    kit.add("q", "II", resistance, baseline)
    assert kit.ask().words().tolist() == [expected_ratio(resistance, baseline, kit.profile.code_bits)]


def expected_ratio(resistance: int, baseline: int, bits: int) -> int:
    """As :func:`expected`, with a baseline that REAL32 need not hold."""
    steps = (1 << bits) - 4
    if resistance in (0, OPEN_CIRCUIT) or not baseline:
        return expected(resistance, 0, 0.0, bits)
    code = round((Fraction(resistance, baseline) - Fraction(1, 4)) * steps)
    return code if 0 <= code <= steps else steps + 1


@pytest.mark.long
@settings(deadline=None, max_examples=400)
@given(value=st.integers(0, (1 << 64) - 1) | st.integers(0, 1 << 26), fraction_bits=st.integers(0, 63))
def test_baselines_are_rounded_to_real32_as_numpy_does(kit: Kit, value: int, fraction_bits: int) -> None:
    kit.add("f", "QB", value, fraction_bits)
    exact = np.ldexp(np.longdouble(np.uint64(value)), -fraction_bits)  # 64 bits of mantissa
    (pattern,) = struct.unpack("<I", struct.pack("<f", np.float32(exact)))
    assert kit.ask().words().tolist() == [pattern]


@settings(deadline=None)
@given(reference=U32, reading=U32 | st.integers(0, 4096), full=U32 | st.just(4095))
def test_a_divider(kit: Kit, reference: int, reading: int, full: int) -> None:
    kit.add("d", "III", reference, reading, full)
    (got,) = kit.ask().words().tolist()
    if not reading:
        assert got == OPEN_CIRCUIT
    elif reading >= full:
        assert got == 0
    else:
        exact = Fraction(reference * (full - reading), reading)
        assert got == OPEN_CIRCUIT - 1 if exact > OPEN_CIRCUIT - 1 else abs(got - exact) <= Fraction(1, 2)


@settings(deadline=None)
@given(data=st.data())
def test_wire_faults_in_the_words_of_the_objects(kit: Kit, data: st.DataObject) -> None:
    profile, of = kit.profile, scale(kit.profile.code_bits)
    codes = np.full((profile.rows, profile.columns), 7, np.uint32)
    bad = st.sampled_from([of.open, of.short, of.over_range])
    for row in data.draw(st.sets(st.integers(0, profile.rows - 1))):
        codes[row] = data.draw(bad)
    for column in data.draw(st.sets(st.integers(0, profile.columns - 1), max_size=5)):
        codes[:, column] = data.draw(bad)
    kit.add("w")
    kit._commands += codes.astype("<u4").tobytes()
    reply = kit.ask()
    faults = find_faults(codes, of)
    assert reply.take("B") == (faults.any,)
    assert reply.bytes(4 * (2 + 4)) == b"".join(
        np.packbits(mask, bitorder="little").tobytes().ljust(4 * words, b"\0")[4 * at : 4 * at + 4]
        for masks, words in ((faults.masks[:2], 1), (faults.masks[2:], 2))
        for at in range(words)
        for mask in masks
    )
