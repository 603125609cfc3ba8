"""Words for people that more than one room uses."""

from __future__ import annotations


def counted(number: int, one: str, several: str = "") -> str:
    """``1 node``, ``2 nodes``; ``several`` where that is not ``one`` and an s."""
    return f"{number} {one}" if number == 1 else f"{number} {several or one + 's'}"


def known(value: object) -> str:
    """Return ``value`` as text, or *unknown* if it is None, because messages never show ``None``."""
    return "unknown" if value is None else str(value)
