"""Formats numbers with nouns, and unknown values, for messages."""

from __future__ import annotations


def counted(number: int, one: str, several: str = "") -> str:
    """Return a number with its noun in the singular or plural, such as ``1 node`` or ``2 nodes``.

    Args:
        number: The number.
        one: Singular of the noun.
        several: Plural of the noun; by default, the singular followed by "s".
    """
    return f"{number} {one}" if number == 1 else f"{number} {several or one + 's'}"


def known(value: object) -> str:
    """Return ``value`` as text for a message; None becomes "unknown"."""
    return "unknown" if value is None else str(value)
