"""Data drawn at one instant, and the electrode positions that have changed since the last one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from skinnode.config import HandConfig
from skinnode.host.events import HealthEvent
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout
from skinnode.monitor.source import supplied_m
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
    supplied_m: Mapping[str, Float] = field(default_factory=dict)
    """(U, N, 3) electrode positions at rest, in m, by patch name; contains the patches whose nodes have
    supplied positions other than those drawn so far."""


class SuppliedPositions:
    """Record of the electrode positions already passed on, so that each is passed on only once.

    Args:
        hand: The hand.
        layout: Function that returns the layout used to compute a patch's fields.
    """

    def __init__(self, hand: HandConfig, layout: Callable[[str], PatchLayout]) -> None:
        self._hand, self._layout = hand, layout
        self._drawn_m: dict[str, Float] = {}

    def changed(self) -> dict[str, Float]:
        """Return the positions that differ from those returned before; see :attr:`Tick.supplied_m`."""
        now_m = supplied_m(self._hand, self._layout)
        before_m, self._drawn_m = self._drawn_m, now_m
        return {
            name: rest_m
            for name, rest_m in now_m.items()
            if name not in before_m or not np.array_equal(rest_m, before_m[name])
        }
