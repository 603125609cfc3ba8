"""Scan check: a CRC over all codes of a scan and the first bytes of the scan's summary."""

from __future__ import annotations

import binascii
from typing import Final

import numpy as np

from skinnode.protocol.codes import Codes
from skinnode.protocol.profile import PatchProfile

CRC_INITIAL: Final = 0xFFFF
"""Initial value of the CRC."""


def check_of_codes(codes: Codes, profile: PatchProfile) -> int:
    """Return the CRC over the codes only; :func:`scan_check` adds the summary.

    Args:
        codes: (U, K) codes after the scan, including those of unsent chunks.
        profile: sizes of the patch.
    """
    if profile.code_bits == 16:
        return binascii.crc_hqx(codes.astype("<u2").tobytes(), CRC_INITIAL)
    octets = codes.astype("<u4").view(np.uint8).reshape(*codes.shape, 4)
    return binascii.crc_hqx(octets[:, :, :3].tobytes(), CRC_INITIAL)


def scan_check(check_of_codes: int, head: bytes) -> int:
    """Return the scan check: a CRC over all codes of a scan and the first bytes of the scan's summary.

    The algorithm is CRC-16/IBM-3740: polynomial x¹⁶ + x¹² + x⁵ + 1 (0x1021), initial value 0xFFFF, most
    significant bit first, not inverted. The CRC of the ASCII digits ``123456789`` is 0x29B1. The CRC covers,
    in this order:

    1. All U·K codes, ordered by upper wire. Each code is little-endian and has 2 bytes (16-bit codes) or 3
       bytes (24-bit codes). For a chunk that is not sent in this scan, the CRC covers the codes that were
       last sent, which may differ from the newest codes by up to the delta threshold.
    2. The argument ``head``, the first 6 bytes of the summary: scan counter, flags, number of chunks sent,
       device time. Because the CRC covers the scan counter and the device time, codes of a different scan
       fail the check.

    The check detects every burst error of up to 16 bits, such as one wrong 16-bit code, and every odd number
    of wrong bits. In up to 4,087 bytes of codes, the check also detects any two wrong bits. One in 65,536 of
    all other errors remains undetected.

    Args:
        check_of_codes: result of :func:`check_of_codes`.
        head: the first 6 bytes of the summary.
    """
    return binascii.crc_hqx(head, check_of_codes)
