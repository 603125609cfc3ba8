"""Arrays that a kernel takes out of one table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skinnode.compiled.array_table import (
    Bundle,
    byte_matrix,
    code_matrix,
    cube,
    fixed_cube,
    int_vector,
    matrix,
    vector,
)
from skinnode.compiled.jit import njit


@njit
def mark(table: Any) -> float:
    """A number of its own into the last element of each array that can be written; a sum of the others."""
    v, m, c = vector(table, 0), matrix(table, 1), cube(table, 2)
    numbers, flags = int_vector(table, 3), byte_matrix(table, 4)
    v[v.size - 1] = 1.5
    m[m.shape[0] - 1, m.shape[1] - 1] = 2.5
    row = c[c.shape[0] - 1]
    row[c.shape[1] - 1, c.shape[2] - 1] = 3.5
    numbers[numbers.size - 1] = -4
    flags[flags.shape[0] - 1, flags.shape[1] - 1] = 1
    codes, fixed = code_matrix(table, 5), fixed_cube(table, 6)
    return float(codes[0, 1]) + fixed[0, 1, 0]


def arrays() -> list[np.ndarray]:
    return [
        np.zeros(3),
        np.zeros((2, 5)),
        np.zeros((2, 3, 4)),
        np.zeros(2, np.int64),
        np.zeros((2, 2), np.bool_),
        np.array([[7, 4_000_000_000]], np.uint32),
        np.arange(6.0).reshape(1, 3, 2),
    ]


def test_a_kernel_reads_and_writes_them_where_they_are() -> None:
    mine = arrays()
    assert mark(Bundle(mine).table) == 4_000_000_002.0
    assert [array.flat[-1] for array in mine[:5]] == [1.5, 2.5, 3.5, -4, True]
    assert [np.count_nonzero(array) for array in mine[:5]] == [1] * 5


def test_they_live_as_long_as_it_does() -> None:
    bundles = [Bundle(arrays()) for _ in range(20)]
    litter = [np.full(shape, 9) for shape in ((1, 2), (1, 3, 2)) for _ in range(200)]  # where they were
    assert [mark(bundle.table) for bundle in bundles] == [4_000_000_002.0] * 20
    assert all((array == 9).all() for array in litter)


@pytest.mark.parametrize(
    "array", [np.zeros((4, 4))[:, :2], np.zeros((2, 2, 2, 2)), np.broadcast_to(0.0, (2, 2))], ids=str
)
def test_what_a_kernel_could_not_address_is_refused(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match="must be contiguous and writable"):
        Bundle([array])
