"""Scan check: a CRC over all codes of a scan and the first bytes of its summary."""

from __future__ import annotations

import binascii
from typing import Final

import numpy as np

from skinnode.protocol.codes import Codes
from skinnode.protocol.profile import PatchProfile

CRC_INITIAL: Final = 0xFFFF
"""Initial value of the CRC."""


def check_of_codes(codes: Codes, profile: PatchProfile) -> int:
    """Return the CRC over the codes of a scan; :func:`scan_check` extends it over the summary.

    Args:
        codes: (U, K) codes of all chunks, including those not sent in this scan.
        profile: Dimensions of the patch.
    """
    if profile.code_bits == 16:
        return binascii.crc_hqx(codes.astype("<u2").tobytes(), CRC_INITIAL)
    octets = codes.astype("<u4").view(np.uint8).reshape(*codes.shape, 4)
    return binascii.crc_hqx(octets[:, :, :3].tobytes(), CRC_INITIAL)


def scan_check(check_of_codes: int, head: bytes) -> int:
    """Return the scan check: a CRC over all codes of a scan and the first bytes of its summary.

    The algorithm is CRC-16/IBM-3740: polynomial x¹⁶ + x¹² + x⁵ + 1 (0x1021), initial value 0xFFFF, most
    significant bit first, not inverted. The CRC of the ASCII digits ``123456789`` is 0x29B1. The CRC covers,
    in order:

    1. All U·K codes, ordered by upper wire. Each code is little-endian, with 2 bytes for 16-bit codes and 3
       bytes for 24-bit codes. For an unsent chunk, these are the codes that were last sent, which can differ
       from the measured codes by up to the send threshold.
    2. The first 6 bytes of the summary: scan counter, flags, number of chunks sent, and device time. Codes of
       another scan fail the check, because their scan counter or device time differs.

    The check detects every error burst of up to 16 bits, such as a single wrong 16-bit code, and every odd
    number of bit errors. With up to 4,087 bytes of codes, it also detects every double bit error. One in
    65,536 of all other errors goes undetected.

    Args:
        check_of_codes: Result of :func:`check_of_codes`.
        head: The first 6 bytes of the summary.
    """
    return binascii.crc_hqx(head, check_of_codes)
