"""Result of a self-test, the record 0x2023."""

from __future__ import annotations

import enum
import struct
from typing import Final, NamedTuple


class SelfTestStatus(enum.IntEnum):
    """Verdict of the self-test, 0x2023:1."""

    NEVER_RUN = 0
    PASSED = 1
    FAILED = 2


class SelfTestFault(enum.IntFlag):
    """Faults found by a self-test, 0x2023:2."""

    SOURCE = 0x01
    """At least once, the converter returned no valid reading."""
    NOISE = 0x02
    OPEN_WIRE = 0x04
    SHORTED_WIRE = 0x08
    OUT_OF_RANGE = 0x10
    """Crossings with a baseline gave no measurement, because they are open, shorted or outside lo … hi."""
    NO_BASELINE = 0x20


class SelfTest(NamedTuple):
    """Findings of a self-test, in the order of 0x2023 from sub-index 2."""

    faults: SelfTestFault
    readings: int
    noise: float
    """RMS of the relative standard deviations of all crossings."""
    open_wires: int
    shorted_wires: int
    out_of_range: int
    untared: int


_SELF_TEST: Final = struct.Struct("<BHBfHHII")
SELF_TEST_NEVER_RUN: Final = bytes(_SELF_TEST.size)
"""Value of the record before the first self-test."""


def pack_self_test(test: SelfTest) -> bytes:
    """Pack the sub-objects of the record 0x2023.

    Args:
        test: the findings; the test has passed if there are no faults.
    """
    return _SELF_TEST.pack(SelfTestStatus.FAILED if test.faults else SelfTestStatus.PASSED, *test)
