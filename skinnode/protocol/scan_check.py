"""Scan check, a CRC over the codes that the receiver must hold and over the summary."""

from __future__ import annotations

import binascii
from typing import Final

import numpy as np

from skinnode.protocol.codes import Codes
from skinnode.protocol.profile import PatchProfile

CRC_INITIAL: Final = 0xFFFF
"""Initial value of the CRC."""


def check_of_codes(codes: Codes, profile: PatchProfile) -> int:
    """Return the CRC over the codes alone, from which :func:`scan_check` continues.

    Args:
        codes: (U, K) codes that the receiver must hold.
        profile: sizes of the patch.
    """
    if profile.code_bits == 16:
        return binascii.crc_hqx(codes.astype("<u2").tobytes(), CRC_INITIAL)
    octets = codes.astype("<u4").view(np.uint8).reshape(*codes.shape, 4)
    return binascii.crc_hqx(octets[:, :, :3].tobytes(), CRC_INITIAL)


def scan_check(check_of_codes: int, head: bytes) -> int:
    """Return the scan check, a CRC over the codes that the receiver must hold and over the summary.

    CRC-16/IBM-3740: polynomial x¹⁶ + x¹² + x⁵ + 1 (0x1021), initial value 0xFFFF, most significant bit first,
    not inverted; check value 0x29B1 for the ASCII digits ``123456789``. The CRC covers, in this order:

    1. All U·K codes, one upper wire after another, little-endian: 2 bytes each, or 3 for 24-bit codes.
       These are the codes that a receiver holds after this scan. If only changed chunks are sent, they are
       the codes last sent in every chunk, which may differ from the newest reading by up to the delta
       threshold.
    2. ``head``, the first 6 bytes of the summary: scan counter, flags, chunks sent, device time. The matrix
       of a different scan therefore fails the check.

    The check always detects changes within a span of 16 bits, such as a change of one 16-bit code, and any
    odd number of wrong bits. In matrices of up to 4,087 bytes it also detects any two wrong bits. Of all
    other errors, the check misses one in 65,536.

    Args:
        check_of_codes: result of :func:`check_of_codes`.
        head: the first 6 bytes of the summary.
    """
    return binascii.crc_hqx(head, check_of_codes)
