"""Bit rates of a bus, and the tick: a unit of time such that every bit time is a whole number of ticks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from skinnode.errors import ConfigError

NOMINAL_BPS: Final = range(10_000, 1_000_001)
"""Permissible nominal bit rates of a high-speed CAN bus, in bit/s."""

MAX_DATA_BPS: Final = 8_000_000
"""Maximum bit rate of the CAN FD data phase, in bit/s."""


@dataclass(frozen=True, slots=True)
class BitRates:
    """Bit rates of a bus.

    Time is counted in ticks. A tick is the longest unit of which a nanosecond, a nominal bit time and a data
    bit time are all whole multiples; it is 1 ns if both bit times are whole numbers of nanoseconds. Times in
    ticks are exact. Only the times reported to callers are rounded, each separately, so rounding errors do
    not accumulate.

    Raises:
        ConfigError: If a bit rate is out of range.
    """

    nominal_bps: int = 1_000_000
    """Nominal bit rate, in bit/s."""
    data_bps: int | None = None
    """Bit rate of the data phase, in bit/s; None for a bus without CAN FD."""
    ticks_per_s: int = field(init=False)
    ticks_per_ns: int = field(init=False)
    nominal_ticks: int = field(init=False)
    """Nominal bit time, ticks."""
    data_ticks: int = field(init=False)
    """Data bit time, ticks; equal to the nominal bit time on a bus without CAN FD."""

    def __post_init__(self) -> None:
        if self.nominal_bps not in NOMINAL_BPS:
            allowed = f"{NOMINAL_BPS.start} to {NOMINAL_BPS.stop - 1} bit/s"
            raise ConfigError("nominal_bps", self.nominal_bps, allowed)
        if self.data_bps is not None and not self.nominal_bps <= self.data_bps <= MAX_DATA_BPS:
            allowed = f"{self.nominal_bps} (nominal_bps) to {MAX_DATA_BPS} bit/s, or None"
            raise ConfigError("data_bps", self.data_bps, allowed)
        data_bps = self.data_bps or self.nominal_bps
        ticks_per_s = math.lcm(10**9, self.nominal_bps, data_bps)
        for name, value in (
            ("ticks_per_s", ticks_per_s),
            ("ticks_per_ns", ticks_per_s // 10**9),
            ("nominal_ticks", ticks_per_s // self.nominal_bps),
            ("data_ticks", ticks_per_s // data_bps),
        ):
            object.__setattr__(self, name, value)

    def ticks(self, bits: tuple[int, int]) -> int:
        """Return the duration in ticks of the given numbers of nominal and data bits."""
        return bits[0] * self.nominal_ticks + bits[1] * self.data_ticks

    def ceil_ns(self, ticks: int) -> int:
        """Convert ticks to ns. Rounding up ensures that no event is reported before it happens."""
        return ticks if self.ticks_per_ns == 1 else -(-ticks // self.ticks_per_ns)
