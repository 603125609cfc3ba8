"""Finds published hands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from skinnode.remote import keys

if TYPE_CHECKING:
    import zenoh

_ANSWER_S: Final = 5.0
"""Time limit for replies from daemons and routers, in s. It is reached only on an overloaded machine or over
a connection that has just failed."""


def tokens(session: zenoh.Session, hand: str | None = None) -> list[str]:
    """Return the tokens of all daemons of a hand, or of all hands if ``hand`` is None."""
    replies = session.liveliness().get(keys.hand_tokens(hand), timeout=_ANSWER_S)
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


def published_hands(session: zenoh.Session) -> list[str]:
    """Return the names of all published hands, sorted."""
    return sorted({keys.hand_of(token) for token in tokens(session)})
