"""The check of a scan: a CRC over the codes that its receiver must hold, and over its summary."""

from __future__ import annotations

import binascii
from typing import Final

import numpy as np

from skinnode.protocol.codes import Codes
from skinnode.protocol.profile import PatchProfile

CRC_INITIAL: Final = 0xFFFF
"""Initial value of the CRC."""


def check_of_codes(codes: Codes, profile: PatchProfile) -> int:
    """Return the CRC over the codes alone, which :func:`scan_check` continues.

    Args:
        codes: (U, K) codes that the receiver must hold.
        profile: sizes of the patch.
    """
    if profile.code_bits == 16:
        return binascii.crc_hqx(codes.astype("<u2").tobytes(), CRC_INITIAL)
    octets = codes.astype("<u4").view(np.uint8).reshape(*codes.shape, 4)
    return binascii.crc_hqx(octets[:, :, :3].tobytes(), CRC_INITIAL)


def scan_check(check_of_codes: int, head: bytes) -> int:
    """Return the check of a scan: a CRC over the codes that its receiver must hold, and over its summary.

    CRC-16/IBM-3740: polynomial x¹⁶ + x¹² + x⁵ + 1 (0x1021), initial value 0xFFFF, most significant bit first,
    not inverted; check value 0x29B1 for the ASCII digits ``123456789``. It covers, in this order:

    1. All U·K codes, upper wire by upper wire, little-endian: 2 bytes each, or 3 for 24-bit codes.
       These are the codes that a receiver holds after this scan: if only changed chunks are sent, the last
       codes sent of every chunk, which may differ from the newest reading by the delta threshold.
    2. ``head``, the first 6 bytes of the summary: scan counter, flags, chunks sent, device time. A matrix of
       another scan therefore fails.

    The check always detects a change within 16 bits, such as a change of one 16-bit code; any odd number of
    wrong bits; and two wrong bits, in matrices of up to 4,087 bytes. It misses one case in 65,536 of all
    other damage.

    Args:
        check_of_codes: what :func:`check_of_codes` returns.
        head: the first 6 bytes of the summary.
    """
    return binascii.crc_hqx(head, check_of_codes)
