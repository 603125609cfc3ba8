"""Arrays of the compiled kernels: names, element types and axes.

A patch has U upper wires with N electrodes each, and K lower wires with M electrodes each. The n unknowns of
an upper wire are coordinates of E of its electrodes. Positions are in pitches, and ``a`` is the scaled
resistance defined in ``problem``.
"""

from __future__ import annotations

import functools
import math
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import READONLY, ArrayTable, reader
from skinnode.model.layout import Float
from skinnode.solve.inputs import CodeMap
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.operators.work import Work
from skinnode.solve.wires.problem import PatchProblem

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# Columns of the integer report on a wire. SPARE is the number of equations in use minus the number of
# unknowns.
STATUS, EVALUATIONS, STEPS, BRANCH, HELD, SPARE, TURN, REPORT = range(8)
# Columns of the floating-point report on a wire. RESIDUAL is the weighted RMS residual of the equations in
# use. CHI2 is the χ² of the final residual, with SPARE degrees of freedom.
RESIDUAL, OPTIMALITY, ERROR_ESTIMATE, CHI2, MEASURES = range(5)

# Index of the relative noise in a code map
NOISE: Final = 3

# Actions for a wire in one call to the solver
LEAVE: Final = 0
SOLVE: Final = 1
PREDICT: Final = 2
"""Solve the wire, starting at x + (∂x/∂a) Δa, where Δa is the change in a since the last solve."""
HOLD: Final = 3
"""Keep x if the residual at x does not exceed the noise; otherwise, proceed as for PREDICT."""

# Optional tasks of a solve; combine them with bitwise OR
COVARIANCE: Final = 1
"""Compute J⁻¹, and the standard deviation and the rounding error of x."""
SKIP: Final = 2
"""Skip a wire whose first-order optimality ‖Jᵀr‖∞ is below tol_f (Xu et al. 2018, section 5.2)."""
REUSE: Final = 4
"""Reuse the J⁻¹ of an earlier solve for wires that have moved only slightly."""


class SolveOptions(ArrayTable):
    """Options of a solve.

    Args:
        operator: Operator code, from :data:`skinnode.solve.operators.codes.OPERATORS`.
        tasks: Any of COVARIANCE, SKIP and REUSE, combined with bitwise OR.
        tol_f: Maximum |r| at a root.
        tol_x: Maximum estimated error of x at a root, relative to max(1, max|x|).
        max_steps: Maximum number of trial steps per wire.

    Raises TypeError if a value has the wrong type, and ValueError if a tolerance or ``max_steps`` is not
    positive.
    """

    operator: int
    tasks: int
    tol_f: float
    tol_x: float
    max_steps: int

    def __init__(self, operator: int, tasks: int, tol_f: float, tol_x: float, max_steps: int) -> None:
        for name, value in (("tol_f", tol_f), ("tol_x", tol_x), ("max_steps", max_steps)):
            if not 0 < value < math.inf:
                raise ValueError(f"{name}: got {value}, must be positive and finite")
        super().__init__(operator=operator, tasks=tasks, tol_f=tol_f, tol_x=tol_x, max_steps=max_steps)


@functools.lru_cache(maxsize=256)
def solve_options(
    operator: int, tasks: int = 0, tol_f: float = 1e-9, tol_x: float = 1e-9, max_steps: int = 12
) -> SolveOptions:
    """Return cached :class:`SolveOptions` with the given values."""
    return SolveOptions(int(operator), int(tasks), float(tol_f), float(tol_x), int(max_steps))


class SolverArrays(ArrayTable):
    """State, results and workspace of a solver for wires that each have unknowns on E electrodes."""

    x: Annotated[Float, "U 3N"]
    """Positions: the starting point before a solve, the solution after it."""
    inverse: Annotated[Float, "U 3N K"]
    """∂x/∂r at each wire's last converged solution."""
    a_solved: Annotated[Float, "U K"]
    """1/F at each wire's last converged solution; 1 for an equation that was not used."""
    noise: Annotated[Float, "U K"]
    """Relative variance of a in each wire's last converged solve; inf for an equation that was not used."""
    std: Annotated[Float, "U 3N"]
    """Standard deviation of x; inf if unknown."""
    report: Annotated[Index, "U report"]
    measure: Annotated[Float, "U measures"]
    tally: Annotated[Index, "3"]
    """Numbers of F evaluations, J evaluations and steps since the array was last set to 0."""
    lower: Annotated[Float, "3 M K", READONLY]
    electrodes: Annotated[Index, "U N"]
    """Indices of each wire's electrodes; the electrodes with unknowns come first."""
    still: Annotated[Float, "U K"]
    """Contribution to F of the electrodes without unknowns."""
    still_std: Annotated[Float, "U 3N"]
    """Standard deviations of the coordinates that are not unknowns."""
    turn: Annotated[Index, "1"]
    """Frame number, which determines which wires compute a new inverse despite REUSE."""
    step_limit: float
    """Initial trust radius, in pitches per coordinate."""
    point: Annotated[Float, "3E"]
    """Positions of the electrodes that have unknowns."""
    raw: Annotated[Float, "3E K"]
    """Jacobian of F at ``point``, transposed."""
    work: Work


class FrameArrays(ArrayTable):
    """Current frame and last trusted solution of a patch."""

    codes: Annotated[NDArray[np.uint32], "U K"]
    baseline_ohm: Annotated[Float, "U K"]
    code_gain: Annotated[Float, "U K"]
    rounding_ohm: Annotated[Float, "U K"]
    code_map: Annotated[Float, "4"]
    """R/R0 at code 0, change in R/R0 per code, largest valid code, and relative noise before the
    converter."""
    ohm: Annotated[Float, "U K"]
    noise: Annotated[Float, "U K"]
    """Relative standard deviation of each resistance."""
    valid: Annotated[Mask, "U K"]
    gain: Annotated[Float, "U K"]
    """a / R."""
    a: Annotated[Float, "U K"]
    """Scaled resistance R · gain."""
    weight: Annotated[Float, "U K"]
    """Weight of each equation: the frame's smallest relative standard deviation divided by that of the
    resistance. The weight is 0 if the resistance is invalid or its standard deviation is unknown."""
    used: Annotated[Float, "U K"]
    """Like ``weight``, but also 0 if ``a`` is out of range."""
    todo: Annotated[Bytes, "U"]
    """Action for each wire: LEAVE, SOLVE, PREDICT or HOLD."""
    order: Annotated[Index, "U"]
    """Indices of the wires, in the order in which to solve them."""
    first: int
    """Action for wires with a usable inverse: HOLD or PREDICT."""
    pitch_m: float
    x: Annotated[Float, "U 3N"]
    """Last trusted positions."""
    a_solved: Annotated[Float, "U K"]
    """1/F at the last trusted positions."""
    weight_solved: Annotated[Float, "U K"]
    """Weights of the equations in each wire's last trusted solution."""
    predictable: Annotated[Mask, "U"]
    """Mask of the wires whose inverse was computed at their last trusted position."""
    unknowns: Annotated[Index, "U"]
    """Number of unknowns per wire."""
    rest: Annotated[Float, "U 3N"]
    rest_branch: Annotated[Index, "U"]
    """Sign of det J at rest."""
    clearance: Annotated[Float, "U N"]
    good: Annotated[Mask, "U"]
    """Mask of the wires with an acceptable root."""
    status: Annotated[Index, "U"]
    moved_m: Annotated[Float, "U 3N"]
    """Displacement of each coordinate, in m."""
    std_m: Annotated[Float, "U 3N"]
    """Standard deviation of ``moved_m``, in m."""
    held: Annotated[Mask, "U"]

    def __init__(self, problem: PatchProblem, rest_branch: Index, unknowns: Index, first: int) -> None:
        shape, rest = problem.layout.shape, problem.rest
        upper = shape[0]
        self.outcome_m = np.empty((2, *problem.layout.upper_m.shape))
        """(2, U, N, 3) displacements of the electrodes and their standard deviations, in m."""
        moved_m, std_m = self.outcome_m.reshape(2, *rest.shape)
        baseline_ohm, code_gain, rounding_ohm = np.ones((3, *shape))
        ohm, noise, a, weight, used = np.empty((5, *shape))
        super().__init__(
            codes=np.zeros(shape, np.uint32),
            baseline_ohm=baseline_ohm,
            code_gain=code_gain,
            rounding_ohm=rounding_ohm,
            code_map=np.zeros(4),
            ohm=ohm,
            noise=noise,
            valid=np.empty(shape, np.bool_),
            gain=problem.gain.copy(),
            a=a,
            weight=weight,
            used=used,
            todo=np.empty(upper, np.uint8),
            order=np.arange(upper),
            first=first,
            pitch_m=problem.layout.pitch_m,
            x=rest.copy(),
            a_solved=problem.a_rest.copy(),
            weight_solved=np.ones(shape),
            predictable=np.zeros(upper, np.bool_),
            unknowns=unknowns,
            rest=rest.copy(),
            rest_branch=rest_branch,
            clearance=problem.clearance.copy(),
            good=np.empty(upper, np.bool_),
            status=np.zeros(upper, np.int64),
            moved_m=moved_m,
            std_m=std_m,
            held=np.empty(upper, np.bool_),
        )

    def set_codes(self, codes: CodeMap) -> None:
        """Set the mapping from codes to resistances."""
        self.baseline_ohm[:], self.rounding_ohm[:] = codes.baseline_ohm, codes.rounding_ohm
        self.code_gain[:] = 1.0 if codes.gain is None else codes.gain
        self.code_map[:] = codes.lo, codes.step, codes.steps, codes.relative_noise


read_options, read_solver, read_frame = reader(SolveOptions), reader(SolverArrays), reader(FrameArrays)
"""Functions that kernels use to access the arrays of a table."""
