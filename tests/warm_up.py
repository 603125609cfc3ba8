"""Compile the kernels that most tests use, once, before several worker processes would each compile them."""

from __future__ import annotations

import numpy as np

import skinnode as sk
from skinnode.compiled.jit import is_cold

KERNELS = ("solve_patch", "surprises", "_secant", "advance")
"""One kernel of each solver: exact tracker, whole-patch estimator, path following, systems of equations."""


def is_needed() -> bool:
    """Whether one of the solvers has no compiled kernels."""
    return any(is_cold(kernel) for kernel in KERNELS)


def main() -> None:
    layout = sk.PatchLayout.preset("staggered")
    rest_ohm = sk.resistance_ohm(layout, layout.upper_m)
    for method in ("exact", "posterior"):
        sk.Tracker(layout, method=method).update(rest_ohm)
    sk.solve_path(layout, np.stack([rest_ohm, rest_ohm, rest_ohm]))
    sk.solve_system(lambda x: x - 1.0, lambda x: np.eye(1), [0.0])


if __name__ == "__main__":
    main()
