"""Explicit SIMD vectors of doubles for numba kernels.

Automatic vectorisation falls short in several ways: LLVM prefers 256-bit vectors even where 512-bit vectors
are twice as fast, vectorises only if it can prove that arrays do not overlap, and may keep sums in memory
instead of registers. With this module, a kernel specifies its vector operations explicitly. Each lane
accumulates its own sum in the order of the source code, so the result does not depend on the number of
threads or on how columns are distributed. On processors with vectors of fewer than LANES doubles, LLVM splits
each operation.

Vectors support +, − and *. A double in such an expression is broadcast to all lanes.
"""

from __future__ import annotations

import math
import operator
import sys
from typing import Any, Final

import llvmlite.binding
from llvmlite import ir
from numba import extending as typed_extending
from numba.core import types as typed_types
from numba.core.typing import templates as typed_templates

from skinnode.compiled.jit import numba

extending: Any = typed_extending  # Any, because numba's type hints do not allow this use
types: Any = typed_types
templates: Any = typed_templates
signature: Any = templates.signature


def _lanes() -> int:
    """Return 8 if numba compiles for a processor with AVX-512, otherwise 4."""
    chosen = numba.config.CPU_FEATURES
    if chosen is not None or numba.config.CPU_NAME is not None:
        return 8 if "+avx512f" in (chosen or "") else 4
    try:
        return 8 if llvmlite.binding.get_host_cpu_features().get("avx512f") else 4
    except RuntimeError:  # the CPU features are unknown on this platform
        return 4


LANES: Final = _lanes()
Lanes = Any
"""Vector of LANES doubles. The type exists only in compiled code; in Python, it is Any."""

_DOUBLE = ir.DoubleType()
_INT = ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_BITS = ir.VectorType(_INT, LANES)


class _LanesType(types.Type):  # type: ignore[misc]  # numba has no type hints
    def __init__(self) -> None:
        super().__init__(name=f"float64x{LANES}")


_LANES_TYPE = _LanesType()


@extending.register_model(_LanesType)
class _LanesModel(extending.models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _VECTOR)


def _constant(vector: Any, value: Any) -> Any:
    return ir.Constant(vector, [ir.Constant(vector.element, value)] * LANES)


def _splat(builder: Any, value: Any) -> Any:
    """Broadcast a double to all lanes; a vector is returned unchanged."""
    if value.type == _VECTOR:
        return value
    seed = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
    return builder.shuffle_vector(seed, ir.Constant(_VECTOR, ir.Undefined), zeros)


def _call(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    function = builder.module.globals.get(name)
    if function is None:
        shape = ir.FunctionType(result, [argument.type for argument in arguments])
        function = ir.Function(builder.module, shape, name)
    return builder.call(function, arguments)


def _require_row(row: Any) -> None:
    if not (isinstance(row, types.Array) and row.ndim == 1 and row.dtype == types.float64):
        raise TypeError(f"row: got {row}, must be one row of float64")


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


def _first(builder: Any, count: Any) -> Any:
    """Return a mask that selects the first ``count`` lanes."""
    undefined = ir.Constant(_BITS, ir.Undefined)
    seed = builder.insert_element(undefined, count, ir.Constant(ir.IntType(32), 0))
    every = builder.shuffle_vector(seed, undefined, ir.Constant(ir.VectorType(ir.IntType(32), LANES), None))
    return builder.icmp_signed("<", ir.Constant(_BITS, [ir.Constant(_INT, i) for i in range(LANES)]), every)


def _binary(symbol: Any, in_place: Any, method: str) -> None:
    class Template(templates.ConcreteTemplate):  # type: ignore[misc]
        cases = [  # noqa: RUF012  # numba requires a list
            signature(_LANES_TYPE, _LANES_TYPE, _LANES_TYPE),
            signature(_LANES_TYPE, types.float64, _LANES_TYPE),
            signature(_LANES_TYPE, _LANES_TYPE, types.float64),
        ]

    def lower(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return getattr(builder, method)(*(_splat(builder, argument) for argument in arguments))

    for symbol_ in (symbol, in_place):
        templates.infer_global(symbol_)(Template)
        for case in Template.cases:
            extending.lower_builtin(symbol_, *case.args)(lower)


_binary(operator.add, operator.iadd, "fadd")
_binary(operator.sub, operator.isub, "fsub")
_binary(operator.mul, operator.imul, "fmul")


@extending.intrinsic  # type: ignore[untyped-decorator]
def load(_typing: Any, row: Any, start: Any, count: Any) -> Any:
    """Load up to LANES elements of a row into a vector; lanes with an index of ``count`` or above are 0.

    Args:
        row: Contiguous row of float64.
        start: Index of the first element.
        count: Number of elements to load; values above LANES are treated as LANES.
    """
    _require_row(row)

    def generate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        address = _address(context, builder, sig.args[0], arguments[0], arguments[1])
        aligned = ir.Constant(ir.IntType(32), 8)
        inputs = [address, aligned, _first(builder, arguments[2]), ir.Constant(_VECTOR, None)]
        return _call(builder, f"llvm.masked.load.v{LANES}f64.p0", _VECTOR, inputs)

    return signature(_LANES_TYPE, row, types.int64, types.int64), generate


@extending.intrinsic  # type: ignore[untyped-decorator]
def store(_typing: Any, row: Any, start: Any, count: Any, value: Any) -> Any:
    """Store the first ``count`` lanes of a vector in a row.

    Args:
        row: Contiguous row of float64.
        start: Index of the first element.
        count: Number of lanes to store; values above LANES are treated as LANES.
        value: The vector.
    """
    _require_row(row)

    def generate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        address = _address(context, builder, sig.args[0], arguments[0], arguments[1])
        aligned = ir.Constant(ir.IntType(32), 8)
        inputs = [arguments[3], address, aligned, _first(builder, arguments[2])]
        _call(builder, f"llvm.masked.store.v{LANES}f64.p0", ir.VoidType(), inputs)
        return context.get_dummy_value()

    return signature(types.void, row, types.int64, types.int64, value), generate


@extending.intrinsic  # type: ignore[untyped-decorator]
def splat(_typing: Any, value: Any) -> Any:
    """Return a vector with ``value`` in all lanes."""

    def generate(_context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
        return _splat(builder, arguments[0])

    return signature(_LANES_TYPE, types.float64), generate


@extending.intrinsic  # type: ignore[untyped-decorator]
def fma(_typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a·b + c, rounded only once if the processor has a fused multiply-add instruction."""

    def generate(_context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
        inputs = [_splat(builder, argument) for argument in arguments]
        return _call(builder, f"llvm.fmuladd.v{LANES}f64", _VECTOR, inputs)

    return signature(_LANES_TYPE, a, b, c), generate


@extending.intrinsic  # type: ignore[untyped-decorator]
def drop(_typing: Any, value: Any, count: Any) -> Any:
    """Return ``value`` with its first ``count`` lanes set to 0."""

    def generate(_context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
        return builder.select(_first(builder, arguments[1]), ir.Constant(_VECTOR, None), arguments[0])

    return signature(_LANES_TYPE, value, types.int64), generate


@extending.intrinsic  # type: ignore[untyped-decorator]
def total(_typing: Any, value: Any) -> Any:
    """Return the sum of all lanes, computed by repeatedly adding one half of the vector to the other."""

    def generate(_context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
        value, width = arguments[0], LANES
        while width > 1:
            width //= 2
            upper = [ir.Constant(ir.IntType(32), (i + width) % LANES) for i in range(LANES)]
            mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), upper)
            value = builder.fadd(value, builder.shuffle_vector(value, value, mask))
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return signature(types.float64, value), generate


@extending.intrinsic  # type: ignore[untyped-decorator]
def rough_inverse_root(_typing: Any, value: Any) -> Any:
    """Return 1 / √value with an error below 3.5 %; inf for values below the smallest normal number.

    The result is obtained by bit manipulation (Lomont, Fast inverse square root, 2003, for doubles).
    """

    def generate(_context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], _BITS)
        halved = builder.lshr(bits, _constant(_BITS, 1))
        guess = builder.bitcast(builder.sub(_constant(_BITS, 0x5FE6EB50C7B537A9), halved), _VECTOR)
        least = _constant(_VECTOR, sys.float_info.min)
        tiny = builder.fcmp_ordered("<", arguments[0], least)
        return builder.select(tiny, _constant(_VECTOR, math.inf), guess)

    return signature(_LANES_TYPE, value), generate
