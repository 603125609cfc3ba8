"""Trace of the frames on a timed bus, in the format of ``candump -L``."""

from __future__ import annotations

from vcan_sim.timed_bus import CanFrame, Delivered, Event
from vcan_sim.timed_interface import Segment


class Trace:
    """Record of every frame on a bus from now on, at the end of the frame.

    Args:
        of: The bus.
    """

    def __init__(self, of: Segment) -> None:
        self._channel = of.channel
        self._wall_ns = of.clock.time_ns() - of.clock.now_ns
        self._lines: list[str] = []
        of.listeners.append(self._on_event)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._lines)

    def text(self) -> str:
        """Return one line per frame, such as ``(1600000000.000310) can0 080#01``."""
        return "".join(self._lines)

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Delivered):
            micros = (event.time_ns + self._wall_ns) // 1000
            stamp = f"{micros // 10**6}.{micros % 10**6:06d}"
            self._lines.append(f"({stamp}) {self._channel} {_shown(event.frame)}\n")


def _shown(frame: CanFrame) -> str:
    can_id = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    if frame.remote:
        return f"{can_id}#R{frame.dlc or ''}"
    if frame.fd:
        return f"{can_id}##{int(frame.brs)}{frame.data.hex().upper()}"
    return f"{can_id}#{frame.data.hex().upper()}"
