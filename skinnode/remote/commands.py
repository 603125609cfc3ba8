"""Commands from a program to a hand's daemon, and their replies."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Final

from skinnode.errors import NodeError, NodeTimeout, SkinError
from skinnode.host.containment import one_line
from skinnode.process import clock
from skinnode.remote import keys
from skinnode.remote.description import boot_id

if TYPE_CHECKING:
    import zenoh

REPLY_S: Final = 2.0
"""Time limit for a reply, in s, in addition to the time limit of the command. At most half of this time may
pass while other commands are executed."""


@dataclass(frozen=True, slots=True)
class Request:
    """Command of a program. JSON; a program in another language may omit the last three keys."""

    command: str
    """``tare`` or ``reset_node``."""
    patch: str
    """Name of the patch."""
    deadline_s: float | None = None
    """Time limit of the command, in s; by default, the time limit of a tare."""
    boot_id: str = field(default_factory=boot_id)
    """Boot ID of the program's operating system."""
    sent_ns: int = field(default_factory=clock.monotonic_ns)
    """Time at which the program sent the command, on its monotonic clock, in ns."""

    @classmethod
    def decode(cls, data: bytes) -> Request:
        """Decode a request.

        Raises:
            SkinError: if the data are not a valid request.
        """
        try:
            table = json.loads(data)
            deadline_s = None if table.get("deadline_s") is None else float(table["deadline_s"])
            sender = str(table.get("boot_id", "")), int(table.get("sent_ns", 0))
            return cls(str(table["command"]), str(table["patch"]), deadline_s, *sender)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
            raise SkinError(f"request: got {data[:40]!r}, must be JSON with command and patch") from None

    def waited_s(self, arrived_ns: int) -> float:
        """Return the time in s since the program sent the command, on this computer's monotonic clock.

        Args:
            arrived_ns: Time at which the command arrived, in ns; used if the program is on another machine. A
                daemon that was suspended registers the arrival late.
        """
        sent_ns = self.sent_ns if self.boot_id == boot_id() != "" else arrived_ns
        return (clock.monotonic_ns() - min(sent_ns, arrived_ns)) * 1e-9


def send(session: zenoh.Session, hand: str, request: Request) -> None:
    """Send a command and wait until it has been executed.

    Args:
        session: Session of the program.
        hand: Name of the hand.
        request: The command, with a time limit.

    Raises:
        NodeError: if the host raises one, for example NodeTimeout.
        SkinError: if no daemon accepts the command in time.
    """
    assert request.deadline_s is not None
    limit_s = request.deadline_s + REPLY_S
    payload = json.dumps(asdict(request)).encode()
    for reply in session.get(keys.command_key(hand), payload=payload, timeout=limit_s):
        if reply.ok is not None:
            return
        if reply.err is not None:
            error = _decoded(reply.err.payload.to_bytes(), hand)
            if error is not None:
                raise error
    raise SkinError(
        f"hand {hand!r}: no reply to {request.command} within {limit_s:g} s; check "
        "that its daemon is running (skinnode host --publish --commands) and that access control permits the "
        "command"
    )


def encoded(error: Exception) -> bytes:
    """Encode an error as a reply: JSON with ``kind``, ``node_id`` and ``text``."""
    table: dict[str, Any] = {"kind": "SkinError", "text": str(error)}
    if isinstance(error, NodeError):
        table["kind"] = "NodeTimeout" if isinstance(error, NodeTimeout) else "NodeError"
        table["node_id"] = error.node_id
        table["text"] = str(error).removeprefix(f"node {error.node_id}: ")
    elif not isinstance(error, SkinError):
        table["text"] = one_line(error)
    return json.dumps(table).encode()


def _decoded(data: bytes, hand: str) -> SkinError | None:
    """Decode a daemon's error; None for an error from Zenoh itself, such as ``Timeout``."""
    try:
        table = json.loads(data)
        kind, text = table["kind"], str(table["text"])
        if kind in ("NodeError", "NodeTimeout"):
            return (NodeTimeout if kind == "NodeTimeout" else NodeError)(int(table["node_id"]), text)
    except (ValueError, KeyError, TypeError):
        return None
    return SkinError(f"hand {hand!r}: {text}")
