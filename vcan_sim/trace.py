"""Traces of the frames on a bus, in ``candump -L`` log format."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.process import clock
from skinnode.transport import CanPort, Frame
from vcan_sim.timed_bus import CanFrame, Delivered, Event
from vcan_sim.timed_interface import Segment

_POLL_S: Final = 0.05
"""Maximum wait for the next frame, in s."""

_LAST_FRAMES: Final = 10_000
"""Maximum number of frames that a listener reads after it has been stopped."""


class Trace:
    """Records all subsequent frames on a timed bus, each stamped with the time at which it ends.

    Args:
        of: Bus to record.
    """

    def __init__(self, of: Segment) -> None:
        self._of, self._channel = of, of.channel
        self._wall_ns = of.clock.time_ns() - of.clock.now_ns
        self._lines: list[str] = []
        of.listeners.append(self._on_event)

    def __len__(self) -> int:
        """Return the number of recorded frames."""
        self._of.catch_up()
        return len(self._lines)

    def text(self) -> str:
        """Return the trace with one line per frame, such as ``(1600000000.000310) can0 080#01``."""
        self._of.catch_up()
        return "".join(self._lines)

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Delivered):
            self._lines.append(_line(event.time_ns + self._wall_ns, self._channel, event.frame))


class Listener:
    """Records the frames on a bus during a ``with`` block, through its own endpoint.

    Args:
        bus: Bus to record.
        write: Function called with each line of the trace, in the listener's thread; by default, lines are
            kept for :meth:`text`.
        channel: Name of the channel in the trace; default: the channel of the bus.

    Raises:
        BusError: If the bus cannot be opened.
    """

    def __init__(
        self, bus: BusConfig, write: Callable[[str], object] | None = None, channel: str | None = None
    ) -> None:
        self._port, self._channel = CanPort(bus), channel or bus.channel
        self._wall_ns = clock.time_ns() - clock.monotonic_ns()
        self._lines: list[str] = []
        self._write = write or self._lines.append
        self._stop = clock.event()
        self._thread = clock.thread(self._run, f"trace {bus.name}")

    def text(self) -> str:
        """Return the trace with one line per frame, such as ``(1600000000.000310) vcan0 080#01``."""
        return "".join(self._lines)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._port.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._record(_POLL_S)
        for _ in range(_LAST_FRAMES):
            if not self._record(0.0):
                return

    def _record(self, timeout_s: float) -> bool:
        """Record the next frame, and return whether there was one."""
        try:
            frame = self._port.recv(timeout_s)
        except BusError:
            self._stop.wait(_POLL_S)
            return False
        if frame is not None and not frame.error:
            self._write(_line(frame.t_ns + self._wall_ns, self._channel, _can_frame(frame)))
        return frame is not None


def _can_frame(frame: Frame) -> CanFrame:
    return CanFrame(frame.can_id, frame.data, frame.extended, frame.remote, fd=frame.fd, brs=frame.fd)


def _line(wall_ns: int, channel: str, frame: CanFrame) -> str:
    micros = wall_ns // 1000
    can_id = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    if frame.remote:
        shown = f"{can_id}#R{frame.dlc or ''}"
    elif frame.fd:
        shown = f"{can_id}##{int(frame.brs)}{frame.data.hex().upper()}"
    else:
        shown = f"{can_id}#{frame.data.hex().upper()}"
    return f"({micros // 10**6}.{micros % 10**6:06d}) {channel} {shown}\n"
