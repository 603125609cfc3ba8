"""Device time, a node's 32-bit time in µs; a checked summary carries 16 bits of it in steps of 64 µs."""

from __future__ import annotations

from typing import Final

TIME_STEP_US: Final = 64
"""Unit of the 16-bit device time in a checked summary, µs.

The unit is a power of two, so the 16-bit time, which wraps every 4.2 s, stays in step with the 32-bit time in
µs. A host that knows the time to within ±2 s can restore the upper bits.
"""
TIME_SHIFT: Final = 6
"""Shift in bits between a time in µs and a time in steps of 64 µs."""
TIME_WRAP_US: Final = TIME_STEP_US << 16
"""Range of the 16-bit device time, µs (4.2 s)."""


def restore_time_us(low_us: int, expected_us: int) -> int:
    """Return the unwrapped device time nearest to an expected time.

    Args:
        low_us: low bits of the time from a checked summary, µs.
        expected_us: expected device time, µs.
    """
    return expected_us + (low_us - expected_us + TIME_WRAP_US // 2) % TIME_WRAP_US - TIME_WRAP_US // 2


class DeviceTimeTracker:
    """Tracker that restores the upper bits of one stream's device times."""

    def __init__(self) -> None:
        self._time_us = self._t_time_ns = 0  # newest unwrapped device time, and when it arrived; 0 if none

    def reset(self) -> None:
        """Forget the newest device time, because the node may have restarted."""
        self._time_us = self._t_time_ns = 0

    def restore_us(self, low_us: int, t_ns: int) -> int:
        """Return the 32-bit device time nearest to the last one plus the host time elapsed since then.

        The upper bits of the first time are taken from the host's clock. They are correct if the summary is
        received no more than three seconds after the scan.

        Args:
            low_us: low bits of the time from a checked summary, µs.
            t_ns: when the summary was received, ns of the host's monotonic clock.
        """
        expected_us = self._time_us + (t_ns - self._t_time_ns) // 1000
        if not self._t_time_ns:
            expected_us -= TIME_WRAP_US // 4
        self._time_us = restore_time_us(low_us, expected_us)
        self._t_time_ns = t_ns
        return self._time_us & 0xFFFF_FFFF
