"""Explains in words why a displacement field is not trusted."""

from __future__ import annotations

from collections import Counter

from skinnode.model.frames import FieldFrame
from skinnode.model.status import Status


def why_not(field: FieldFrame) -> str:
    """Return the reason why a field is not trusted; empty if the field is trusted.

    For a field that was not tested, this is the number of wires with each status other than CONVERGED.
    """
    if field.trusted:
        return ""
    if field.distrust:
        return field.distrust
    counts = Counter(status for status in field.status if status is not Status.CONVERGED)
    parts = [f"{count} {status.name}" for status, count in counts.most_common()]
    return f"not all wires CONVERGED: {', '.join(parts)}"
