"""Compares the compiled kernels with NumPy and LAPACK.

The benchmark times one wire of the reference patch: the evaluation of the potential F with its Jacobian J,
and one step of each operator (Gauss-Newton, Levenberg-Marquardt and dogleg). The dense kernels are timed at
the matrix sizes of the reference patch's posterior.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from skinnode.bench import dense_kernels
from skinnode.bench.timing import machine, take_turns
from skinnode.compiled.jit import njit, njit_part
from skinnode.model.forward import resistance_ohm
from skinnode.model.kernels import lower_rows, potential_jacobian, relative_residual, relative_residual_part
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.operators.codes import OPERATORS, OUTSIDE
from skinnode.solve.operators.loop import assess, begin, propose, shorten
from skinnode.solve.operators.work import LIMIT, Work, workspace
from skinnode.solve.wires.problem import PatchProblem

SHORT: Final = 1e-3
"""Trust radius, in pitches per coordinate. The radius is much smaller than a Newton step, so that every
operator must shorten its step."""


class NumpyWire:
    """Fast NumPy implementation of F and Jᵀ for one wire: structure of arrays, preallocated buffers.

    The axis order and the summation method are the fastest of those compared.
    """

    def __init__(self, lower: Float, electrodes: int) -> None:
        _, charges, wires = lower.shape
        pairs = (charges, electrodes * wires)
        self._lower = np.ascontiguousarray(
            np.broadcast_to(lower[:, :, None], (3, charges, electrodes, wires))
        )
        self._lower.shape = (3, *pairs)
        self._x = np.empty((3, electrodes, wires))
        self._gap, self._square, self._near = np.empty((3, *pairs)), np.empty(pairs), np.empty(pairs)
        self._ones = np.ones(charges * electrodes)
        self._sums = np.empty((3, electrodes * wires))
        self.f = np.empty(wires)
        self.jt = np.empty((electrodes, 3, wires))

    def __call__(self, x: Float) -> tuple[Float, Float]:
        """Return the potential F (K,) and its transposed Jacobian Jᵀ (3N, K) at x."""
        self._x[:] = x.reshape(-1, 3).T[:, :, None]
        np.subtract(self._lower, self._x.reshape(3, 1, -1), out=self._gap)
        np.einsum("amp,amp->mp", self._gap, self._gap, out=self._square)
        np.sqrt(self._square, out=self._near)
        np.reciprocal(self._near, out=self._near)
        np.matmul(self._ones, self._near.reshape(-1, self.f.size), out=self.f)
        np.multiply(self._near, self._near, out=self._square)
        np.multiply(self._near, self._square, out=self._near)
        np.einsum("amp,mp->ap", self._gap, self._near, out=self._sums)
        self.jt[:] = self._sums.reshape(self._x.shape).transpose(1, 0, 2)
        return self.f, self.jt.reshape(-1, self.f.size)


def numpy_step(operator: str, wire: NumpyWire, x: Float, a: Float) -> Float:
    """Take the same step as :func:`compiled_steps` for one wire in NumPy; return the new relative residual.

    The Levenberg-Marquardt parameter is fixed, whereas the compiled step searches for it.
    """
    f, jt = wire(x)
    r, j = relative_residual(a, f), (jt * a).T
    if operator == "gauss_newton":
        step = -np.linalg.solve(j, r)
    else:
        scale = np.linalg.norm(j, axis=0)
        radius = SHORT * np.linalg.norm(scale)
        gradient = j.T @ r
        if operator == "dogleg":
            newton = -np.linalg.solve(j, r)
            down = -gradient / scale**2
            along = j @ down
            cauchy = down * (-(gradient @ down) / (along @ along))
            if np.linalg.norm(scale * cauchy) >= radius:
                step = down * (radius / np.linalg.norm(scale * down))
            else:
                leg, from_ = scale * (newton - cauchy), scale * cauchy
                p, q = leg @ leg, leg @ from_
                step = cauchy + (newton - cauchy) * (
                    (np.sqrt(q * q + p * (radius**2 - from_ @ from_)) - q) / p
                )
        else:
            n = x.size
            # With r appended as the last column, qr returns Qᵀr without computing Q.
            augmented = np.zeros((r.size + n, n + 1))
            augmented[: r.size, :n] = j
            augmented[: r.size, n] = r
            np.fill_diagonal(augmented[r.size :], 0.1 * scale)
            triangle = np.asarray(np.linalg.qr(augmented, mode="r"))
            step = -np.linalg.solve(triangle[:n, :n], triangle[:n, n])
    trial = x + step
    f, _ = wire(trial)
    return relative_residual(a, f)


@njit_part
def _evaluate(x: Float, lower: Float, a: Float, r: Float, jt: Float) -> None:
    potential_jacobian(x, lower, r, jt)
    for k in range(r.size):
        r[k] = relative_residual_part(a[k], r[k])
    for i in range(jt.shape[0]):
        row = jt[i]
        for k in range(r.size):
            row[k] *= a[k]


@njit
def compiled_steps(  # noqa: PLR0913 - a kernel takes its buffers
    operator: int, start: Float, lower: Float, a: Float, w: Work, jt_trial: Float
) -> None:
    """Take one step for every wire from ``start``, (U, n), with the functions that make up the solver loop.

    The loop itself is not timed, because it would compute a second step before checking its step limit.
    """
    for u in range(start.shape[0]):
        for j in range(w.x.size):
            w.x[j] = start[u, j]
        _evaluate(w.x, lower, a[u], w.r, w.jt)
        w.s[LIMIT] = SHORT
        begin(w)
        if propose(operator, w, 1e-14, 1e-14) == OUTSIDE:
            shorten(operator, w)
        _evaluate(w.trial, lower, a[u], w.r_trial, jt_trial)
        assess(operator, w, 1e-14, 1e-14)


def run(rounds: int) -> dict[str, Any]:
    """Run the benchmark; return times (µs) per wire or per dense-kernel call, and ratios to our times."""
    layout = PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
    problem = PatchProblem.of(layout)
    rng = np.random.default_rng(1)
    pressed = layout.upper_m - rng.uniform(0.0, 0.2, (10, 10, 1)) * np.array([0.2, 0.1, 1.0]) * 2e-3
    a = resistance_ohm(layout, pressed) * problem.gain
    lower = lower_rows(layout.lower_m / layout.pitch_m)
    x = problem.rest[5].copy()
    f, jt = np.empty(30), np.empty((30, 30))
    wire = NumpyWire(lower, 10)
    np.testing.assert_allclose(potential_of(x, lower), wire(x)[0], rtol=1e-12)

    def broadcast() -> Float:
        gap = x.reshape(10, 1, 1, 3) - layout.lower_m / layout.pitch_m
        distance = np.linalg.norm(gap, axis=-1, keepdims=True)
        return np.asarray((1.0 / distance).sum() - (gap / distance**3).sum(axis=2))

    pairs: dict[str, dict[str, Callable[[], object]]] = {
        "F + J": {
            "compiled": lambda: potential_jacobian(x, lower, f, jt),
            "NumPy, preallocated": lambda: wire(x),
            "NumPy, broadcast": broadcast,
        }
    }
    work, jt_trial = workspace(30, 30), np.empty((30, 30))
    for operator, code in OPERATORS.items():

        def compiled(code: int = code) -> None:
            compiled_steps(code, problem.rest, lower, a, work, jt_trial)

        def plain(operator: str = operator) -> None:
            for u in range(10):
                numpy_step(operator, wire, problem.rest[u], a[u])

        pairs[f"step of {operator}"] = {"compiled": compiled, "NumPy, preallocated": plain}
    rows = []
    for what, candidates in pairs.items():
        wires_a_call = 10 if what.startswith("step") else 1
        for name, timing in take_turns(candidates, rounds=rounds).items():
            rows.append(
                {"what": what, "who": name, "us": timing.call_us / wires_a_call, "ratio": timing.ratio}
            )
    return {"benchmark": "kernel", "machine": machine(), "rows": rows + dense_kernels.measure(rounds)}


def potential_of(x: Float, lower: Float) -> Float:
    """Compute F for one wire with the compiled kernel."""
    f, jt = np.empty(lower.shape[2]), np.empty((x.size, lower.shape[2]))
    potential_jacobian(x, lower, f, jt)
    return f
