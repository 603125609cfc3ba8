"""Where somebody who writes down what passes through a host is let in."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Protocol

from skinnode.host.containment import Defects
from skinnode.host.link import BusLink
from skinnode.host.patch_stream import PatchStream, StreamTap
from skinnode.host.scan_solver import ScanSolver
from skinnode.transport import Frame


class HostTap(StreamTap, Protocol):
    """Who writes down all frames and what else decides what a host makes of them. Never waits."""

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """A batch that is about to be dispatched. On the mainline of the bus, as what a stream says is."""

    def sent(self, bus: str, frame: Frame) -> None:
        """A frame that the interface has taken. On whatever thread sent it."""


class ContainedTap:
    """A wrapper of ``tap`` that never raises: an exception is reported to ``defects``, and the tap loses that
    entry."""

    def __init__(self, tap: HostTap, defects: Defects) -> None:
        self._tap, self._defects = tap, defects

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        self._do(lambda: self._tap.received(bus, frames))

    def sent(self, bus: str, frame: Frame) -> None:
        self._do(lambda: self._tap.sent(bus, frame))

    def resumed(self, patch: str, solver: ScanSolver, *, anew: bool) -> None:
        self._do(lambda: self._tap.resumed(patch, solver, anew=anew))

    def withheld(self, patch: str) -> None:
        self._do(lambda: self._tap.withheld(patch))

    def polled(self, patch: str, t_ns: int) -> None:
        self._do(lambda: self._tap.polled(patch, t_ns))

    def overtaken(self, patch: str, scan: int, t_receive_ns: int) -> None:
        self._do(lambda: self._tap.overtaken(patch, scan, t_receive_ns))

    def _do(self, entry: Callable[[], None]) -> None:
        try:
            entry()
        except Exception as error:
            self._defects.report("recording traffic", error)


def tap_link(tap: HostTap, link: BusLink) -> Callable[[], None]:
    """From now on ``tap`` hears of every frame, until what is returned is called. Both on the mainline, or
    before it runs."""
    received = functools.partial(tap.received, link.config.name)
    sent = functools.partial(tap.sent, link.config.name)
    link.listen(received)
    link.listen_to_sent(sent)

    def end() -> None:
        link.unlisten(received)
        link.unlisten_to_sent(sent)

    return end


def tap_bus(tap: HostTap, link: BusLink, streams: Sequence[PatchStream]) -> Callable[[], None]:
    """Have the mainline pass every frame and every change of the streams to ``tap``, their state first.

    Returns:
        A function that ends this, for any thread.
    """
    ends: list[Callable[[], None]] = []

    def begin() -> None:
        ends.append(tap_link(tap, link))
        for stream in streams:
            stream.tap = tap
            stream.tell_tap()

    def end() -> None:
        for stream in streams:
            stream.tap = None
        ends.pop()()

    link.call(begin)
    return lambda: link.call(end)
