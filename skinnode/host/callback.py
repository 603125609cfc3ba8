"""Call a user's function with each field, on a dedicated thread so that the host is not delayed."""

from __future__ import annotations

import inspect
import logging
import threading
from collections.abc import Callable
from typing import Final

from skinnode.errors import SkinError
from skinnode.host.containment import Defects, keep_on
from skinnode.host.publish import Subscription
from skinnode.model.frames import FieldFrame
from skinnode.process import clock

_log = logging.getLogger(__name__)

LAST_CALL_S: Final = 1.0
"""Time limit (s) for a call in progress when the callback or the host is closed."""


class FieldCallback:
    """Callback that passes each field to a user's function until the callback or the host is closed.

    Exceptions raised by the function are counted, and the first one is logged with its traceback. Later
    fields are still delivered.

    Threads: a dedicated thread calls the function. Any thread may call the methods.
    """

    def __init__(
        self,
        function: Callable[[FieldFrame], object],
        fields: Subscription,
        defects: Defects | None = None,
    ) -> None:
        self._function, self._fields = function, fields
        self._defects = Defects("host") if defects is None else defects
        self._failed = 0
        self._thread = clock.thread(target=self._run, name="callback")
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Number of fields lost because the function was too slow."""
        return self._fields.dropped

    @property
    def failed(self) -> int:
        """Number of fields for which the function raised an exception."""
        return self._failed

    def close(self) -> None:
        """Stop calling the function. Wait up to a second for a call in progress.

        The function itself may call ``close``.
        """
        self._fields.close()
        self.join()

    def join(self) -> None:
        """Wait up to a second for the last call to return. Log a warning if it does not."""
        if self._thread is threading.current_thread():
            return
        self._thread.join(LAST_CALL_S)
        if self._thread.is_alive():
            _log.warning("callback %s has not returned; no longer waiting for it", _name(self._function))

    @property
    def ended(self) -> bool:
        """Whether the last call to the function has returned."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "waiting for a field")

    def _turn(self) -> bool:
        """Pass the next field to the function. Return False if there are no more fields."""
        try:
            field = self._fields.take(None)
        except SkinError as error:  # the error that stopped the host
            _log.warning("callback %s is no longer called: %s", _name(self._function), error)
            return False
        if field is None:
            return False
        try:
            self._function(field)
        except Exception as error:
            self._failed += 1
            if self._failed == 1:
                _log.warning("callback %s raised", _name(self._function), exc_info=error)
        return True


class Callbacks:
    """Callbacks of a host. Exceptions raised outside the users' functions are reported to ``defects``."""

    def __init__(self, defects: Defects | None = None) -> None:
        self._defects = defects
        self._all: list[FieldCallback] = []

    def add(self, function: Callable[[FieldFrame], object], fields: Subscription) -> FieldCallback:
        """Start a callback that passes the fields of a subscription to ``function``.

        Raises:
            TypeError: if ``function`` is not callable, or is async.
        """
        if not callable(function):
            raise TypeError(f"function: got {function!r}, must be a function that takes a field")
        if inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(type(function).__call__):
            raise TypeError(f"function: got async {_name(function)}, must not be async (use async for)")
        self._all = [callback for callback in self._all if not callback.ended]
        callback = FieldCallback(function, fields, self._defects)
        self._all.append(callback)
        return callback

    def join(self) -> None:
        """Wait for all callbacks to end. Call only after their subscriptions have ended."""
        for callback in self._all:
            callback.join()


def _name(function: Callable[[FieldFrame], object]) -> str:
    return getattr(function, "__qualname__", repr(function))
