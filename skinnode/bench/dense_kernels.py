"""Compares our dense kernels with single-threaded LAPACK in a child process.

With several threads, LAPACK's workers keep spinning for a while after each call. A kernel that shares a core
with a spinning worker takes up to three times as long. On a busy machine, the workers also wait for each
other.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from skinnode.bench.timing import take_turns
from skinnode.model.layout import Float
from skinnode.solve.linalg import cholesky as dense

ONE_THREAD: Final = {
    f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "MKL", "BLIS", "VECLIB", "OMP", "NUMBA")
}


def measure(rounds: int) -> list[dict[str, Any]]:
    """Time our dense kernels and the LAPACK equivalents; return one row per kernel (µs per call)."""
    command = [sys.executable, "-m", "skinnode.bench.dense_kernels", str(rounds)]
    done = subprocess.run(command, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, check=True)
    rows: list[dict[str, Any]] = json.loads(done.stdout)
    return rows


def dense_pairs() -> dict[str, dict[str, Callable[[], object]]]:
    """Return our dense kernels and the LAPACK equivalents, for 300 unknowns (10 wires, 10 electrodes).

    Each kernel uses its preferred memory order and works in place on buffers that are refilled before every
    call.
    """
    from scipy.linalg import blas, lapack

    n, rng = 300, np.random.default_rng(2)
    half = rng.normal(size=(n, n))
    s = half @ half.T / n + np.eye(n)
    right = rng.normal(size=(n, n))
    a, b, out = np.empty((n, n)), np.empty((n, n)), np.empty(n)
    fortran, lower_f = np.empty((n, n), order="F"), np.asfortranarray(np.linalg.cholesky(s))
    lower = np.ascontiguousarray(lower_f)
    left, wide, product = rng.normal(size=(30, 30)), rng.normal(size=(30, n)), np.empty((30, n))

    def cholesky() -> None:
        a[:] = s
        dense.cholesky(a, n)

    def dpotrf() -> None:
        fortran.T[:] = s
        lapack.dpotrf(fortran, lower=1, clean=0, overwrite_a=1)

    def solve_lower() -> None:
        b[:] = right
        dense.solve_lower(lower, b, n, n)

    def dtrsm() -> None:
        fortran.T[:] = right
        blas.dtrsm(1.0, lower_f, fortran, lower=1, overwrite_b=1)

    def dpotri() -> Float:
        fortran[:] = lower_f
        return np.asarray(lapack.dpotri(fortran, lower=1, overwrite_c=1)[0].diagonal())

    return {
        "Cholesky, 300 x 300": {"compiled": cholesky, "LAPACK dpotrf": dpotrf},
        "triangular solve, 300 x 300": {"compiled": solve_lower, "BLAS dtrsm": dtrsm},
        "diagonal of inverse, 300": {
            "compiled": lambda: dense.inverse_diagonal(lower, a, out, n),
            "LAPACK dpotri": dpotri,
        },
        "30 x 30 by 30 x 300": {
            "compiled": lambda: dense.multiply(left, wide, product),
            "NumPy matmul": lambda: np.matmul(left, wide, out=product),
        },
    }


def main(rounds: int) -> None:
    """Benchmark the dense kernels and print the results as JSON."""
    rows = [
        {"what": what, "who": who, "us": timing.call_us, "ratio": timing.ratio}
        for what, candidates in dense_pairs().items()
        for who, timing in take_turns(candidates, rounds=rounds).items()
    ]
    print(json.dumps(rows))


if __name__ == "__main__":
    main(int(sys.argv[1]))
