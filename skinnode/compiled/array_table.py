"""Many arrays handed to a kernel as one.

Numba checks and unpacks every argument of every call. For the fifty arrays of a patch that takes 4 µs, and
40 where the caches are those of somebody else, as they are once in a period: as long as four wires. A
:class:`Bundle` is one array of addresses and shapes; the kernel takes its arrays out of it with
``vector``, ``matrix`` and ``cube``, which cost a few loads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numba.core import cgutils as typed_cgutils
from numba.core import types as typed_types
from numba.extending import intrinsic as typed_intrinsic
from numba.np import arrayobj as typed_arrayobj
from numpy.typing import NDArray

cgutils: Any = typed_cgutils  # numba's own types are in the way here
types: Any = typed_types
intrinsic: Any = typed_intrinsic
arrayobj: Any = typed_arrayobj

_MOST_AXES: Final = 3


class Bundle:
    """``arrays`` as a kernel takes them by their number: written in place, never replaced.

    Raises ValueError for one that is not contiguous, cannot be written or has more than three axes.
    """

    def __init__(self, arrays: Sequence[NDArray[Any]]) -> None:
        self._arrays = tuple(arrays)  # they live as long as their addresses are known
        self.table = np.ones((len(arrays), 1 + _MOST_AXES), np.int64)
        """(arrays, 4) address and shape of each."""
        for row, array in zip(self.table, arrays, strict=True):
            if not (array.flags.c_contiguous and array.flags.writeable and array.ndim <= _MOST_AXES):
                raise ValueError(f"arrays: got one of shape {array.shape}, must be contiguous and writable")
            row[0] = array.ctypes.data
            row[1 : 1 + array.ndim] = array.shape


def _taker(kind: Any, axes: int, *, fixed: bool = False) -> Any:
    @intrinsic  # type: ignore[untyped-decorator]
    def take(typing: Any, table: Any, number: Any) -> Any:
        array = types.Array(kind, axes, "C", readonly=fixed)

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            rows = arrayobj.make_array(table)(context, builder, arguments[0])
            index = context.cast(builder, arguments[1], signature.args[1], types.intp)

            def entry(column: int) -> Any:
                at = [index, context.get_constant(types.intp, column)]
                return builder.load(cgutils.get_item_pointer(context, builder, table, rows, at))

            data = builder.inttoptr(entry(0), context.get_data_type(kind).as_pointer())
            shape = [entry(1 + axis) for axis in range(axes)]
            size = context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind)))
            strides = [size]
            for length in reversed(shape[1:]):
                strides.insert(0, builder.mul(strides[0], length))
            made = arrayobj.make_array(array)(context, builder)
            arrayobj.populate_array(made, data, shape, strides, size, None)
            return made._getvalue()

        return array(table, number), codegen

    return take


vector, matrix, cube = (_taker(types.float64, axes) for axes in (1, 2, 3))
"""Arrays of doubles; known to compiled code only."""
fixed_cube = _taker(types.float64, 3, fixed=True)
"""One that kernels know from elsewhere as read-only, and are compiled for as such."""
int_vector, int_matrix = (_taker(types.int64, axes) for axes in (1, 2))
byte_vector, byte_matrix = (_taker(types.uint8, axes) for axes in (1, 2))
code_matrix = _taker(types.uint32, 2)
