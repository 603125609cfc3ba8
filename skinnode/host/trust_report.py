"""Summarise how far a field can be trusted, for reports and JSON output."""

from __future__ import annotations

from typing import Any

import numpy as np

from skinnode.model.data_fault import DataFault
from skinnode.model.distrust_text import why_not
from skinnode.model.frames import FieldFrame
from skinnode.text.json_values import plain


def trust_table(field: FieldFrame | None) -> dict[str, Any]:
    """Return the trust, precision, data share and faults of a field.

    If there is no field, all values are None. For the data share, see :func:`deepest_data_share`.
    """
    if field is None:
        return dict.fromkeys(("trusted", "distrust", "precise", "deepest_data_share", "data_faults"))
    table: dict[str, Any] = plain(
        {
            "trusted": field.trusted,
            "distrust": why_not(field),
            "precise": field.precise,
            "deepest_data_share": deepest_data_share(field),
            "data_faults": [fault_table(fault) for fault in field.faults],
        }
    )
    return table


def deepest_data_share(field: FieldFrame) -> float:
    """Return the data share of the z displacement at the most deeply pressed electrode; 1 without a prior."""
    if field.data_share is None:
        return 1.0
    return float(field.data_share[..., 2].flat[int(np.argmin(field.displacement_m[..., 2]))])


def fault_table(fault: DataFault) -> dict[str, Any]:
    """Return a fault as a dict for JSON. An infinite ``deviations`` becomes None."""
    table: dict[str, Any] = plain(
        {
            "part": str(fault.part),
            "kind": str(fault.kind),
            "upper": fault.upper,
            "lower": fault.lower,
            "since": fault.since,
            "deviations": float(fault.deviations),
        }
    )
    return table
