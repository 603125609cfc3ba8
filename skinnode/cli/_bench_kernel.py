"""Compiled kernels against NumPy: F and J of one wire, and one step of each operator."""

from __future__ import annotations

import numpy as np

from skinnode.cli._bench import Clock, Result, Row, press_m
from skinnode.model.forward import resistance_ohm
from skinnode.model.kernels import potential_jacobian
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve import wires
from skinnode.solve.operators import OPERATORS
from skinnode.solve.problem import PatchProblem

WIRE = 4


class NumpyWire:
    """F and J of one wire as a careful NumPy user writes them: broadcast once, arrays allocated once."""

    def __init__(self, lower: Float, electrodes: int) -> None:
        _, charges, wires_ = lower.shape
        self._lower = np.ascontiguousarray(lower[:, None])  # (3, 1, M, K)
        self._offset = np.empty((3, electrodes, charges, wires_))
        self._square = np.empty((electrodes, charges, wires_))
        self._work = np.empty_like(self._square)
        self.f = np.empty(wires_)
        self.j = np.empty((electrodes, 3, wires_))

    def __call__(self, x: Float) -> None:
        np.subtract(x.reshape(-1, 3).T[:, :, None, None], self._lower, out=self._offset)
        np.einsum("anmk,anmk->nmk", self._offset, self._offset, out=self._square)
        np.sqrt(self._square, out=self._work)
        np.reciprocal(self._work, out=self._work)
        self._work.sum(axis=(0, 1), out=self.f)
        np.divide(self._work, self._square, out=self._work)
        np.einsum("anmk,nmk->nak", self._offset, self._work, out=self.j)
        np.negative(self.j, out=self.j)


def broadcast(x: Float, lower: Float) -> tuple[Float, Float]:
    """The same in three lines."""
    offset = x.reshape(-1, 3).T[:, :, None, None] - lower[:, None]
    distance = np.sqrt((offset**2).sum(axis=0))
    return (1.0 / distance).sum(axis=(0, 1)), -(offset / distance**3).sum(axis=2)


def measure(clock: Clock) -> Result:
    """All rows; every ratio is against the compiled twin in the same run."""
    layout = PatchLayout.preset("staggered")
    problem = PatchProblem.of(layout)
    moved = press_m(layout, 0.3, (0.018, 0.017))
    start = (problem.rest.reshape(layout.upper_m.shape) + moved / layout.pitch_m).reshape(layout.shape[0], -1)
    x = np.ascontiguousarray(start[WIRE])
    f, jt = np.empty(layout.shape[1]), np.empty((layout.unknowns, layout.shape[1]))
    numpy_wire = NumpyWire(problem.lower, layout.upper_m.shape[1])

    compiled = clock.microseconds(lambda: potential_jacobian(x, problem.lower, f, jt))
    prepared = clock.microseconds(lambda: numpy_wire(x))
    plain = clock.microseconds(lambda: broadcast(x, problem.lower))
    numpy_wire(x)
    error = float(np.abs(numpy_wire.j.reshape(jt.shape) - jt).max() / np.abs(jt).max())
    rows = [
        Row("F + J, compiled", compiled, 1.0),
        Row("F + J, NumPy, preallocated", prepared, prepared / compiled, error),
        Row("F + J, NumPy, broadcast", plain, plain / compiled),
    ]
    a = resistance_ohm(layout, layout.upper_m) * problem.gain  # the frame at rest: several steps away
    for name in OPERATORS:
        ours = _compiled_step(clock, problem, start, a, name)
        theirs = _numpy_step(clock, numpy_wire, x, a[WIRE], name)
        rows.append(Row(f"step of {name}, compiled", ours, 1.0))
        rows.append(Row(f"step of {name}, NumPy", theirs, theirs / ours))
    reached = rows[1].ratio
    return Result(
        "kernel",
        "one wire, 10 electrodes over 30 lower wires of 10; error: compiled against NumPy, relative",
        tuple(rows),
        (f"F + J {reached:.1f} times faster than preallocated NumPy (set: 8)",),
    )


def _compiled_step(clock: Clock, problem: PatchProblem, start: Float, a: Float, name: str) -> float:
    """Two steps less one step, of all wires in one call: what a step costs with its evaluation of F and J."""
    solver = wires.Solver(problem, OPERATORS[name])
    todo = np.full(len(start), wires.SOLVE, np.uint8)
    weight = np.ones_like(a)

    def run(steps: int) -> None:
        solver.x[:] = start
        solver.solve(todo, a, weight, 0, 1e-300, 1e-300, steps)

    times = [clock.microseconds(lambda steps=steps: run(steps)) for steps in (1, 2)]  # type: ignore[misc]  # bound at once
    return (times[1] - times[0]) / len(start)


def _numpy_step(clock: Clock, wire: NumpyWire, x: Float, a: Float, name: str) -> float:
    """F, J and the step of one operator in NumPy and LAPACK."""
    unknowns = x.size

    def step() -> Float:
        wire(x)
        r = a * wire.f - 1.0
        jt = wire.j.reshape(unknowns, -1) * a
        j = jt.T
        if name == "gauss_newton":
            return np.asarray(np.linalg.solve(j, -r))
        gradient = jt @ r
        scale = np.sqrt((jt**2).sum(axis=1))
        if name == "levenberg_marquardt":
            tall = np.vstack([j, np.diag(1e-3 * scale)])
            q, upper = np.linalg.qr(tall)
            return np.asarray(np.linalg.solve(upper, q.T @ np.concatenate([-r, np.zeros(unknowns)])))
        newton = np.linalg.solve(j, -r)
        descent = -gradient / scale**2
        slope = j @ descent
        cauchy = (gradient @ -descent) / (slope @ slope) * descent
        radius = 0.5 * np.linalg.norm(scale * newton)
        leg = newton - cauchy
        b, c = (scale * leg) @ (scale * cauchy), np.linalg.norm(scale * cauchy) ** 2 - radius**2
        square = np.linalg.norm(scale * leg) ** 2
        return np.asarray(cauchy + (np.sqrt(max(b * b - square * c, 0.0)) - b) / square * leg)

    return clock.microseconds(step)
