"""Self-test of a patch (0x2021:3).

The self-test checks several readings of the source. It does not check the board, because a software node has
none. A touch during the self-test is measured as noise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.node.patch.source import SourceFailed
from skinnode.node.patch.wire_faults import find_faults
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.self_test import SelfTest, SelfTestFault

READINGS: Final = 16
"""Number of readings in a self-test.

The relative standard error of the noise estimate is 1/√30 = 18 % for one crossing, and 1 % for the RMS over
300 crossings.
"""

NOISE_LIMIT: Final = 1e-3
"""Maximum relative noise of a reading that passes the self-test. The solver's accuracy is specified for one
hundredth of this noise."""


@np.errstate(over="ignore", invalid="ignore")  # only absurdly large resistances overflow
def self_test(read: Callable[[], Float], baseline_ohm: Float, scale: CodeScale) -> SelfTest:
    """Run a self-test.

    Args:
        read: Function that returns (U, K) resistances in ohms or raises SourceFailed.
        baseline_ohm: (U, K) R0 in ohms.
        scale: Mapping of R/R0 to codes.

    Returns:
        Findings of the self-test.
    """
    readings: list[Float] = []
    for _ in range(READINGS):
        try:
            readings.append(read())
        except SourceFailed:
            continue
    faults = SelfTestFault(0)
    if len(readings) < READINGS:
        faults |= SelfTestFault.SOURCE
    untared = ~((baseline_ohm > 0) & np.isfinite(baseline_ohm))
    if untared.any():
        faults |= SelfTestFault.NO_BASELINE
    if not readings:
        return SelfTest(faults, 0, 0.0, 0, 0, 0, int(untared.sum()))
    stack = np.array(readings)
    measured = (np.isfinite(stack) & (stack > 0)).all(axis=0)
    noise = _noise(stack[:, measured])
    if not noise <= NOISE_LIMIT:
        faults |= SelfTestFault.NOISE
    codes = encode(stack.mean(axis=0), baseline_ohm, scale)
    wires = find_faults(codes, scale)
    n_open = int(wires.upper_open.sum() + wires.lower_open.sum())
    n_short = int(wires.upper_short.sum() + wires.lower_short.sum())
    unusable = int(((codes > scale.steps) & ~untared).sum())
    if n_open:
        faults |= SelfTestFault.OPEN_WIRE
    if n_short:
        faults |= SelfTestFault.SHORTED_WIRE
    if unusable:
        faults |= SelfTestFault.OUT_OF_RANGE
    return SelfTest(faults, len(readings), noise, n_open, n_short, unusable, int(untared.sum()))


def _noise(readings: Float) -> float:
    """Return the RMS, over all crossings, of the relative standard deviation."""
    if len(readings) < 2 or not readings.shape[1]:
        return 0.0
    relative = readings.std(axis=0, ddof=1) / readings.mean(axis=0)
    return float(np.sqrt(np.mean(relative**2)))
