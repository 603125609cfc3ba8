"""Compile the kernels that most tests use, once, before several worker processes would each compile them."""

from __future__ import annotations

import numpy as np

import skinnode as sk
from skinnode.compiled.jit import is_cold

KERNELS = ("solve_patch", "surprises", "advance")
"""One kernel of each solver: the exact tracker, the whole-patch estimator, path following."""


def is_needed() -> bool:
    """Whether one of the solvers has no compiled kernels."""
    return any(is_cold(kernel) for kernel in KERNELS)


def main() -> None:
    layout = sk.PatchLayout.preset("staggered")
    rest_ohm = sk.resistance_ohm(layout, layout.upper_m)
    for method in ("exact", "posterior"):
        sk.Tracker(layout, method=method).update(rest_ohm)
    path_ohm = np.stack([rest_ohm, rest_ohm, rest_ohm])
    sk.solve_path(layout, path_ohm)


if __name__ == "__main__":
    main()
