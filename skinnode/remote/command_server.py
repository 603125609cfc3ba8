"""Executes programs' commands on a host, one at a time, in a separate thread.

The reply to a request (:class:`skinnode.remote.commands.Request`) is empty, or an error as JSON.
"""

from __future__ import annotations

import logging
import queue
from typing import TYPE_CHECKING, Final, NamedTuple

from skinnode.errors import SkinError
from skinnode.host import Host
from skinnode.host.tare import tare_deadline_s
from skinnode.process import clock
from skinnode.remote import keys
from skinnode.remote.commands import REPLY_S, Request, encoded

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)

_WAITING: Final = 16
"""Maximum number of queued commands; the daemon refuses further commands."""


class _Arrival(NamedTuple):
    query: zenoh.Query
    t_ns: int
    """Monotonic time at which the command arrived, in ns."""


class CommandServer:
    """Accepts commands from construction until :meth:`close` is called.

    A program abandons a command :data:`~skinnode.remote.commands.REPLY_S` after the command's time limit. A
    command that has been queued for too long is refused, so an abandoned command is never executed.

    Args:
        session: Session of the daemon.
        host: Running host.
    """

    def __init__(self, session: zenoh.Session, host: Host) -> None:
        self._host, self._key = host, keys.command_key(host.hand.name)
        self._waiting: queue.SimpleQueue[_Arrival | None] = clock.simple_queue()
        self._over = clock.event()
        self._thread = clock.thread(target=self._run, name="remote commands")
        self._thread.start()
        self._queryable: zenoh.Queryable[None] | None = session.declare_queryable(self._key, self._accept)

    def close(self) -> None:
        """Refuse the queued commands, stop waiting for the current one, and wait for the thread to end.

        Further calls have no effect.
        """
        queryable, self._queryable = self._queryable, None
        if queryable is None:
            return
        self._over.set()
        queryable.undeclare()
        self._waiting.put(None)
        self._thread.join()

    def _accept(self, query: zenoh.Query) -> None:
        """Queue a command. Called by a Zenoh thread, which must not block."""
        if self._waiting.qsize() >= _WAITING:
            with query:
                query.reply_err(encoded(SkinError(f"{_WAITING} commands are waiting; try again later")))
            return
        self._waiting.put(_Arrival(query, clock.monotonic_ns()))

    def _run(self) -> None:
        while (arrival := self._waiting.get()) is not None:
            query = arrival.query
            with query:
                try:
                    self._execute(b"" if query.payload is None else query.payload.to_bytes(), arrival.t_ns)
                except Exception as error:  # the program receives the error; the daemon continues
                    query.reply_err(encoded(error))
                else:
                    query.reply(self._key, b"")

    def _execute(self, data: bytes, arrived_ns: int) -> None:
        request = Request.decode(data)
        command, patch = request.command, request.patch
        if command not in ("tare", "reset_node"):
            raise SkinError(f"command: got {command!r}, must be tare or reset_node")
        if patch not in {each.name for each in self._host.hand.patches}:
            raise SkinError(f"patch: got {patch!r}, but the hand has no such patch")
        deadline_s = tare_deadline_s(self._host.hand, request.deadline_s)
        left_s = deadline_s + REPLY_S / 2 - request.waited_s(arrived_ns)
        if self._over.is_set():
            raise SkinError(f"{command} of {patch!r} not executed: the daemon is shutting down")
        if left_s < 0:
            raise SkinError(f"{command} of {patch!r} not executed: it was queued for too long; try again")
        _log.info("%s: %s, requested by a program", patch, command)
        if command == "tare":
            self._host.tare(patch, deadline_s=min(deadline_s, left_s), cancelled=self._over.is_set)
        else:
            self._host.reset_node(patch)
