"""Formats counted nouns and unknown values for messages."""

from __future__ import annotations


def counted(number: int, one: str, several: str = "") -> str:
    """Return a number followed by a noun, such as ``1 node`` or ``2 nodes``.

    Args:
        number: The number.
        one: The noun in the singular.
        several: The noun in the plural; default: ``one`` followed by s.
    """
    return f"{number} {one}" if number == 1 else f"{number} {several or one + 's'}"


def known(value: object) -> str:
    """Convert ``value`` to text; None becomes "unknown", because messages must not contain ``None``."""
    return "unknown" if value is None else str(value)
