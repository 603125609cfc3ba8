"""Base class and common value types of the tables in a hand file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

from skinnode.canopen.indices import MAX_NODE_ID


@dataclass(frozen=True, slots=True)
class Allowed:
    """Annotation that describes the allowed values of a key in error messages."""

    text: str


class Table(BaseModel):
    """Base class for the tables of the hand file.

    The docstring of a key is its description in the JSON Schema
    (:func:`skinnode.config.descriptions.descriptions_of`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


def one_of(names: Any) -> Allowed:
    """Return an annotation that lists the values of a Literal as the allowed values."""
    return Allowed(" or ".join(map(str, get_args(names))))


def existing_file(value: Path | None, info: ValidationInfo, what: str) -> Path | None:
    """Resolve a path relative to the folder of the hand file, and check that the file exists.

    Raises:
        ValueError: The file does not exist.
    """
    if value is None:
        return None
    path = Path((info.context or {}).get("folder", Path()), value)
    if not path.is_file():
        raise ValueError(f"{what}; there is no file {path}")
    return path


_NAME: Final = "a string of 1 to 64 printable characters, not all blank"


def _printable(value: str) -> str:
    """Reject a name that is blank or not printable, because names are printed unescaped."""
    if not value.isprintable() or not value.strip():
        raise ValueError(_NAME)
    return value


Name = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_printable), Allowed(_NAME)]
Count = Annotated[int, Field(ge=1, le=254), Allowed("an integer from 1 to 254")]
NodeId = Annotated[int, Field(ge=1, le=MAX_NODE_ID), Allowed(f"an integer from 1 to {MAX_NODE_ID}")]
Length = Annotated[float, Field(ge=1e-6, le=1.0, allow_inf_nan=False), Allowed("a number from 1e-6 to 1 (m)")]
Ratio = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False), Allowed("a non-negative number below 1")]
Stiffness = Annotated[
    float, Field(ge=1e-3, le=1e12, allow_inf_nan=False), Allowed("a number from 1e-3 to 1e12 (N/m)")
]
