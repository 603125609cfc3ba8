"""Restores a node's 32-bit device time (µs) from the 16-bit time in a summary with a check."""

from __future__ import annotations

from typing import Final

TIME_STEP_US: Final = 64
"""Resolution of the 16-bit device time in µs.

The 16-bit time consists of bits 6 to 21 of the 32-bit time. It wraps every 4.2 s, so the host can restore the
upper bits if it can predict the device time to within 2 s.
"""
TIME_SHIFT: Final = 6
"""Number of bits by which a time in µs is shifted right to convert it to steps of 64 µs."""
TIME_WRAP_US: Final = TIME_STEP_US << 16
"""Period in µs after which the 16-bit device time wraps; about 4.2 s."""


def restore_time_us(low_us: int, expected_us: int) -> int:
    """Return the device time (µs) with the given low bits that is nearest to the expected time.

    Args:
        low_us: Lower bits of the device time (µs), from a summary that contains a checksum.
        expected_us: Expected device time, in µs.
    """
    return expected_us + (low_us - expected_us + TIME_WRAP_US // 2) % TIME_WRAP_US - TIME_WRAP_US // 2


class DeviceTimeTracker:
    """Restores the upper bits of a node's successive device times."""

    def __init__(self) -> None:
        # last restored device time (µs) and its arrival time (ns); both 0 before the first summary
        self._time_us = self._t_time_ns = 0

    def reset(self) -> None:
        """Forget the last device time, for example after the node restarts."""
        self._time_us = self._t_time_ns = 0

    def restore_us(self, low_us: int, t_ns: int) -> int:
        """Return the 32-bit device time in µs.

        The expected time is the last device time plus the time that has elapsed since then on the host's
        clock. For the first summary, the expected time is the host's time. The upper bits of the first device
        time are correct only if the node and the host share a clock and the summary arrives within three
        seconds of its scan.

        Args:
            low_us: Lower bits of the device time (µs), from a summary that contains a checksum.
            t_ns: Arrival time of the summary on the host's monotonic clock, in ns.
        """
        expected_us = self._time_us + (t_ns - self._t_time_ns) // 1000
        if not self._t_time_ns:
            expected_us -= TIME_WRAP_US // 4
        self._time_us = restore_time_us(low_us, expected_us)
        self._t_time_ns = t_ns
        return self._time_us & 0xFFFF_FFFF
