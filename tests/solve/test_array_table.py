"""Arrays and numbers that a kernel reads from one table, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import skinnode as sk
from skinnode.compiled.array_table import READONLY, ArrayTable, reader
from skinnode.compiled.jit import njit, numba
from skinnode.solve.wires.arrays import FrameArrays, SolveOptions
from skinnode.solve.wires.decode import decode, scale

Float = NDArray[np.float64]


class Pair(NamedTuple):
    """A group of arrays."""

    near: Annotated[Float, "n"]
    index: Annotated[NDArray[np.int64], "n"]


class Every(ArrayTable):
    """A field of every kind."""

    vector: Annotated[Float, "3"]
    matrix: Annotated[Float, "U K"]
    cube: Annotated[Float, "U N K"]
    numbers: Annotated[NDArray[np.int64], "n"]
    flags: Annotated[NDArray[np.bool_], "U U"]
    codes: Annotated[NDArray[np.uint32], "1 n"]
    fixed: Annotated[Float, "1 3 n", READONLY]
    limit: float
    count: int
    pair: Pair


class Other(ArrayTable):
    """Another declaration."""

    limit: float


every = reader(Every)


@njit
def mark(table: Any) -> float:
    """Write a number of its own into the last element of each array, and sum up the others."""
    it = every(table)
    v, m, c = it.vector, it.matrix, it.cube
    v[v.size - 1] = 1.5
    m[m.shape[0] - 1, m.shape[1] - 1] = 2.5
    row = c[c.shape[0] - 1]
    row[c.shape[1] - 1, c.shape[2] - 1] = it.limit
    it.numbers[it.numbers.size - 1] = it.count
    it.flags[it.flags.shape[0] - 1, it.flags.shape[1] - 1] = 1
    pair = it.pair
    pair.near[1] = 5.5
    pair.index[1] = 6
    return float(it.codes[0, 1]) + it.fixed[0, 1, 0]


def values() -> dict[str, Any]:
    return {
        "vector": np.zeros(3),
        "matrix": np.zeros((2, 5)),
        "cube": np.zeros((2, 3, 5)),
        "numbers": np.zeros(2, np.int64),
        "flags": np.zeros((2, 2), np.bool_),
        "codes": np.array([[7, 4_000_000_000]], np.uint32),
        "fixed": np.arange(6.0).reshape(1, 3, 2),
        "limit": 3.5,
        "count": -4,
        "pair": Pair(np.zeros(2), np.zeros(2, np.int64)),
    }


WRITTEN = ("vector", "matrix", "cube", "numbers", "flags")


def test_a_kernel_reads_and_writes_them_where_they_are() -> None:
    mine = values()
    assert mark(Every(**mine).table) == 4_000_000_002.0
    assert [mine[name].flat[-1] for name in WRITTEN] == [1.5, 2.5, 3.5, -4, True]
    assert [np.count_nonzero(mine[name]) for name in WRITTEN] == [1] * 5
    assert (mine["pair"].near[1], mine["pair"].index[1]) == (5.5, 6)


def test_they_live_as_long_as_the_table() -> None:
    tables = [Every(**values()) for _ in range(20)]
    litter = [np.full(shape, 9) for shape in ((1, 2), (1, 3, 2)) for _ in range(200)]  # where they were
    assert [mark(each.table) for each in tables] == [4_000_000_002.0] * 20
    assert all((array == 9).all() for array in litter)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"matrix": np.zeros((4, 10))[:2, ::2]}, "Every.matrix: got float64 of shape .2, 5., not contiguous"),
        ({"matrix": np.zeros((2, 5), np.float32)}, "got float32 of shape .2, 5., must be a contiguous"),
        ({"matrix": np.zeros(5)}, r"got float64 of shape .5,., must be .* float64 array with axes \(U, K\)"),
        ({"matrix": np.zeros((2, 6))}, "Every.cube: .*where K is 6"),
        ({"vector": np.zeros(4)}, "Every.vector: .*where 3 is 3"),
        ({"vector": np.broadcast_to(0.0, (3,))}, "read-only, must be"),
        ({"vector": [0.0, 0.0, 0.0]}, "Every.vector: got list"),
        ({"flags": np.zeros((2, 2), np.uint8)}, "Every.flags: got uint8 .* bool array"),
        ({"limit": 1}, "Every.limit: got 1, must be float64"),
        (
            {"pair": Pair(np.zeros(2), np.zeros(2))},
            "Every.index: got float64 of shape .2,., must be .* int64",
        ),
        ({"unheard_of": np.zeros(3)}, "missing or unknown: unheard_of"),
    ],
    ids=str,
)
def test_what_a_kernel_would_misread_is_a_type_error(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        Every(**values() | changed)


def test_a_field_cannot_be_left_out() -> None:
    with pytest.raises(TypeError, match="missing or unknown: limit"):
        Other()


def test_a_field_cannot_be_replaced() -> None:
    """The kernel has the address of the old array."""
    table = Every(**values())
    with pytest.raises(AttributeError, match="write to the array in place"):
        table.vector = np.zeros(3)
    table.vector += 1.0
    assert mark(table.table) == 4_000_000_002.0
    assert table.vector.tolist() == [1.0, 1.0, 1.5]


@pytest.mark.parametrize(
    "table", [Other(limit=1.0).table, np.zeros((20, 4), np.int64)], ids=["other", "zeros"]
)
def test_a_kernel_refuses_another_table(table: NDArray[np.int64]) -> None:
    with pytest.raises(TypeError, match="must be the table of a Every"):
        mark(table)


def test_a_kernel_refuses_what_is_no_table() -> None:
    with pytest.raises(numba.core.errors.TypingError, match="must be the table of a Every"):
        mark(np.zeros(4))


@pytest.mark.parametrize("hint", [list, NDArray[np.float64], Annotated[Float, "a b c d"]])
def test_a_declaration_that_no_kernel_could_read_is_refused(hint: Any) -> None:
    with pytest.raises(TypeError, match=r"Wrong\.field: declared as"):
        type("Wrong", (ArrayTable,), {"__annotations__": {"field": hint}})


def reordered(declaration: type[ArrayTable]) -> type[ArrayTable]:
    """The same fields, declared in reverse order."""
    hints = dict(reversed(declaration.__annotations__.items()))
    return type(
        declaration.__name__, (ArrayTable,), {"__annotations__": hints, "__module__": declaration.__module__}
    )


def kernel_of(declaration: type[ArrayTable]) -> Callable[[NDArray[np.int64]], float]:
    """The first stages of a frame for tables of this declaration."""
    read = reader(declaration)

    @numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
    def stages(table: NDArray[np.int64]) -> float:
        frame = read(table)
        return decode(frame) + scale(frame, 1e-5)

    kernel: Callable[[NDArray[np.int64]], float] = stages
    return kernel


@pytest.mark.long
def test_the_order_of_a_declaration_changes_no_result(staggered: sk.PatchLayout) -> None:
    """The stages of a frame by the declaration that stands, and by the same one in reverse order."""
    problem = sk.solve.wires.problem.PatchProblem.of(staggered)
    rng = np.random.default_rng(1)
    upper, lower = staggered.shape
    made = FrameArrays(problem, np.ones(upper, np.int64), np.full(upper, 30), 3)
    made.codes[:] = rng.integers(0, 2**24, (upper, lower))
    made.baseline_ohm[:], made.rounding_ohm[:] = 1000.0, 0.01
    made.code_map[:] = 0.5, 2.0**-23, 0.9 * 2**24, 1e-5
    outcomes = []
    for declaration in (FrameArrays, reordered(FrameArrays)):
        fields = {name: getattr(made, name) for name in FrameArrays.__annotations__}
        mine = {n: v.copy() if isinstance(v, np.ndarray) else v for n, v in fields.items()}
        table = ArrayTable.__new__(declaration)
        ArrayTable.__init__(table, **mine)
        value = kernel_of(declaration)(table.table)
        outcomes.append(
            [value, *(mine[name].tobytes() for name in ("ohm", "noise", "valid", "a", "weight", "used"))]
        )
    assert outcomes[0] == outcomes[1]
    assert outcomes[0][0] > 10.0  # codes that are no measurement


@pytest.mark.long
def test_tables_of_two_orders_are_not_taken_for_each_other() -> None:
    other = reordered(SolveOptions)
    table = ArrayTable.__new__(other)
    ArrayTable.__init__(table, operator=0, tasks=0, tol_f=1e-9, tol_x=1e-9, max_steps=12)
    read = reader(SolveOptions)

    @numba.njit
    def steps(table: NDArray[np.int64]) -> int:
        return read(table).max_steps

    assert steps(SolveOptions(0, 0, 1e-9, 1e-9, 12).table) == 12
    with pytest.raises(TypeError, match="must be the table of a SolveOptions"):
        steps(table.table)


@pytest.mark.parametrize("name", ["tol_f", "tol_x", "max_steps"])
def test_options_of_a_solve_are_positive(name: str) -> None:
    good = {"operator": 0, "tasks": 0, "tol_f": 1e-9, "tol_x": 1e-9, "max_steps": 12}
    with pytest.raises(ValueError, match=f"{name}: got 0"):
        SolveOptions(**good | {name: type(good[name])(0)})
