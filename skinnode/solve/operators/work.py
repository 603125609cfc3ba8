"""Workspace for a solve, and products with its Jacobian.

The symbols follow the paper: the residual r (m,), its Jacobian J (m, n), which is stored transposed, and the
Levenberg-Marquardt parameter lam. The trust region of a step s is ‖D s‖ ≤ radius. The diagonal of D is the
running maximum of the column norms of J (Moré 1978), which makes the solve independent of the units of the
unknowns. In the second and third attempts of ``solve_system``, D is the identity.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from skinnode.compiled.jit import njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index, padded

# Indices of the scalars of a solve in Work.s
LIMIT, RADIUS, LAM, NORM, LENGTH, NEWTON_LENGTH, ERROR, ANGLE, SCALARS = range(9)
# Indices of the flags of a solve in Work.flag
FACTORED, SINGULAR, SIGN, REDUCED, STALLED, FLAGS = range(6)


class Work(NamedTuple):
    """Workspace for solving m equations in n unknowns."""

    x: Annotated[Float, "n"]
    trial: Annotated[Float, "n"]
    step: Annotated[Float, "n"]
    newton: Annotated[Float, "n"]
    gradient: Annotated[Float, "n"]
    scale: Annotated[Float, "n"]
    """Diagonal of D."""
    diagonal: Annotated[Float, "n"]
    """Diagonal of R in the QR factorisation of J."""
    beta: Annotated[Float, "n"]
    """Factors β of the reflectors of Q in the QR factorisation."""
    v: Annotated[Float, "n"]
    bd: Annotated[Float, "n"]
    """Diagonal of the bidiagonal form of J D⁻¹; its superdiagonal is ``bu``."""
    bu: Annotated[Float, "n"]
    across: Annotated[Float, "n"]
    down: Annotated[Float, "n"]
    """Factors β of the left reflectors of the bidiagonal form; ``across`` is for the right reflectors."""
    inverse: Annotated[Float, "n"]
    """Reciprocal diagonal of the damped bidiagonal form; its superdiagonal is ``ru``."""
    ru: Annotated[Float, "n"]
    r: Annotated[Float, "m"]
    r_trial: Annotated[Float, "m"]
    js: Annotated[Float, "m"]
    """J·step."""
    e: Annotated[Float, "m"]
    """Work array."""
    jt: Annotated[Float, "n m"]
    """Jᵀ at x."""
    lu: Annotated[Float, "n+3 lanes_n"]
    """LU factors of Jᵀ, for a square system; rows are padded to whole SIMD vectors."""
    qr: Annotated[Float, "m n"]
    """QR factors of J, for a tall system."""
    right: Annotated[Float, "n+3 lanes_m"]
    """Right reflectors of the bidiagonal form."""
    left: Annotated[Float, "n lanes_n+3"]
    """Left reflectors of the bidiagonal form."""
    wide: Annotated[Float, "lanes_m"]
    """Work array, as long as a row of ``right``."""
    pivot: Annotated[Index, "n"]
    s: Annotated[Float, "scalars"]
    flag: Annotated[Index, "flags"]


def workspace(n: int, m: int) -> Work:
    """Return a zeroed workspace for m equations in n unknowns."""
    v, e = np.zeros((15, n)), np.zeros((4, m))
    return Work(
        x=v[0], trial=v[1], step=v[2], newton=v[3], gradient=v[4], scale=v[5], diagonal=v[6], beta=v[7],
        v=v[8], bd=v[9], bu=v[10], across=v[11], down=v[12], inverse=v[13], ru=v[14],
        r=e[0], r_trial=e[1], js=e[2], e=e[3],
        jt=np.zeros((n, m)), lu=padded(n + 3, n), qr=np.zeros((m, n)),
        right=padded(n + 3, m), left=padded(n, n + 3), wide=padded(1, m)[0],
        pivot=np.zeros(n, np.int64), s=np.zeros(SCALARS), flag=np.zeros(FLAGS, np.int64),
    )  # fmt: skip


@njit_part
def weighted_norm(scale: Float, v: Float) -> float:
    """Return ‖D v‖₂."""
    total = 0.0
    for j in range(v.size):
        weighted = scale[j] * v[j]
        total += weighted * weighted
    return math.sqrt(total)


@njit_part
def times_jacobian(jt: Float, v: Float, out: Float) -> None:
    """Write J v into ``out`` (m,)."""
    for k in range(out.size):
        out[k] = 0.0
    for j in range(v.size):
        row, factor = jt[j], v[j]
        for k in range(out.size):
            out[k] += factor * row[k]
