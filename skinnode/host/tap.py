"""Pass sent and received frames, and the events that affect their decoding, to a recorder."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Protocol

from skinnode.canopen.indices import SYNC_COB_ID
from skinnode.host.containment import Defects
from skinnode.host.link import BusLink
from skinnode.host.patch_stream import PatchStream, StreamTap
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.sync import Ticks
from skinnode.transport import Frame


class HostTap(StreamTap, Protocol):
    """Recorder of all frames, and of the events that affect their decoding. Its methods must not block."""

    def received(self, bus: str, frames: Sequence[Frame]) -> None:
        """Record a batch of frames before it is dispatched. Called on the mainline."""

    def sent(self, bus: str, frame: Frame) -> None:
        """Record a frame that the interface has accepted. Called on the sending thread."""

    def numbered(self, bus: str, t_ns: int, number: int) -> None:
        """Record the number of the SYNC sent at monotonic time ``t_ns``; called before :meth:`sent`.

        Called only if the counters of this SYNC and the last one do not determine the number, because the
        counter has wrapped in between.
        """


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

    def numbered(self, bus: str, t_ns: int, number: int) -> None:
        """Call the tap's :meth:`HostTap.numbered`."""
        self._do(lambda: self._tap.numbered(bus, t_ns, number))

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


class _SentFrames:
    """Passes the frames sent on a bus, and the numbers of SYNC messages, to a tap."""

    def __init__(self, tap: HostTap, bus: str, ticks: Ticks | None) -> None:
        self._tap, self._bus, self._ticks = tap, bus, ticks
        self._last = 0

    def on_sent(self, frame: Frame) -> None:
        """Pass a frame. If it is a SYNC, only the thread that sends SYNC calls this method."""
        if self._ticks is not None and frame.can_id == SYNC_COB_ID and not frame.extended:
            last, self._last = self._last, self._ticks.newest
            if self._last - last > self._ticks.counter_overflow:
                self._tap.numbered(self._bus, frame.t_ns, self._last)
        self._tap.sent(self._bus, frame)


def tap_link(tap: HostTap, link: BusLink, ticks: Ticks | None = None) -> Callable[[], None]:
    """Pass every frame on a bus to ``tap`` from now on.

    Once the mainline is running, only the mainline may call this function.

    Args:
        tap: The tap.
        link: The bus.
        ticks: Times of the SYNC messages on the bus; None if the host does not send any.

    Returns:
        Function that ends the recording. Once the mainline is running, only the mainline may call it.
    """
    received = functools.partial(tap.received, link.config.name)
    sent = _SentFrames(tap, link.config.name, ticks).on_sent
    link.listen(received)
    link.listen_to_sent(sent)

    def end() -> None:
        link.unlisten(received)
        link.unlisten_to_sent(sent)

    return end


def tap_bus(tap: HostTap, link: BusLink, ticks: Ticks, streams: Sequence[PatchStream]) -> Callable[[], None]:
    """Pass the current state of the streams to ``tap``, then every frame and every event.

    Returns:
        Function that ends the recording. Any thread may call it.
    """
    ends: list[Callable[[], None]] = []

    def begin() -> None:
        ends.append(tap_link(tap, link, ticks))
        for stream in streams:
            stream.tap = tap
            stream.inform_tap()

    def end() -> None:
        for stream in streams:
            stream.tap = None
        ends.pop()()

    link.call(begin)
    return lambda: link.call(end)
