"""Fault confinement: error counters and error states of a station (ISO 11898-1:2015).

Rule numbers refer to Bosch CAN 2.0, part B, section 8. Rules 4 to 6 and exception 2 of rule 3 are omitted,
because the simulated bus has no disturbed error flags and no stuff errors during arbitration.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Final

PASSIVE_FROM: Final = 128
"""Error-passive limit: at this value of either error counter, a station becomes error-passive."""

BUS_OFF_FROM: Final = 256
"""Bus-off limit: at this value of its transmit error counter, a station goes bus-off."""

MAX_RECEIVE_ERRORS: Final = 255
"""Upper limit of the receive error counter. The standard sets no limit; controllers have 7-bit or 8-bit
counters."""

_BACK_TO_ACTIVE: Final = 119
"""Receive error counter after a successful reception in the error-passive state. The standard allows 119 to
127."""

RECOVERY_RUNS: Final = 128
"""Number of recessive runs after which a station recovers from bus-off."""

RECOVERY_RUN_BITS: Final = 11
"""Length in bits of a recessive run that counts towards recovery from bus-off."""

SUSPEND_BITS: Final = 8
"""Suspend transmission: extra time that an error-passive station waits after its own frame, in bits."""


class ErrorState(enum.StrEnum):
    """Error state of a station."""

    ACTIVE = "error-active"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"


@dataclass(frozen=True, slots=True)
class Counters:
    """Error counters of a station."""

    tec: int = 0
    """Transmit error counter (TEC)."""
    rec: int = 0
    """Receive error counter (REC)."""

    @property
    def state(self) -> ErrorState:
        """Error state for these counters."""
        if self.tec >= BUS_OFF_FROM:
            return ErrorState.BUS_OFF
        if self.tec >= PASSIVE_FROM or self.rec >= PASSIVE_FROM:
            return ErrorState.PASSIVE
        return ErrorState.ACTIVE


ZERO: Final = Counters()
"""Error counters of a station after start-up or recovery from bus-off."""


def transmission_failed(counters: Counters, *, unanswered: bool = False) -> Counters:
    """Return the error counters of a transmitter after it sends an error flag (rule 3).

    Args:
        counters: Error counters before the error.
        unanswered: Whether the frame is not acknowledged and no station sends a dominant bit during the error
            flag. An error-passive transmitter does not count this error.

    Returns:
        Error counters after the error.
    """
    if unanswered and counters.state is ErrorState.PASSIVE:
        return counters
    return Counters(counters.tec + 8, counters.rec)


def reception_failed(counters: Counters, *, first: bool = False) -> Counters:
    """Return the error counters of a receiver after it detects an error (rules 1 and 2).

    Args:
        counters: Error counters before the error.
        first: Whether the receiver is the first station to detect the error. It then sees a dominant bit
            after its own error flag.

    Returns:
        Error counters after the error.
    """
    return Counters(counters.tec, min(MAX_RECEIVE_ERRORS, counters.rec + (9 if first else 1)))


def transmission_succeeded(counters: Counters) -> Counters:
    """Return the error counters of a transmitter after a successful transmission (rule 7)."""
    return Counters(counters.tec - 1, counters.rec) if counters.tec else counters


def reception_succeeded(counters: Counters) -> Counters:
    """Return the error counters of a receiver after a successful reception (rule 8)."""
    if not counters.rec:
        return counters
    rec = _BACK_TO_ACTIVE if counters.rec >= PASSIVE_FROM else counters.rec - 1
    return Counters(counters.tec, rec)
