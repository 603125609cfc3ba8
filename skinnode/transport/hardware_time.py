"""Converts a CAN controller's hardware timestamps to the monotonic clock."""

from __future__ import annotations

from typing import Final

OLDEST_NS: Final = 10_000_000_000
"""Maximum plausible age of a frame, in ns. If the wall clock was set after a frame had arrived, the frame can
appear older; its timestamp is then replaced by the time at which the frame is read."""

DRIFT: Final = 200e-6
"""Maximum relative drift between two clocks whose oscillators each have a tolerance of 100 ppm."""


class HardwareClock:
    """Converts a CAN controller's hardware timestamps to the monotonic clock. Only one thread may use it.

    The kernel can timestamp a frame late, but never early. The difference between a frame's kernel timestamp
    and its hardware timestamp is therefore an upper bound on the offset between the two clocks. The estimated
    offset follows the lowest bounds and rises no faster than two clocks can drift apart.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._last_ns = 0

    def arrival_ns(self, hardware_ns: int, kernel_ns: int) -> int:
        """Return the arrival time of a frame on the monotonic clock, in ns.

        Args:
            hardware_ns: Hardware timestamp, in ns.
            kernel_ns: Kernel timestamp, converted to the monotonic clock, in ns.
        """
        offset_ns = kernel_ns - hardware_ns
        if self._offset_ns is not None and abs(offset_ns - self._offset_ns) < OLDEST_NS:
            risen_ns = self._offset_ns + int(DRIFT * max(0, hardware_ns - self._last_ns))
            offset_ns = min(offset_ns, risen_ns)
        self._offset_ns, self._last_ns = offset_ns, hardware_ns
        return hardware_ns + offset_ns
