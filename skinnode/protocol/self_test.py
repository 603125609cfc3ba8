"""Result of a patch's self-test (object 0x2023)."""

from __future__ import annotations

import enum
import struct
from typing import Final, NamedTuple


class SelfTestStatus(enum.IntEnum):
    """Verdict of a self-test (0x2023:1)."""

    NEVER_RUN = 0
    PASSED = 1
    FAILED = 2


class SelfTestFault(enum.IntFlag):
    """Faults found by a self-test (0x2023:2), as flags."""

    SOURCE = 0x01
    """The converter failed to return a valid reading at least once."""
    NOISE = 0x02
    OPEN_WIRE = 0x04
    SHORTED_WIRE = 0x08
    OUT_OF_RANGE = 0x10
    """At least one crossing with a baseline is open, shorted or out of range and therefore yielded no
    measurement."""
    NO_BASELINE = 0x20


class SelfTest(NamedTuple):
    """Findings of a self-test, in the order of sub-indices 2 and above of 0x2023."""

    faults: SelfTestFault
    readings: int
    noise: float
    """Relative noise of the readings: RMS of the relative standard deviations of all crossings."""
    open_wires: int
    shorted_wires: int
    out_of_range: int
    untared: int


_SELF_TEST: Final = struct.Struct("<BHBfHHII")
SELF_TEST_NEVER_RUN: Final = bytes(_SELF_TEST.size)
"""Content of record 0x2023 before the first self-test."""


def pack_self_test(test: SelfTest) -> bytes:
    """Pack the findings of a self-test into the content of record 0x2023.

    Args:
        test: findings of the self-test. The self-test has passed if the findings contain no faults.
    """
    return _SELF_TEST.pack(SelfTestStatus.FAILED if test.faults else SelfTestStatus.PASSED, *test)
