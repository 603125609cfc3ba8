"""Data drawn at one instant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skinnode.host.events import HealthEvent
from skinnode.model.frames import FieldFrame
from skinnode.monitor.view_model import View
from skinnode.view.texts import DrawnCounts


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """Data drawn at one instant."""

    t_ns: int
    """Time on the source's monotonic clock, in ns."""
    fields: Mapping[str, FieldFrame]
    """New fields, by patch name."""
    counts: DrawnCounts
    view: View | None = None
    """State of the hand; None if the state is not drawn at this instant."""
    events: Sequence[HealthEvent] = ()
