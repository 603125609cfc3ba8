"""Find the patches and buses whose health may have changed since the last check.

Most checks find nothing new. Comparing the few facts that matter is much faster than creating the
:class:`~skinnode.host.health.PatchHealth` of every patch and the :class:`~skinnode.host.health.BusHealth` of
every bus.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

_Health = TypeVar("_Health")


class HealthMemory(Generic[_Health]):
    """Last health of each subject, which is created again only if its facts have changed.

    Args:
        subjects: Names of the subjects.
        facts: Function that returns everything that determines the health of a subject, apart from ages and
            the bus load; None if the health must be created in any case.
        health: Function that creates the health of a subject.
    """

    def __init__(
        self,
        subjects: Mapping[str, object],
        facts: Callable[[str], object | None],
        health: Callable[[str], _Health],
    ) -> None:
        self._subjects, self._facts, self._health = tuple(subjects), facts, health
        self._known: dict[str, tuple[object, _Health]] = {}

    def __call__(self) -> dict[str, _Health]:
        """Return the health of each subject: if nothing has changed, the same object as in the last call."""
        return {name: self._of(name) for name in self._subjects}

    def _of(self, name: str) -> _Health:
        facts = self._facts(name)
        if facts is None:
            self._known.pop(name, None)
            return self._health(name)
        known = self._known.get(name)
        if known is not None and known[0] == facts:
            return known[1]
        health = self._health(name)
        self._known[name] = facts, health
        return health
