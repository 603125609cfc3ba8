"""Executes programs' commands on a host, one at a time, in a separate thread.

A request is JSON with ``command`` (``tare`` or ``reset_node``), ``patch`` and, for a tare, ``deadline_s``.
The reply is empty, or an error as JSON with ``kind``, ``node_id`` and ``text``.
"""

from __future__ import annotations

import json
import logging
import queue
from typing import TYPE_CHECKING, Any, Final

from skinnode.errors import NodeError, NodeTimeout, SkinError
from skinnode.host import Host
from skinnode.host.containment import one_line
from skinnode.process import clock
from skinnode.remote import keys

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)

_WAITING: Final = 16
"""Maximum number of queued commands; the daemon refuses further commands."""


class CommandServer:
    """Accepts commands from construction until :meth:`close`.

    Args:
        session: Session of the daemon.
        host: Running host.
    """

    def __init__(self, session: zenoh.Session, host: Host) -> None:
        self._host, self._key = host, keys.command_key(host.hand.name)
        self._waiting: queue.SimpleQueue[zenoh.Query | None] = clock.simple_queue()
        self._thread = clock.thread(target=self._run, name="remote commands")
        self._thread.start()
        self._queryable = session.declare_queryable(self._key, self._accept)

    def close(self) -> None:
        """Stop accepting commands and wait for the command in progress to finish."""
        self._queryable.undeclare()
        self._waiting.put(None)
        self._thread.join()

    def _accept(self, query: zenoh.Query) -> None:
        """Queue a command. Called by a Zenoh thread, which must not block."""
        if self._waiting.qsize() >= _WAITING:
            with query:
                query.reply_err(_error(SkinError(f"{_WAITING} commands are waiting; try again later")))
            return
        self._waiting.put(query)

    def _run(self) -> None:
        while (query := self._waiting.get()) is not None:
            with query:
                try:
                    self._execute(b"" if query.payload is None else query.payload.to_bytes())
                except Exception as error:  # the program receives the error; the daemon continues
                    query.reply_err(_error(error))
                else:
                    query.reply(self._key, b"")

    def _execute(self, request: bytes) -> None:
        try:
            table = json.loads(request)
            command, patch = table["command"], str(table["patch"])
            deadline_s = None if table.get("deadline_s") is None else float(table["deadline_s"])
        except (ValueError, KeyError, TypeError, AttributeError):
            raise SkinError(f"request: got {request[:40]!r}, must be JSON with command and patch") from None
        if patch not in {each.name for each in self._host.hand.patches}:
            raise SkinError(f"patch: got {patch!r}, but the hand has no such patch")
        _log.info("%s: %s, commanded by a program", patch, command)
        match command:
            case "tare":
                self._host.tare(patch, deadline_s=deadline_s)
            case "reset_node":
                self._host.reset_node(patch)
            case _:
                raise SkinError(f"command: got {command!r}, must be tare or reset_node")


def _error(error: Exception) -> bytes:
    table: dict[str, Any] = {"kind": "SkinError", "text": str(error)}
    if isinstance(error, NodeError):
        table["kind"] = "NodeTimeout" if isinstance(error, NodeTimeout) else "NodeError"
        table["node_id"] = error.node_id
        table["text"] = str(error).removeprefix(f"node {error.node_id}: ")
    elif not isinstance(error, SkinError):
        table["text"] = one_line(error)
    return json.dumps(table).encode()
