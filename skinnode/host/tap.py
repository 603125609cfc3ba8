"""Pass sent and received frames, and the events that affect their decoding, to a recorder."""

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
    """Recorder of all frames, and of the events that affect their decoding. Its methods must not block."""

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """Record a batch of frames before it is dispatched. Called on the mainline."""

    def sent(self, bus: str, frame: Frame) -> None:
        """Record a frame that the interface has accepted. Called on the sending thread."""


class ContainedTap:
    """Wrapper that keeps a tap's exceptions from affecting the host.

    An exception is reported to ``defects``. Only the current entry of the recording is lost.
    """

    def __init__(self, tap: HostTap, defects: Defects) -> None:
        self._tap, self._defects = tap, defects

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """Call the tap's :meth:`HostTap.received`."""
        self._do(lambda: self._tap.received(bus, frames))

    def sent(self, bus: str, frame: Frame) -> None:
        """Call the tap's :meth:`HostTap.sent`."""
        self._do(lambda: self._tap.sent(bus, frame))

    def resumed(self, patch: str, solver: ScanSolver, *, anew: bool) -> None:
        """Call the tap's :meth:`StreamTap.resumed`."""
        self._do(lambda: self._tap.resumed(patch, solver, anew=anew))

    def withheld(self, patch: str) -> None:
        """Call the tap's :meth:`StreamTap.withheld`."""
        self._do(lambda: self._tap.withheld(patch))

    def polled(self, patch: str, t_ns: int) -> None:
        """Call the tap's :meth:`StreamTap.polled`."""
        self._do(lambda: self._tap.polled(patch, t_ns))

    def overtaken(self, patch: str, scan: int, t_receive_ns: int) -> None:
        """Call the tap's :meth:`StreamTap.overtaken`."""
        self._do(lambda: self._tap.overtaken(patch, scan, t_receive_ns))

    def _do(self, entry: Callable[[], None]) -> None:
        try:
            entry()
        except Exception as error:
            self._defects.report("recording traffic", error)


def tap_link(tap: HostTap, link: BusLink) -> Callable[[], None]:
    """Pass every frame on a bus to ``tap`` from now on.

    Once the mainline is running, only the mainline may call this function.

    Returns:
        Function that ends the recording. Once the mainline is running, only the mainline may call it.
    """
    received = functools.partial(tap.received, link.config.name)
    sent = functools.partial(tap.sent, link.config.name)
    link.listen(received)
    link.listen_to_sent(sent)

    def end() -> None:
        link.unlisten(received)
        link.unlisten_to_sent(sent)

    return end


def tap_bus(tap: HostTap, link: BusLink, streams: Sequence[PatchStream]) -> Callable[[], None]:
    """Pass the current state of the streams to ``tap``, then every frame and every event.

    Returns:
        Function that ends the recording. Any thread may call it.
    """
    ends: list[Callable[[], None]] = []

    def begin() -> None:
        ends.append(tap_link(tap, link))
        for stream in streams:
            stream.tap = tap
            stream.inform_tap()

    def end() -> None:
        for stream in streams:
            stream.tap = None
        ends.pop()()

    link.call(begin)
    return lambda: link.call(end)
