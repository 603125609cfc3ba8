"""CAN bus with exact times, as a deterministic model without threads and without a clock of its own.

::

    frame (a frame and its length) -> transmit_queue (FIFO or by priority) -> station (options, state)
        -> bus (arbitration, retransmission, recovery) -> events
    disturbances (rules that inject errors) -> wire_frame (the bits of a frame)
        -> attempt (delivered or destroyed, and when) -> bus
    confinement (error counters and states), bit_rates (exact times), occupancy (bus load) -> bus

The caller owns time. ``TimedBus.send`` hands in a frame at a time, ``TimedBus.advance`` returns the events up
to a time, and ``TimedBus.next_event_ns`` says when to advance next. The same calls give the same events. The
docstrings of ``bus``, ``attempt`` and ``confinement`` list what the model leaves out.
"""

from vcan_sim.timed_bus.bit_rates import BitRates
from vcan_sim.timed_bus.bus import TimedBus
from vcan_sim.timed_bus.confinement import Counters, ErrorState
from vcan_sim.timed_bus.disturbances import AtTime, Disturbance, NthFrame, RandomShare
from vcan_sim.timed_bus.events import (
    BusOff,
    Cause,
    CountersChanged,
    Delivered,
    ErrorFrame,
    Event,
    Recovered,
)
from vcan_sim.timed_bus.frame import CanFrame
from vcan_sim.timed_bus.station import StationOptions

__all__ = [
    "AtTime",
    "BitRates",
    "BusOff",
    "CanFrame",
    "Cause",
    "Counters",
    "CountersChanged",
    "Delivered",
    "Disturbance",
    "ErrorFrame",
    "ErrorState",
    "Event",
    "NthFrame",
    "RandomShare",
    "Recovered",
    "StationOptions",
    "TimedBus",
]
