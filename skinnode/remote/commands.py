"""Sends commands to a hand's daemon."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

from skinnode.errors import NodeError, NodeTimeout, SkinError
from skinnode.remote import keys

if TYPE_CHECKING:
    import zenoh

REPLY_S: Final = 2.0
"""Time limit for a reply, s, in addition to the time limit of the command."""


def send(session: zenoh.Session, hand: str, request: dict[str, Any], deadline_s: float) -> None:
    """Send a command and wait until it has been executed.

    Args:
        session: Session of the program.
        hand: Name of the hand.
        request: See :mod:`skinnode.remote.command_server`.
        deadline_s: Time limit of the command, s.

    Raises:
        NodeError: if the host raises one, for example NodeTimeout.
        SkinError: if no daemon accepts the command in time.
    """
    payload = json.dumps(request).encode()
    for reply in session.get(keys.command_key(hand), payload=payload, timeout=deadline_s + REPLY_S):
        if reply.ok is not None:
            return
        if reply.err is not None:
            raise _error(reply.err.payload.to_bytes(), hand)
    raise SkinError(
        f"hand {hand!r}: no reply to {request['command']} within {deadline_s + REPLY_S:g} s; check "
        "that its daemon is running (skinnode host --publish --commands) and that access control permits the "
        "command"
    )


def _error(data: bytes, hand: str) -> SkinError:
    try:
        table = json.loads(data)
        kind, text = table["kind"], str(table["text"])
        if kind in ("NodeError", "NodeTimeout"):
            return (NodeTimeout if kind == "NodeTimeout" else NodeError)(int(table["node_id"]), text)
    except (ValueError, KeyError, TypeError):
        text = data[:200].decode(errors="replace")  # such as "Timeout", from Zenoh itself
    return SkinError(f"hand {hand!r}: {text}")
