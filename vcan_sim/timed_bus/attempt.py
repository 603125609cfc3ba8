"""Determines whether the frame in a transmission attempt is delivered or destroyed, and when.

:func:`undisturbed` handles the common case, which requires only the number of bits. :func:`disturbed`
examines the individual bits of the frame.

Error frames follow ISO 11898-1:2015 and Bosch CAN 2.0, part B, sections 3.1.3 and 7. The first station to
detect an error sends an error flag of 6 bits, starting at the next bit. The other stations detect this flag
as an error and start their own flags up to 6 bits later. The superposed flags are thus 6 to 12 bits long. An
error delimiter of 8 recessive bits and the intermission of 3 bits follow. Error flags are sent at the nominal
bit rate. The delay of the second flag is computed at the bit rate of the phase in which the error occurs.

Simplifications: A disturbance seen by all stations destroys the frame, even if it inverts a recessive bit of
the arbitration field. Error flags and delimiters are never disturbed. A passive error flag ends when the
other error flags end. Overload frames are not modelled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from vcan_sim.timed_bus.bit_rates import BitRates
from vcan_sim.timed_bus.disturbances import Hit
from vcan_sim.timed_bus.events import Cause
from vcan_sim.timed_bus.frame import CanFrame, frame_bits
from vcan_sim.timed_bus.wire_frame import (
    ACK_TO_END_BITS,
    FLAG_BITS,
    WireFrame,
    receiver_lag,
    wire_frame,
)

INTERMISSION_BITS: Final = 3
ERROR_DELIMITER_BITS: Final = 8
_AFTER_FLAG_BITS: Final = ERROR_DELIMITER_BITS + INTERMISSION_BITS
_ACTIVE, _PASSIVE = 0, 1


@dataclass(frozen=True, slots=True)
class Participant:
    """Station that takes part in a transmission attempt as a sender or receiver."""

    station: int
    passive: bool
    """Whether the station is error-passive."""
    frame: CanFrame | None = None
    """Frame that the station sends; None for a receiver."""


@dataclass(frozen=True, slots=True)
class BitError:
    """Error in a transmission attempt. Times are in ticks from the start of frame."""

    ticks: int
    """Start of the first error flag."""
    bit: int
    cause: Cause
    detected_by: tuple[int, ...]
    """Stations that detect the error in this bit."""


class Course(NamedTuple):
    """Timing and errors of a transmission attempt. Times are in ticks from the start of frame."""

    senders: tuple[int, ...]
    """Stations that are still sending when the frame is delivered or destroyed."""
    end: int
    """End of the frame, or start of the first error flag."""
    recessive: int
    """Time after which the bus stays recessive."""
    free: int
    """End of the intermission."""
    error: BitError | None = None
    """Error that destroys the frame; None if the frame is delivered."""
    side_errors: tuple[BitError, ...] = ()
    """Errors at error-passive stations, in chronological order. They do not destroy the frame."""


def undisturbed(senders: tuple[int, ...], frame: CanFrame, esi: bool, rates: BitRates) -> Course:
    """Return the course of an undisturbed and acknowledged transmission attempt.

    Args:
        senders: Stations that send the frame.
        frame: Frame on the bus.
        esi: Whether the senders are error-passive.
        rates: Bit rates of the bus.
    """
    return Course(senders, *undisturbed_times(frame, esi, rates))


def undisturbed_times(frame: CanFrame, esi: bool, rates: BitRates) -> tuple[int, int, int]:
    """Return ``end``, ``recessive`` and ``free`` of :class:`Course` for an undisturbed attempt, in ticks.

    Args:
        frame: Frame on the bus.
        esi: Whether the senders are error-passive.
        rates: Bit rates of the bus.
    """
    free = rates.ticks(frame_bits(frame, esi))
    end = free - INTERMISSION_BITS * rates.nominal_ticks
    return end, end - (ACK_TO_END_BITS - 1) * rates.nominal_ticks, free


def disturbed(
    senders: Sequence[Participant], receivers: Sequence[Participant], hit: Hit | None, rates: BitRates
) -> Course:
    """Return the course of a transmission attempt, including any errors.

    Args:
        senders: Stations that send frames with identical arbitration fields.
        receivers: All other stations on the bus.
        hit: Disturbed bit; None if no rule disturbs the attempt.
        rates: Bit rates of the bus.
    """
    wires = {each.station: wire_frame(each.frame, each.passive) for each in senders if each.frame}
    bus = _OnBus({each.station: each for each in senders}, {each.station: each for each in receivers}, rates)
    while True:
        wire = next(wires[station] for station in bus.sending)
        collision = _first_difference([wires[station].bits for station in bus.sending])
        if hit is not None and (collision is None or hit.bit <= collision):
            if hit.station == -1 or hit.station in bus.sending:
                return _destroyed_by_hit(hit, wire, bus)
            receiver = bus.receiving.get(hit.station)
            if receiver is not None and not receiver.passive:
                return _destroyed_by_receiver(hit, wire, bus)
            if receiver is not None:  # an error-passive receiver cannot destroy the frame
                bus.side_errors.append(_bit_error(wire, hit.bit, Cause.DISTURBED, (hit.station,), rates))
                del bus.receiving[hit.station]
            hit = None
            continue
        if collision is None:
            break
        losers = [station for station in bus.sending if wires[station].bits[collision]]
        if not all(bus.sending[station].passive for station in losers):
            return _collided(collision, losers, wires, bus)
        error = _bit_error(wires[losers[0]], collision, Cause.COLLISION, tuple(losers), rates)
        bus.side_errors.append(error)
        for station in losers:
            del bus.sending[station]
    if not bus.receiving:
        error = _bit_error(wire, wire.ack_slot, Cause.NO_ACK, tuple(bus.sending), rates)
        return _destroyed(error, 0, bus)
    end = rates.ticks(wire.bits_through(len(wire.bits) - 1))
    recessive = end - (ACK_TO_END_BITS - 1) * rates.nominal_ticks
    free = end + INTERMISSION_BITS * rates.nominal_ticks
    return Course(tuple(bus.sending), end, recessive, free, None, tuple(bus.side_errors))


def cut_off(
    frame: CanFrame,
    esi: bool,
    bit: int,
    receivers: Sequence[Participant],
    rates: BitRates,
) -> Course:
    """Return the course of a transmission attempt whose only sender leaves the bus during the frame.

    Args:
        frame: Frame on the bus.
        esi: Whether the sender is error-passive.
        bit: Position of the last transmitted bit.
        receivers: All other stations on the bus.
        rates: Bit rates of the bus.
    """
    wire = wire_frame(frame, esi)
    lag = receiver_lag(wire, bit, wire.bits[bit], _PASSIVE)
    detected = min(bit + lag, len(wire.bits) - 1)
    bus = _OnBus({}, {each.station: each for each in receivers}, rates)
    error = _bit_error(wire, detected, Cause.CUT_OFF, tuple(bus.receiving), rates)
    return _destroyed(error, 0, bus)


@dataclass(slots=True)
class _OnBus:
    """Stations still taking part in a transmission attempt, and the errors so far."""

    sending: dict[int, Participant]
    receiving: dict[int, Participant]
    rates: BitRates
    side_errors: list[BitError] = field(default_factory=list)


def _destroyed_by_hit(hit: Hit, wire: WireFrame, bus: _OnBus) -> Course:
    detecting = tuple(bus.sending) if hit.station == -1 else (hit.station,)
    flag = _PASSIVE if all(bus.sending[station].passive for station in detecting) else _ACTIVE
    seen = wire.bits[hit.bit] ^ (hit.station == -1)
    lag = receiver_lag(wire, hit.bit, seen, flag) if bus.receiving else 0
    if hit.station == -1 and lag == 0:  # the receivers detect the disturbed bit too
        detecting += tuple(bus.receiving)
    error = _bit_error(wire, hit.bit, Cause.DISTURBED, detecting, bus.rates)
    return _destroyed(error, _lag_ticks(wire, hit.bit, lag, bus.rates), bus)


def _destroyed_by_receiver(hit: Hit, wire: WireFrame, bus: _OnBus) -> Course:
    error = _bit_error(wire, hit.bit, Cause.DISTURBED, (hit.station,), bus.rates)
    lag = max(_sender_lag(wire, hit.bit), receiver_lag(wire, hit.bit, wire.bits[hit.bit], _ACTIVE))
    return _destroyed(error, _lag_ticks(wire, hit.bit, lag, bus.rates), bus)


def _collided(bit: int, losers: list[int], wires: dict[int, WireFrame], bus: _OnBus) -> Course:
    dominant = [wires[station] for station in bus.sending if station not in losers]
    lag = max(_sender_lag(wire, bit) for wire in dominant)
    if bus.receiving:
        lag = max(lag, receiver_lag(dominant[0], bit, 0, _ACTIVE))
    loser = wires[losers[0]]
    error = _bit_error(loser, bit, Cause.COLLISION, tuple(losers), bus.rates)
    return _destroyed(error, _lag_ticks(loser, bit, lag, bus.rates), bus)


def _destroyed(error: BitError, lag_ticks: int, bus: _OnBus) -> Course:
    free = error.ticks + lag_ticks + (FLAG_BITS + _AFTER_FLAG_BITS) * bus.rates.nominal_ticks
    flags_are_passive = all(each.passive for each in (*bus.sending.values(), *bus.receiving.values()))
    recessive = error.ticks if flags_are_passive else free - _AFTER_FLAG_BITS * bus.rates.nominal_ticks
    return Course(tuple(bus.sending), error.ticks, recessive, free, error, tuple(bus.side_errors))


def _bit_error(
    wire: WireFrame, bit: int, cause: Cause, detecting: tuple[int, ...], rates: BitRates
) -> BitError:
    return BitError(rates.ticks(wire.bits_through(bit)), bit, cause, detecting)


def _lag_ticks(wire: WireFrame, bit: int, lag: int, rates: BitRates) -> int:
    return lag * (rates.data_ticks if bit in wire.data_phase else rates.nominal_ticks)


def _sender_lag(wire: WireFrame, bit: int) -> int:
    """Return the number of error flag bits up to the sender's next recessive bit, at most 6."""
    later = wire.bits[bit + 1 : bit + 1 + FLAG_BITS]
    return later.index(1) + 1 if 1 in later else FLAG_BITS


def _first_difference(streams: Sequence[tuple[int, ...]]) -> int | None:
    """Return the first bit position at which the bit streams differ; None if they do not differ."""
    for position, bits in enumerate(zip(*streams, strict=False)):
        if 0 < sum(bits) < len(bits):
            return position
    return None
