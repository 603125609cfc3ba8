"""Lists all conformance cases, and selects cases by area or ID."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from skinnode.conformance.case import Case
from skinnode.conformance.cases import AREAS
from skinnode.errors import ConfigError

CASES: Final[tuple[Case, ...]] = tuple(
    item for area in AREAS for item in vars(area).values() if isinstance(item, Case)
)
"""All conformance cases, in the order of the test plan."""


def select(names: Sequence[str]) -> tuple[Case, ...]:
    """Select conformance cases by area or ID.

    Args:
        names: Areas and IDs; an empty sequence selects all cases.

    Returns:
        The cases, in the order of the test plan.

    Raises:
        ConfigError: A name is neither an area nor an ID.
    """
    if not names:
        return CASES
    wanted = {name.strip().upper() for name in names if name.strip()}
    known = {case.id for case in CASES} | {case.area for case in CASES}
    for name in sorted(wanted - known) if wanted else [",".join(names)]:
        areas = ", ".join(dict.fromkeys(case.area for case in CASES))
        raise ConfigError("--only", name, f"an area ({areas}) or a case such as SDO-07")
    return tuple(case for case in CASES if case.id in wanted or case.area in wanted)
