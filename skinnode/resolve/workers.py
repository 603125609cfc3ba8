"""Interface of the workers that run units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from skinnode.resolve.units import Unit


class Workers(Protocol):
    """Workers that run units in any order."""

    @property
    def count(self) -> int:
        """Number of units that can run at the same time."""

    def submit(self, unit: Unit) -> None:
        """Run a unit as soon as a worker is free."""

    def finished(self, timeout_s: float) -> Sequence[str]:
        """Wait at most ``timeout_s`` seconds for finished units and return their keys.

        Raises:
            SkinError: A unit or all workers failed.
        """

    def close(self) -> None:
        """Stop the running units and the workers."""


MOST_DEATHS = 3
"""Number of lost workers after which the unit that they were running fails."""
