"""Reconstructs a node's 32-bit device time (µs) from the 16-bit time in a checked summary."""

from __future__ import annotations

from typing import Final

TIME_STEP_US: Final = 64
"""Resolution of the 16-bit device time in a checked summary, µs.

The resolution is a power of two, so the 16-bit time consists of bits 6 to 21 of the 32-bit time in µs. The
16-bit time wraps every 4.2 s, so a host that can predict the device time to within ±2 s can restore the upper
bits.
"""
TIME_SHIFT: Final = 6
"""Right shift, in bits, that converts a time in µs to a time in steps of 64 µs."""
TIME_WRAP_US: Final = TIME_STEP_US << 16
"""Interval (µs) after which the 16-bit device time wraps: about 4.2 s."""


def restore_time_us(low_us: int, expected_us: int) -> int:
    """Return the device time (µs) that has the given low bits and is nearest to the expected time.

    Args:
        low_us: device time from a checked summary, without its upper bits, µs.
        expected_us: expected device time, µs.
    """
    return expected_us + (low_us - expected_us + TIME_WRAP_US // 2) % TIME_WRAP_US - TIME_WRAP_US // 2


class DeviceTimeTracker:
    """Tracker that restores the upper bits of the device times in a stream of scans."""

    def __init__(self) -> None:
        # Last restored device time (µs), and its time of reception (ns); both 0 before the first summary.
        self._time_us = self._t_time_ns = 0

    def reset(self) -> None:
        """Discard the last device time, for example after a restart of the node."""
        self._time_us = self._t_time_ns = 0

    def restore_us(self, low_us: int, t_ns: int) -> int:
        """Return the 32-bit device time (µs), with upper bits predicted from the last device time.

        The prediction is the last device time plus the time that has since elapsed on the host's clock. For
        the first summary, the upper bits are predicted from the host's clock alone. These upper bits are
        correct if node and host share a clock and the summary arrives within three seconds of the scan.

        Args:
            low_us: device time from a checked summary, without its upper bits, µs.
            t_ns: time at which the summary was received, on the host's monotonic clock, ns.
        """
        expected_us = self._time_us + (t_ns - self._t_time_ns) // 1000
        if not self._t_time_ns:
            expected_us -= TIME_WRAP_US // 4
        self._time_us = restore_time_us(low_us, expected_us)
        self._t_time_ns = t_ns
        return self._time_us & 0xFFFF_FFFF
