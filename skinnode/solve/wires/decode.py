"""Compiled conversion of the codes of a scan to scaled resistances.

``decode`` computes the resistances and their relative standard deviations; :mod:`skinnode.protocol.codes`
defines the formula. ``scale`` computes the scaled resistances a and the weights of the equations, as defined
in ``problem``.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.solve.inputs import NOISE_MAX
from skinnode.solve.wires.arrays import FrameArrays

A_MIN: Final = 1e-12
A_MAX: Final = 1e12
"""Limits on the scaled resistance a. All plausible values are within them; at rest, a is about 1 / (N M)."""


@njit_part
def decode(frame: FrameArrays) -> int:
    """Compute ``ohm``, ``noise`` and ``valid`` from ``codes``; return the number of invalid codes.

    The resistance of an invalid code is NaN. ``noise`` combines the noise before the converter with the
    quantization error.
    """
    codes, baseline, gain = frame.codes, frame.baseline_ohm, frame.code_gain
    rounding, code_map = frame.rounding_ohm, frame.code_map
    ohm, noise, valid = frame.ohm, frame.noise, frame.valid
    lo, step, steps, relative = code_map[0], code_map[1], code_map[2], code_map[3]
    invalid = 0
    for u in range(codes.shape[0]):
        for k in range(codes.shape[1]):
            code = float(codes[u, k])
            r0 = baseline[u, k]
            measured = code <= steps and 0.0 < r0 < math.inf
            r = (lo + code * step) * r0 * gain[u, k] if measured else math.nan
            share = rounding[u, k] / r
            ohm[u, k] = r
            noise[u, k] = math.sqrt(relative * relative + share * share)
            valid[u, k] = measured
            invalid += not measured
    return invalid


@njit_part
def scale(frame: FrameArrays, sigma: float) -> float:
    """Compute ``a``, ``weight`` and ``used`` from ``ohm``, ``noise`` and ``valid``.

    Returns the smallest relative standard deviation of the frame's resistances, or ``sigma`` if none is
    known.
    """
    frame_ohm, gain, noise, valid = frame.ohm, frame.gain, frame.noise, frame.valid
    a, weight, used = frame.a, frame.weight, frame.used
    least = math.inf
    for u in range(a.shape[0]):
        for k in range(a.shape[1]):
            if 0.0 < noise[u, k] < NOISE_MAX:
                least = min(least, noise[u, k])
    if least == math.inf:
        least = sigma
    for u in range(a.shape[0]):
        for k in range(a.shape[1]):
            known = 0.0 < noise[u, k] < NOISE_MAX and valid[u, k]
            weight[u, k] = least / noise[u, k] if known else 0.0
            a[u, k] = frame_ohm[u, k] * gain[u, k]
            used[u, k] = weight[u, k] if A_MIN < a[u, k] < A_MAX else 0.0
    return least
