"""Converts fields to table rows: one row per field, with a value in every column.

Values missing from a field are filled in: NaN for an unknown number, False for an unknown mask, 1 for an
unknown data share, and ``displacement_std_m`` for an unknown ``core_std_m``. The ``tested`` column shows
whether ``wires_trusted`` is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.frames import FieldFrame, ResistanceFrame

FORMAT: Final = "skinnode fields 1"
"""Format and version of a field table; stored in every file."""
PREFIX: Final = "skinnode fields "

NUMBERS: Final = {
    "scan": "<i8",
    "counter": "|u1",
    "device_time_us": "<u4",
    "time_ns": "<i8",
    "t_sync_ns": "<i8",
    "t_receive_ns": "<i8",
    "trusted": "|b1",
    "tested": "|b1",
    "precise": "|b1",
    "noise_factor": "<f8",
    "touched": "|i1",
    "touch_odds": "<f8",
}
"""Columns with one number per field, and their types. ``time_ns`` is the Unix time (ns) of the SYNC
or, if the SYNC is unknown, of the last frame. The other times are on the host's monotonic clock. ``touched``
is 1 or 0, or -1 if unknown; unknown ``touch_odds`` are NaN."""
TEXTS: Final = ("method", "distrust")
"""Columns with one string per field."""
WIRES: Final = {
    "status": "|u1",
    "residual": "<f8",
    "wires_trusted": "|b1",
    "by_prior": "|b1",
    "held": "|b1",
    "gain": "<f8",
}
"""(U,): columns with one value per upper wire, and their types."""
POINTS: Final = ("displacement_m", "displacement_std_m", "core_std_m", "data_share", "force_n")
"""(U, N, 3) float64: columns with one vector per electrode."""
CROSSINGS: Final = ("resistance_ohm",)
"""(U, K) float64: columns with one value per crossing; NaN where the value was not used."""

Columns = dict[str, Any]


@dataclass(frozen=True, slots=True)
class FieldRow:
    """Row of a field table."""

    patch: str
    columns: Columns
    """Values, by column name, of all columns in :data:`NUMBERS`, :data:`TEXTS`, :data:`WIRES`, :data:`POINTS`
    and :data:`CROSSINGS`."""
    contacts: list[Columns] | None = None
    """Contacts; None if unknown."""
    faults: list[Columns] | None = None
    """Data faults; None if unknown."""


def row_of(field: FieldFrame, resistance: ResistanceFrame, offset_ns: int) -> FieldRow:
    """Convert a field to a table row.

    Args:
        field: The field; must have a stamp.
        resistance: Resistances from which the field was computed.
        offset_ns: Unix time minus time on the stamp's clock, in ns.
    """
    stamp, shape = field.stamp, field.displacement_m.shape
    assert stamp is not None
    columns: Columns = {
        "scan": stamp.scan,
        "counter": stamp.counter,
        "device_time_us": stamp.device_time_us,
        "time_ns": (stamp.t_sync_ns or stamp.t_receive_ns) + offset_ns,
        "t_sync_ns": stamp.t_sync_ns,
        "t_receive_ns": stamp.t_receive_ns,
        "trusted": field.trusted,
        "tested": field.distrust is not None,
        "precise": bool(field.precise),
        "noise_factor": float(field.noise_factor),
        "touched": -1 if field.touched is None else int(field.touched),
        "touch_odds": math.nan if field.touch_odds is None else field.touch_odds,
        "method": field.method,
        "distrust": field.distrust or "",
        "status": np.array(field.status, dtype=np.uint8),
        "residual": np.asarray(field.residual, dtype=np.float64),
        "wires_trusted": _or(field.wires_trusted, False, shape[:1]),
        "by_prior": _or(field.by_prior, False, shape[:1]),
        "held": _or(field.held, False, shape[:1]),
        "gain": _or(field.gain, np.nan, shape[:1]),
        "displacement_m": field.displacement_m,
        "displacement_std_m": field.displacement_std_m,
        "core_std_m": field.displacement_std_m if field.core_std_m is None else field.core_std_m,
        "data_share": _or(field.data_share, 1.0, shape),
        "force_n": _or(field.force_n, np.nan, shape),
        "resistance_ohm": resistance.resistance_ohm,
    }
    contacts = [
        {
            "centroid_m": each.centroid_m.tolist(),
            "centroid_std_m": each.centroid_std_m.tolist(),
            "axes": each.axes.reshape(-1).tolist(),
            "area_m2": float(each.area_m2),
            "area_std_m2": float(each.area_std_m2),
            "normal_force_n": float(each.normal_force_n),
            "normal_force_std_n": float(each.normal_force_std_n),
            "shear_force_n": each.shear_force_n.tolist(),
            "shear_force_std_n": each.shear_force_std_n.tolist(),
            "force_calibrated": bool(each.force_calibrated),
        }
        for each in field.contacts
    ]
    faults = [
        {
            "part": str(each.part),
            "kind": str(each.kind),
            "upper": each.upper,
            "lower": each.lower,
            "since": each.since,
            "deviations": float(each.deviations),
        }
        for each in field.faults
    ]
    return FieldRow(stamp.patch, columns, contacts, faults)


def _or(values: NDArray[Any] | None, missing: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    return np.full(shape, missing) if values is None else np.asarray(values)
