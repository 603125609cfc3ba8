"""Result of a patch's self-test (object 0x2023)."""

from __future__ import annotations

import enum
import struct
from typing import Final, NamedTuple


class SelfTestStatus(enum.IntEnum):
    """Result of a self-test (0x2023:1)."""

    NEVER_RUN = 0
    PASSED = 1
    FAILED = 2


class SelfTestFault(enum.IntFlag):
    """Faults found by a self-test (0x2023:2), as flags."""

    SOURCE = 0x01
    """The converter returned no valid reading at least once."""
    NOISE = 0x02
    OPEN_WIRE = 0x04
    SHORTED_WIRE = 0x08
    OUT_OF_RANGE = 0x10
    """At least one crossing with a baseline is open, shorted or over-range."""
    NO_BASELINE = 0x20


class SelfTest(NamedTuple):
    """Findings of a self-test, in the order of the sub-indices of 0x2023, starting at 2."""

    faults: SelfTestFault
    readings: int
    noise: float
    """Relative noise: RMS, over all crossings, of the relative standard deviation."""
    open_wires: int
    shorted_wires: int
    out_of_range: int
    untared: int


_SELF_TEST: Final = struct.Struct("<BHBfHHII")
SELF_TEST_NEVER_RUN: Final = bytes(_SELF_TEST.size)
"""Contents of record 0x2023 before the first self-test."""


def pack_self_test(test: SelfTest) -> bytes:
    """Return the contents of record 0x2023 after a self-test.

    Args:
        test: Findings of the self-test, which passes if there are no faults.
    """
    return _SELF_TEST.pack(SelfTestStatus.FAILED if test.faults else SelfTestStatus.PASSED, *test)
