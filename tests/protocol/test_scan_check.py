"""The check over a scan: its bytes, what it finds, and the device time beside it."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinnode.protocol.chunk import pack_scan, unpack_scan_with_check
from skinnode.protocol.device_time import restore_time_us
from skinnode.protocol.eds_files import REFERENCE_PROFILES, eds_name
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan_check import check_of_codes, scan_check
from skinnode.protocol.summary import (
    SummaryFlag,
    pack_checked_summary,
    pack_summary,
    pack_summary_record,
    unpack_summary,
)

from ..scan_crc import check_of_scan, crc16

TIME_US = 0xDEAD_BEEF
WRAP_US = 1 << 22


def test_published_vector() -> None:
    """CRC-16/IBM-3740, also called CRC-16/CCITT-FALSE: catalogue of parametrised CRC algorithms, G. Cook."""
    assert crc16(b"123456789") == 0x29B1
    assert scan_check(0xFFFF, b"123456789") == 0x29B1


@pytest.mark.parametrize(
    ("bits", "covered", "check"),
    [
        # four codes; scan 7, flags 0x24, 2 chunks, device time 0xDEADBEEF >> 6 & 0xFFFF
        (16, "02 01  FC FF  CD AB  00 00  07 24 02 00 FB B6", 0x35F0),
        (24, "02 01 00  FC FF 00  CD AB 00  00 00 00  07 24 02 00 FB B6", 0x3F1D),
    ],
)
def test_what_is_covered_byte_by_byte(bits: int, covered: str, check: int) -> None:
    codes = np.array([[0x0102, 0xFFFC], [0xABCD, 0]], np.uint32)
    of_codes = check_of_codes(codes, PatchProfile(2, 2, 1, 1, bits))
    payload = pack_checked_summary(7, SummaryFlag.WIRE_FAULT, 2, TIME_US, of_codes)
    assert payload == bytes.fromhex("07 24 02 00 FB B6") + struct.pack("<H", check)
    assert check == crc16(bytes.fromhex(covered))


@pytest.mark.parametrize("profile", REFERENCE_PROFILES, ids=eds_name)
def test_both_ends_compute_the_same_check(profile: PatchProfile) -> None:
    codes = np.random.default_rng(1).integers(0, 1 << profile.code_bits, (10, 30)).astype(np.uint32)
    unpacked, check = unpack_scan_with_check(b"".join(pack_scan(codes, 9, profile)), profile)
    np.testing.assert_array_equal(unpacked, codes)
    assert check == check_of_codes(codes, profile) == check_of_scan(codes, profile.code_bits, b"")


def test_both_forms_read_back() -> None:
    new = pack_checked_summary(200, SummaryFlag.CHANGED_ONLY, 77, TIME_US, 0x1234)
    summary = unpack_summary(new)
    assert summary[:3] == (200, 0x21, 77)
    assert summary.device_time_us == TIME_US % WRAP_US // 64 * 64
    assert summary.check == crc16(new[:6], 0x1234)
    assert unpack_summary(pack_summary(200, 1, 77, TIME_US)) == (200, 1, 77, TIME_US, None)


def test_the_record_has_the_whole_device_time_beside_the_short_one() -> None:
    new = pack_checked_summary(200, 0, 77, TIME_US, 0x1234)
    record = struct.unpack("<BBHIHH", pack_summary_record(new, TIME_US))
    assert record == (200, 0x20, 77, TIME_US, TIME_US >> 6 & 0xFFFF, crc16(new[:6], 0x1234))
    old = pack_summary(200, 0, 77, TIME_US)
    assert pack_summary_record(old, TIME_US) == old


def test_numbers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="scan 256"):
        pack_checked_summary(256, 0, 0, 0, 0)


# --- what it finds


def test_every_wrong_bit_and_every_two_wrong_bits_are_found() -> None:
    """Two are not found where they turn the check alike. In the matrix, the head and the check itself."""
    turned, value = [], 1  # of the last bit, then of the one before
    for _ in range(8 * (600 + 6 + 2)):
        turned.append(value)
        value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    assert 0 not in turned
    assert len(set(turned)) == len(turned)
    largest = 8 * (4087 + 6 + 2)
    while len(turned) < largest:
        turned.append(value)
        value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    assert len(set(turned)) == largest


@pytest.mark.long
def test_every_other_value_of_one_code_is_found() -> None:
    """A burst of 16 bits at most, wherever it is."""
    for place in range(3):
        turned = {crc16(struct.pack("<H", change) + bytes(2 * place), 0) for change in range(1, 1 << 16)}
        assert 0 not in turned
        assert len(turned) == (1 << 16) - 1


@given(st.binary(min_size=20, max_size=20), st.integers(0, 144), st.integers(1, 0xFFFF))
def test_bursts_of_16_bits_are_found(data: bytes, last: int, burst: int) -> None:
    wrong = (int.from_bytes(data) ^ burst << last).to_bytes(20)
    assert scan_check(0xFFFF, wrong) != scan_check(0xFFFF, data)


@pytest.mark.long
def test_other_damage_escapes_once_in_65536() -> None:
    """Three codes of a chunk, each another than was packed: 48 wrong bits."""
    random = np.random.default_rng(3)
    wrong = [random.integers(0, 256, 6, np.uint8).tobytes() for _ in range(400_000)]
    escaped = sum(scan_check(0, each) == 0 for each in wrong)
    assert 0 < escaped < 20  # 6 expected; the seed gives the same count always


# --- device time


@given(
    true_us=st.integers(0, 1 << 40),
    off_us=st.integers(-WRAP_US // 2 + 64, WRAP_US // 2 - 64),
)
def test_time_is_restored_from_an_estimate_within_two_seconds(true_us: int, off_us: int) -> None:
    low_us = unpack_summary(pack_checked_summary(0, 0, 0, true_us, 0)).device_time_us
    assert restore_time_us(low_us, true_us + off_us) == true_us // 64 * 64
