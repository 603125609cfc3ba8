"""All that the facts say of a hand, room by room. Pure functions over :class:`BusFacts`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from skinnode.doctor import bus, configuration, nodes, skin, timing
from skinnode.doctor.facts import BusFacts, Finding, Sure

_SURENESS: Final = {sure: rank for rank, sure in enumerate(Sure)}


def diagnose(facts: BusFacts) -> list[Finding]:
    """All findings of a bus, the surest first within each area."""
    checks: tuple[Callable[[BusFacts], Iterator[Finding]], ...] = (
        bus.check_bus,
        bus.check_masters,
        nodes.check_nodes,
        configuration.check_configuration,
        skin.check_wires,
        skin.check_noise,
        skin.check_baseline,
        timing.check_timing,
        timing.check_losses,
    )
    return [
        finding
        for check in checks
        for finding in sorted(check(facts), key=lambda found: _SURENESS[found.sure])
    ]
