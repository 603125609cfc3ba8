"""Tables that pass many arrays and numbers to a kernel in one argument.

Numba checks and unpacks every argument on every call, which takes 4 to 40 µs for the fifty arrays of a patch.
An :class:`ArrayTable` passes a single array that contains the addresses and shapes of all arrays. A subclass
declares the fields once, for Python and for kernels:

    class Scan(ArrayTable):
        ohm: Annotated[NDArray[np.float64], "U K"]     # element type and axes
        limit: float                                   # a number, fixed at construction

    scan_of = reader(Scan)                             # for compiled code

    @njit
    def kernel(table): scan = scan_of(table); scan.ohm[0, 0] = scan.limit

    kernel(Scan(ohm=np.zeros((10, 30)), limit=1.0).table)

Fields are accessed by name, so their order does not matter. The constructor checks the element type, the
number of axes and the contiguity of each array, and that axes with the same name have the same length. The
first entry of a table is a digest of its declaration. A kernel that receives a table of another class raises
TypeError.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Final, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numba.core import cgutils as typed_cgutils
from numba.core import errors as typed_errors
from numba.core import imputils as typed_imputils
from numba.core import types as typed_types
from numba.core.typing import templates as typed_templates
from numba.extending import intrinsic as typed_intrinsic
from numba.extending import models as typed_models
from numba.extending import register_model as typed_register_model
from numba.np import arrayobj as typed_arrayobj
from numpy.typing import NDArray

cgutils: Any = typed_cgutils  # Any, because numba's type hints do not allow this use
errors: Any = typed_errors
imputils: Any = typed_imputils
types: Any = typed_types
templates: Any = typed_templates
intrinsic: Any = typed_intrinsic
models: Any = typed_models
register_model: Any = typed_register_model
arrayobj: Any = typed_arrayobj

READONLY: Final = "readonly"
"""Annotation of an array that kernels may only read."""
_AXES_MAX: Final = 3
_COLUMNS: Final = 1 + _AXES_MAX
_T = TypeVar("_T", bound="ArrayTable")


@dataclass(frozen=True)
class _Field:
    """Field of a table: an array, or a number if ``axes`` is None."""

    name: str
    dtype: str
    axes: tuple[str, ...] | None
    readonly: bool = False

    def kernel_type(self) -> Any:
        kind = types.uint8 if self.dtype == "bool" else getattr(types, self.dtype)
        return kind if self.axes is None else types.Array(kind, len(self.axes), "C", readonly=self.readonly)

    def check(self, table: str, array: Any, lengths: dict[str, int]) -> None:
        """Raise TypeError unless ``array`` matches the declaration and the axis ``lengths`` known so far."""
        assert self.axes is not None
        if not isinstance(array, np.ndarray):
            raise TypeError(f"{table}.{self.name}: got {type(array).__name__}, {self._wanted()}")
        flags = array.flags
        usable = flags.c_contiguous and (flags.writeable or self.readonly)
        if array.dtype != self.dtype or array.ndim != len(self.axes) or not usable:
            layout = "" if flags.c_contiguous else "not contiguous, "
            layout += "" if flags.writeable or self.readonly else "read-only, "
            raise TypeError(
                f"{table}.{self.name}: got {array.dtype} of shape {array.shape}, {layout}{self._wanted()}"
            )
        for axis, length in zip(self.axes, array.shape, strict=True):
            due = int(axis) if axis.isdigit() else lengths.setdefault(axis, length)
            if length != due:
                raise TypeError(
                    f"{table}.{self.name}: got shape {array.shape}, {self._wanted()} where {axis} is {due}"
                )

    def _wanted(self) -> str:
        """Return the requirements on the array, for an error message."""
        return f"must be a contiguous, writable {self.dtype} array with axes ({', '.join(self.axes or ())})"


@dataclass(frozen=True)
class _Group:
    """Group of fields declared as a NamedTuple, which kernels read as a tuple."""

    name: str
    made_of: type
    fields: tuple[_Field, ...]


def _field(table: str, name: str, hint: Any) -> _Field:
    if hint in (float, int):
        return _Field(name, "float64" if hint is float else "int64", None)
    array, *notes = get_args(hint) or (None,)
    if get_origin(array) is np.ndarray and notes and isinstance(notes[0], str):
        dtype = np.dtype(get_args(get_args(array)[1])[0]).name
        axes = tuple(notes[0].split())
        if len(axes) <= _AXES_MAX:
            return _Field(name, dtype, axes, READONLY in notes[1:])
    raise TypeError(
        f"{table}.{name}: declared as {hint}, must be float, int, a NamedTuple or "
        f"Annotated[NDArray[...], axes] with at most {_AXES_MAX} axes"
    )


def _declared(table: str, hints: dict[str, Any]) -> tuple[_Field | _Group, ...]:
    fields: list[_Field | _Group] = []
    for name, hint in hints.items():
        if isinstance(hint, type) and issubclass(hint, tuple):
            inner = get_type_hints(hint, include_extras=True)
            fields.append(_Group(name, hint, tuple(_field(table, n, inner[n]) for n in hint._fields)))  # type: ignore[attr-defined]
        else:
            fields.append(_field(table, name, hint))
    return tuple(fields)


class ArrayTable:
    """Base class for tables of named arrays and numbers; a subclass declares its fields as annotations.

    Args:
        values: Value of each declared field. Arrays are not copied; write to them in place.

    Raises TypeError if a field is missing or unknown, if an array is not contiguous or not writable, or if
    its element type, number of axes or length differs from the declaration.
    """

    table: NDArray[np.int64]
    """(1 + fields, 4) int64: argument for kernels. The first row contains the digest of the declaration; each
    of the other rows contains the address and the shape of a field."""
    _fields: ClassVar[tuple[_Field | _Group, ...]] = ()
    _names: ClassVar[frozenset[str]] = frozenset()
    _rows: ClassVar[dict[str, int]] = {}
    _digest: ClassVar[int] = 0

    def __init_subclass__(cls) -> None:
        hints = get_type_hints(cls, include_extras=True)
        declared = {n: hint for n, hint in hints.items() if n in cls.__annotations__}
        cls._fields = _declared(cls.__name__, declared)
        cls._names = frozenset(declared)
        cls._rows, row = {}, 1
        for field in cls._fields:
            cls._rows[field.name] = row
            row += len(field.fields) if isinstance(field, _Group) else 1
        digest = hashlib.sha256(repr((cls.__qualname__, cls._fields)).encode()).digest()
        cls._digest = int.from_bytes(digest[:8], "little", signed=True)

    def __init__(self, **values: Any) -> None:
        name = type(self).__name__
        if wrong := self._names ^ values.keys():
            raise TypeError(
                f"{name}: got {', '.join(values)}; missing or unknown: {', '.join(sorted(wrong))}"
            )
        table = np.ones((1 + sum(len(getattr(f, "fields", "1")) for f in self._fields), _COLUMNS), np.int64)
        table[0] = self._digest
        lengths: dict[str, int] = {}
        for field in self._fields:
            value, row = values[field.name], self._rows[field.name]
            if isinstance(field, _Group):
                for i, inner in enumerate(field.fields):
                    _enter(name, inner, getattr(value, inner.name), table[row + i], lengths)
            else:
                _enter(name, field, value, table[row], lengths)
        vars(self).update(values, table=table)  # keeps the arrays alive

    def __setattr__(self, name: str, value: object) -> None:
        if name in self._names and value is not getattr(self, name):  # allows ``table.x += 1``
            raise AttributeError(
                f"{type(self).__name__}.{name}: cannot be replaced; write to the array in place"
            )
        super().__setattr__(name, value)


def _enter(table: str, field: _Field, value: Any, row: NDArray[np.int64], lengths: dict[str, int]) -> None:
    if field.axes is None:
        if not isinstance(value, float if field.dtype == "float64" else int):
            raise TypeError(f"{table}.{field.name}: got {value!r}, must be {field.dtype}")
        row[0] = struct.unpack("<q", struct.pack("<d" if field.dtype == "float64" else "<q", value))[0]
        return
    field.check(table, value, lengths)
    row[0] = value.ctypes.data
    row[1 : 1 + value.ndim] = value.shape


class _ViewType(types.Type):  # type: ignore[misc]  # numba has no type hints
    """Numba type of an :class:`ArrayTable` in a kernel, represented by the address of the table."""

    def __init__(self, made_of: type[ArrayTable]) -> None:
        self.made_of = made_of
        super().__init__(name=f"{made_of.__qualname__}({made_of._digest:#x})")

    def field(self, name: str) -> _Field | _Group | None:
        return next((field for field in self.made_of._fields if field.name == name), None)


@register_model(_ViewType)
class _ViewModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, cgutils.intp_t.as_pointer())


def reader(made_of: type[_T]) -> Callable[[NDArray[np.int64]], _T]:
    """Return a function that kernels use to access the fields of a table by name.

    The function can only be called in compiled code. It raises TypeError if the table is not an instance of
    ``made_of``. Each field access reads the table again, so access fields outside loops. In kernels, bool
    arrays have the element type uint8.
    """
    view, digest = _ViewType(made_of), made_of._digest
    message = f"table: got a table of another class, must be the table of a {made_of.__name__}"

    @intrinsic  # type: ignore[untyped-decorator]
    def read(_typing: Any, table: Any) -> Any:
        if table != types.Array(types.int64, 2, "C"):
            raise errors.TypingError(f"table: got {table}, must be the table of a {made_of.__name__}")

        def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            data = arrayobj.make_array(table)(context, builder, arguments[0]).data
            other = builder.icmp_unsigned("!=", builder.load(data), context.get_constant(types.int64, digest))
            with builder.if_then(other, likely=False):
                context.call_conv.return_user_exc(builder, TypeError, (message,))
            return data

        return view(table), generate

    function: Callable[[NDArray[np.int64]], _T] = read
    return function


@templates.infer_getattr
class _Attributes(templates.AttributeTemplate):  # type: ignore[misc]
    key = _ViewType

    def generic_resolve(self, view: Any, name: str) -> Any:
        field = view.field(name)
        if isinstance(field, _Group):
            return types.BaseTuple.from_types([inner.kernel_type() for inner in field.fields], field.made_of)
        return field and field.kernel_type()


@imputils.lower_getattr_generic(_ViewType)  # type: ignore[untyped-decorator]
def _read_field(context: Any, builder: Any, view: Any, value: Any, name: str) -> Any:
    field, row = view.field(name), view.made_of._rows[name]
    if isinstance(field, _Group):
        members = [_read(context, builder, value, row + i, inner) for i, inner in enumerate(field.fields)]
        made = types.BaseTuple.from_types([inner.kernel_type() for inner in field.fields], field.made_of)
        return context.make_tuple(builder, made, members)
    return _read(context, builder, value, row, field)


def _read(context: Any, builder: Any, table: Any, row: int, field: _Field) -> Any:
    def entry(column: int) -> Any:
        at = context.get_constant(types.intp, row * _COLUMNS + column)
        return builder.load(builder.gep(table, [at]))

    kind = field.kernel_type()
    if field.axes is None:
        return builder.bitcast(entry(0), context.get_data_type(kind))
    data = builder.inttoptr(entry(0), context.get_data_type(kind.dtype).as_pointer())
    shape = [entry(1 + axis) for axis in range(kind.ndim)]
    size = context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    strides = [size]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    made = arrayobj.make_array(kind)(context, builder)
    arrayobj.populate_array(made, data, shape, strides, size, None)
    return made._getvalue()
