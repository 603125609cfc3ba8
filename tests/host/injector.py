"""Raises at calls that threads make into other code, by a profile function: what that raises, CPython 3.11
raises as an exception of the very call that the function is told of."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

import skinnode

_PACKAGE = Path(skinnode.__file__).parent
ROOMS = tuple(str(_PACKAGE / room) for room in ("host", "transport", "record"))
"""Whose calls are looked at."""


class Edge(NamedTuple):
    """A call from a function of these rooms into another module, or into C, on a kind of thread."""

    thread: str
    caller: str
    callee: str

    def __str__(self) -> str:
        return f"{self.thread}: {self.caller} -> {self.callee}"


class Injector:
    """Told of all calls of threads that begin while it is :meth:`installed`."""

    def __init__(self) -> None:
        self.edges: dict[Edge, int] = {}
        self.armed: Edge | None = None
        self._skip = self._times = 0
        self.fired = 0
        self._callers: dict[CodeType, str | None] = {}

    def arm(self, edge: Edge, skip: int, times: int) -> None:
        """Raise at the next calls, ``times`` running, but for ``skip`` of them."""
        self.fired, self._skip, self._times = 0, skip, times
        self.armed = edge

    def disarm(self) -> None:
        self.armed = None

    @contextmanager
    def installed(self) -> Iterator[None]:
        threading.setprofile(self)
        try:
            yield
        finally:
            threading.setprofile(None)  # type: ignore[arg-type]
            self.disarm()

    def again(self) -> None:
        """After it has raised: CPython then forgets it on that thread."""
        if kind_of(threading.current_thread().name):
            sys.setprofile(self)

    def __call__(self, frame: FrameType, event: str, arg: Any) -> None:
        if event == "call":
            caller, callee = frame.f_back, frame.f_code
            if caller is None:
                return
            where = self._name(caller.f_code)
            if where is None or caller.f_code.co_filename == callee.co_filename:
                return
            name = f"{Path(callee.co_filename).stem}.{callee.co_qualname}"
        elif event == "c_call":
            where = self._name(frame.f_code)
            if where is None:
                return
            owner = getattr(arg, "__self__", None)
            of = getattr(owner, "__name__", type(owner).__name__) if owner is not None else arg.__module__
            name = f"{of}.{arg.__name__}"
        else:
            return
        edge = Edge(kind_of(threading.current_thread().name), where, name)
        if not edge.thread:
            return
        self.edges[edge] = self.edges.get(edge, 0) + 1
        if edge == self.armed:
            if self._skip:
                self._skip -= 1
                return
            self._times -= 1
            self.fired += 1
            if not self._times:
                self.armed = None
            raise RuntimeError("injected")

    def _name(self, code: CodeType) -> str | None:
        """Of a function of the rooms; None of any other."""
        try:
            return self._callers[code]
        except KeyError:
            inside = code.co_filename.startswith(ROOMS)
            name = f"{Path(code.co_filename).stem}.{code.co_qualname}" if inside else None
            self._callers[code] = name
            return name


KINDS = (
    "bring-up",
    "callback",
    "health",
    "mainline",
    "receive",
    "record",
    "rejoin",
    "reopen",
    "solve",
    "supervisor",
    "sync",
)


def kind_of(thread: str) -> str:
    """The kind of a thread of the host by its name; empty of any other."""
    return next((kind for kind in KINDS if thread.startswith(kind)), "")
