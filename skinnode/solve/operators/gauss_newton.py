"""Newton step −J⁺ r, which Gauss-Newton takes in full (Xu et al. 2018, eq. 8), and error estimates.

After a step to a point with the residual r₊, the simplified correction −J⁺ r₊ with the previous J estimates
the error in x (Deuflhard, Newton methods for nonlinear problems, 2004).
"""

from __future__ import annotations

import math

from skinnode.compiled.jit import njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.lu import lu_factor, lu_inverse_transposed, lu_solve_transposed
from skinnode.solve.linalg.qr import qr_factor, qr_inverse, qr_project, r_solve
from skinnode.solve.linalg.vectors import dot, largest
from skinnode.solve.operators.codes import EPS
from skinnode.solve.operators.work import (
    ANGLE,
    ERROR,
    FACTORED,
    NORM,
    REDUCED,
    SIGN,
    SINGULAR,
    Work,
    times_jacobian,
)


@njit_part
def factor(w: Work) -> bool:
    """Factor J, by LU if it is square and by QR otherwise, and compute the Newton step.

    Writes ``newton``, the flags FACTORED, REDUCED, SINGULAR and (for a square J) SIGN, and the scalar ERROR.
    Returns whether J has full rank.
    """
    n, flag = w.x.size, w.flag
    flag[FACTORED] = 1
    flag[REDUCED] = 0
    if w.r.size == n:
        for j in range(n):
            target, source = w.lu[j], w.jt[j]
            for k in range(n):
                target[k] = source[k]
        flag[SIGN] = lu_factor(w.lu, w.pivot)
        full = flag[SIGN] != 0
    else:
        full = qr_factor(w.jt, w.qr, w.diagonal, w.beta, w.v) == 1
    if full:
        w.s[ERROR] = correction(w, w.r, w.newton)
        full = w.s[ERROR] < math.inf
    flag[SINGULAR] = 0 if full else 1
    return bool(full)


@njit_part
def finite_jacobian(w: Work) -> bool:
    """Return whether every element of J is finite."""
    finite = True
    for j in range(w.x.size):
        finite &= largest(w.jt[j]) < math.inf
    return finite


@njit_part
def settled(w: Work, tol_f: float, tol_x: float) -> bool:
    """Return whether x is a root or a minimum; for a tall system, set ANGLE."""
    s = w.s
    small = largest(w.r) <= tol_f
    if w.r.size != w.x.size:
        times_jacobian(w.jt, w.newton, w.js)
        s[ANGLE] = math.sqrt(dot(w.js, w.js)) / s[NORM] if s[NORM] > 0.0 else 0.0
        small = small or s[ANGLE] <= tol_f
    return small and s[ERROR] <= tol_x * max(1.0, largest(w.x))


@njit_part
def correction(w: Work, r: Float, out: Float) -> float:
    """Write −J⁺ r into ``out`` (n,), using the current factors of J; return its maximum norm."""
    n = out.size
    if w.r.size == n:
        for j in range(n):
            out[j] = -r[j]
        lu_solve_transposed(w.lu, w.pivot, out)
    else:
        for k in range(r.size):
            w.e[k] = -r[k]
        qr_project(w.qr, w.beta, w.e)
        r_solve(w.qr, w.diagonal, w.e)
        for j in range(n):
            out[j] = w.e[j]
    return largest(out)


@njit_part
def rounding(w: Work, x: Float) -> float:
    """Write each residual's error due to rounding of x, eps Σ_j |J_kj x_j|, into ``e``; return max |x|."""
    top = 0.0
    for k in range(w.e.size):
        w.e[k] = 0.0
    for j in range(x.size):
        row, size = w.jt[j], EPS * abs(x[j])
        if size > top:
            top = size
        for k in range(w.e.size):
            w.e[k] += abs(row[k]) * size
    return top / EPS


@njit_part
def estimate_error(w: Work, inverse: Float) -> float:
    """Write J⁺ into ``inverse`` (n, m), using the last factors of J; return an estimate of the error in x.

    The estimate is relative to max(1, ‖x‖∞). It is the sum of the last Newton correction and the error due to
    rounding of x, which grows with the condition number of J. If J is singular, the estimate is inf.
    """
    n, m = w.jt.shape
    if w.flag[SINGULAR] == 1:
        return math.inf
    if m == n:
        lu_inverse_transposed(w.lu, w.pivot, inverse)
    else:
        qr_inverse(w.qr, w.diagonal, w.beta, w.r_trial, inverse)
    size = rounding(w, w.x)
    top = 0.0
    for j in range(n):
        row, total = inverse[j], 0.0
        for k in range(m):
            total += abs(row[k]) * w.e[k]
        if not total <= top:
            top = total
    return float((w.s[ERROR] + top) / max(1.0, size))
