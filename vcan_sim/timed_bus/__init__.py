"""Deterministic model of a CAN bus with exact event times, without threads or a clock.

::

    frame (a frame and its length) -> transmit_queue (FIFO or by priority) -> station (options, state)
        -> bus (arbitration, retransmission, recovery) -> events
    disturbances (rules that inject errors) -> wire_frame (the bits of a frame)
        -> attempt (delivered or destroyed, and when) -> bus
    confinement (error counters and states), bit_rates (exact times), occupancy (bus load) -> bus

The caller supplies the time. ``TimedBus.send`` queues a frame at a given time, ``TimedBus.advance`` simulates
the bus up to a given time, and ``TimedBus.next_event_ns`` is the time at which to call ``advance`` next. The
same calls always produce the same events. The ``bus``, ``attempt`` and ``confinement`` modules list the
simplifications of the model.
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
