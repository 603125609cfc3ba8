"""The analogue port of a patch: where a converter, or the simulator, is plugged in."""

from __future__ import annotations

from typing import Protocol

from skinnode.model.layout import Float


class ResistanceSource(Protocol):
    """Whatever measures the resistances between upper and lower wires."""

    def read(self, t_ns: int) -> Float:
        """(U, K) wire-to-wire resistances at ``t_ns`` (monotonic), ohm: infinite where a wire is open, 0
        where it is shorted. The array is only read, and not kept beyond the call."""
        ...
