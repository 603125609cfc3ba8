"""Simulated CAN bus: arbitration, transmission attempts, error counters and events.

A frame starts immediately if the bus is idle, and otherwise at the end of the intermission. A frame queued
less than one bit time after a start of frame still takes part in the arbitration (Davis, Burns, Bril,
Lukkien, "Controller Area Network (CAN) schedulability analysis", 2007, section 3). Arbitration is therefore
decided one bit time after the start of frame.

The model has no propagation delay and no oscillator tolerance: all stations see each bit at the same time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from skinnode.errors import ConfigError
from vcan_sim.timed_bus.attempt import (
    BitError,
    Participant,
    cut_off,
    disturbed,
    undisturbed,
    undisturbed_times,
)
from vcan_sim.timed_bus.bit_rates import BitRates
from vcan_sim.timed_bus.confinement import (
    RECOVERY_RUN_BITS,
    RECOVERY_RUNS,
    SUSPEND_BITS,
    ZERO,
    Counters,
    ErrorState,
    reception_failed,
    reception_succeeded,
    transmission_failed,
    transmission_succeeded,
)
from vcan_sim.timed_bus.disturbances import Attempt, Disturbance, Disturbances
from vcan_sim.timed_bus.events import (
    BusOff,
    Cause,
    CountersChanged,
    Delivered,
    ErrorFrame,
    Event,
    Recovered,
)
from vcan_sim.timed_bus.frame import CanFrame, arbitration_key
from vcan_sim.timed_bus.occupancy import Occupancy
from vcan_sim.timed_bus.station import Flight, Station, StationOptions
from vcan_sim.timed_bus.transmit_queue import Waiting
from vcan_sim.timed_bus.wire_frame import wire_frame


class TimedBus:
    """CAN bus and its stations. The times passed in successive calls must not decrease.

    Args:
        stations: Options of the stations; methods refer to a station by its index in this sequence.
        rates: Bit rates of the bus.
        disturbances: Rules that inject errors.

    Raises:
        ConfigError: If a disturbance names a station that does not exist.
    """

    def __init__(
        self,
        stations: Sequence[StationOptions],
        rates: BitRates | None = None,
        disturbances: Sequence[Disturbance] = (),
    ) -> None:
        self._rates = rates or BitRates()
        self._bit = self._rates.nominal_ticks
        self._ticks_per_ns = self._rates.ticks_per_ns
        self._stations = [Station(index, options) for index, options in enumerate(stations)]
        self._disturbances = Disturbances()
        self._now = 0
        self._free = 0
        self._recessive_from = 0
        self._start: int | None = None
        self._flight: Flight | None = None
        self._next: int | None = None
        self._pending: dict[int, Station] = {}
        self._recovering: list[Station] = []
        self._receivers: dict[tuple[int, ...], tuple[int, ...]] = {}
        self._counts_are_zero = True
        self._number = 0
        self._events: list[Event] = []
        self._frames: dict[tuple[int, bool], int] = {}
        self._occupancy = Occupancy()
        for rule in disturbances:
            self.disturb(rule)

    # --- operations of stations

    def send(self, time_ns: int, station: int, frame: CanFrame) -> bool:
        """Queue a frame for transmission.

        Args:
            time_ns: Current time, in ns.
            station: Index of the sending station.
            frame: Frame to send.

        Returns:
            True if the frame was queued, False if the station's queue is full.

        Raises:
            ValueError: If the time is earlier than in a previous call, or if a CAN FD frame is sent on a bus
                without a data bit rate.
            IndexError: If the station does not exist.
        """
        sender = self._at(time_ns, station)
        if frame.fd and self._rates.data_bps is None:
            raise ValueError("frame: got a CAN FD frame, must be a classic frame because data_bps is None")
        capacity = sender.options.capacity
        if capacity is not None and len(sender.queue) + (sender.sending is not None) >= capacity:
            return False
        self._number += 1
        sender.queue.push(Waiting(arbitration_key(frame), self._number, time_ns, frame))
        if station not in self._pending:  # otherwise, it is already waiting for the next arbitration
            self._offer(sender)
        return True

    def clear(self, time_ns: int, station: int) -> None:
        """Discard a station's queued frames. A transmission in progress continues.

        Args:
            time_ns: Current time, in ns.
            station: Index of the station.

        Raises:
            ValueError: If the time is earlier than in a previous call.
            IndexError: If the station does not exist.
        """
        sender = self._at(time_ns, station)
        sender.queue.clear()
        self._withdraw(sender)

    def disconnect(self, time_ns: int, station: int) -> None:
        """Disconnect a station, but keep its queue.

        If the station is the only sender of a frame that has not been acknowledged yet, the frame is cut off
        by an error frame.

        Args:
            time_ns: Current time, in ns.
            station: Index of the station.

        Raises:
            ValueError: If the time is earlier than in a previous call.
            IndexError: If the station does not exist.
        """
        leaving = self._at(time_ns, station)
        if not leaving.connected:
            return
        leaving.connected = False
        self._receivers.clear()
        if leaving in self._recovering:
            self._recovering.remove(leaving)
        if self._flight is not None:
            self._leave(leaving, self._flight)
        self._withdraw(leaving)

    def connect(self, time_ns: int, station: int) -> None:
        """Reconnect a station, and reset both of its error counters to 0.

        Args:
            time_ns: Current time, in ns.
            station: Index of the station.

        Raises:
            ValueError: If the time is earlier than in a previous call.
            IndexError: If the station does not exist.
        """
        joining = self._at(time_ns, station)
        if joining.connected:
            return
        joining.connected = True
        joining.recovers_from = None
        # A station may send after it has seen 11 recessive bits (ISO 11898-1:2015, bus integration). During a
        # frame, these are the last 11 bits before the bus is free.
        joining.ready = self._now + RECOVERY_RUN_BITS * self._rates.nominal_ticks
        self._receivers.clear()
        self._set_counters(self._now, joining, ZERO)
        self._offer(joining)

    def restart(self, time_ns: int, station: int) -> None:
        """Start a station's recovery from bus-off. In any other state, this method does nothing.

        Args:
            time_ns: Current time, in ns.
            station: Index of the station.

        Raises:
            ValueError: If the time is earlier than in a previous call.
            IndexError: If the station does not exist.
        """
        stopped = self._at(time_ns, station)
        if stopped.counters.state is ErrorState.BUS_OFF and stopped.connected:
            if stopped.recovers_from is None or stopped.recovers_from > self._now:
                self._begin_recovery(stopped, self._now)
            self._plan()

    def disturb(self, rule: Disturbance) -> None:
        """Add a rule that injects errors from the next arbitration onwards.

        Args:
            rule: Disturbance rule.

        Raises:
            ConfigError: If the rule names a station that does not exist.
        """
        if rule.station is not None and not 0 <= rule.station < len(self._stations):
            allowed = f"0 to {len(self._stations) - 1}, or None"
            raise ConfigError("disturbances.station", rule.station, allowed)
        self._disturbances.add(rule)

    def undisturb(self, rule: Disturbance) -> None:
        """Remove a disturbance rule.

        The transmission attempt in progress is not affected.

        Args:
            rule: The object that was passed to :meth:`disturb`.

        Raises:
            ValueError: If the rule is not active.
        """
        self._disturbances.remove(rule)

    # --- time

    @property
    def next_event_ns(self) -> int | None:
        """Time (ns) at which to call :meth:`advance` next; None if nothing is pending.

        That call may return an empty list, because some steps of the bus are internal.
        """
        if self._events:
            return self._rates.ceil_ns(self._now)
        return None if self._next is None else self._rates.ceil_ns(self._next)

    def advance(self, time_ns: int) -> list[Event]:
        """Simulate the bus up to a given time, and return the new events in chronological order.

        Args:
            time_ns: End of the simulated interval, in ns.

        Raises:
            ValueError: If the time is earlier than in a previous call.
        """
        self._advance(time_ns)
        events, self._events = self._events, []
        return events

    # --- queries

    def counters(self, station: int) -> Counters:
        """Return the error counters of a station. They determine its error state.

        Args:
            station: Index of the station.
        """
        return self._stations[station].counters

    def waiting(self, station: int) -> int:
        """Return the number of unsent frames of a station, including the frame in transmission.

        Args:
            station: Index of the station.
        """
        sender = self._stations[station]
        return len(sender.queue) + (sender.sending is not None)

    @property
    def only_sender(self) -> int | None:
        """Index of the station with frames to send, if there is exactly one; otherwise None."""
        senders = set(self._pending)
        if self._flight is not None:
            senders.update(self._flight.senders)
        return senders.pop() if len(senders) == 1 else None

    @property
    def frames(self) -> Mapping[tuple[int, bool], int]:
        """Number of delivered frames, keyed by the identifier and by whether it is extended."""
        return MappingProxyType(self._frames)

    def busy_share(self, from_ns: int, to_ns: int) -> float:
        """Return the bus load: the fraction of time occupied by frames, error frames and intermissions.

        Args:
            from_ns: Start of the interval, in ns.
            to_ns: End of the interval, in ns; at most the time of the last call.

        Raises:
            ValueError: If the interval is empty or ends in the future.
        """
        if not from_ns < to_ns <= self._rates.ceil_ns(self._now):
            now_ns = self._rates.ceil_ns(self._now)
            raise ValueError(
                f"interval: got {from_ns} to {to_ns} ns, must not be empty and must end by {now_ns} ns"
            )
        busy_ns = self._occupancy.busy_ns(from_ns, to_ns)
        if self._flight is None and self._start is not None:  # arbitration is pending
            busy_ns += max(0, to_ns - max(from_ns, self._rates.ceil_ns(self._start)))
        return busy_ns / (to_ns - from_ns)

    def forget_load(self, before_ns: int) -> None:
        """Discard the record of the bus load before a given time, to free memory.

        Args:
            before_ns: Start (ns) of the remaining record. Later calls of :meth:`busy_share` must not refer to
                earlier times.
        """
        self._occupancy.forget(before_ns)

    # --- internal steps of the bus

    def _at(self, time_ns: int, station: int) -> Station:
        if not 0 <= station < len(self._stations):
            raise IndexError(f"station: got {station}, must be 0 to {len(self._stations) - 1}")
        up_to_date = self._next is None or self._next > self._now
        if not up_to_date or time_ns * self._ticks_per_ns != self._now:
            self._advance(time_ns)
        return self._stations[station]

    def _advance(self, time_ns: int) -> None:
        ticks = time_ns * self._ticks_per_ns
        if ticks < self._now:
            now_ns = self._rates.ceil_ns(self._now)
            raise ValueError(f"time_ns: got {time_ns}, must be at least {now_ns}, the time of the last call")
        while self._next is not None and self._next <= ticks:
            if not self._deliver_burst(ticks):
                self._step(self._next)
        self._now = ticks

    def _deliver_burst(self, until: int) -> bool:
        """Deliver a run of frames from one sender while no other station can interfere.

        This is a fast path: it gives the same result as :meth:`_step` in about a third of the time.

        Args:
            until: End of the simulated interval, ticks.

        Returns:
            False if another station could interfere. In that case, nothing has been delivered.
        """
        flight, pending = self._flight, self._pending
        if flight is None or self._recovering or self._disturbances or not self._counts_are_zero:
            return False
        course, senders, receivers = flight.course, flight.senders, flight.receivers
        if (
            course.error is not None
            or course.side_errors
            or len(course.senders) != 1
            or senders != course.senders
        ):
            return False
        sender = self._stations[senders[0]]
        if self._receivers.get(senders) is not receivers or (pending and [*pending] != [sender.index]):
            return False
        waiting, start = flight.waiting[sender.index], flight.start
        free, end = start + course.free, start + course.end
        rates, bit, queue = self._rates, self._bit, sender.queue
        ceil_ns, events, frames = rates.ceil_ns, self._events, self._frames
        self._flight = self._start = self._next = None
        while end <= until:
            frame = waiting.frame
            events.append(
                Delivered(ceil_ns(end), sender.index, frame, receivers, waiting.queued_ns, ceil_ns(start))
            )
            identifier = (frame.can_id, frame.extended)
            frames[identifier] = frames.get(identifier, 0) + 1
            sender.sending, self._free = None, free
            if not pending:
                return True
            start = max(free, sender.ready)
            if start + bit > until:
                self._start, self._next = start, start + bit
                return True
            sender.sending = waiting = queue.pop()
            if not len(queue):
                pending.clear()
            after_end, recessive, after_free = undisturbed_times(waiting.frame, False, rates)
            free, end = start + after_free, start + after_end
            self._recessive_from = start + recessive
            self._occupancy.add(ceil_ns(start), ceil_ns(free))
        course = undisturbed(senders, waiting.frame, False, rates)
        self._flight = Flight(start, course, {sender.index: waiting}, senders, receivers)
        self._next = end
        return True

    def _step(self, now: int) -> None:
        flight = self._flight
        if flight is not None:
            if flight.side < len(flight.course.side_errors):
                self._side_error(now, flight)
            elif flight.course.error is None:
                self._deliver(now, flight)
            else:
                self._destroy(now, flight, flight.course.error)
        elif self._recovering and self._recover(now):
            pass
        else:
            self._arbitrate(now)
        self._plan()

    def _plan(self) -> None:
        """Schedule the next internal step of the bus."""
        if self._flight is not None:
            self._next = self._flight.next
            return
        due = None if self._start is None else self._start + self._bit
        if not self._recovering:
            self._next = due
            return
        for station in self._recovering:
            at = self._recovery_end(station)
            # A start of frame before this time interrupts the recessive run.
            if (self._start is None or at <= self._start) and (due is None or at < due):
                due = at
        self._next = due

    def _offer(self, sender: Station) -> None:
        """Enter a station in the next arbitration if it has a frame to send."""
        if not len(sender.queue) or not sender.on_bus:
            return
        self._pending[sender.index] = sender
        if self._flight is None:
            start = max(self._now, self._free, sender.ready)
            if self._start is None or start < self._start:
                self._start = start
                self._plan()

    def _withdraw(self, sender: Station) -> None:
        """Withdraw a station from the next arbitration, and reschedule the start of frame."""
        if self._pending.pop(sender.index, None) and self._flight is None:
            started = self._start is not None and self._start <= self._now
            if not started:
                self._choose_start(self._now)
        self._plan()

    def _choose_start(self, now: int) -> None:
        if self._pending:
            earliest = min([station.ready for station in self._pending.values()])
            self._start = max(now, self._free, earliest)
        else:
            self._start = None

    # --- arbitration

    def _arbitrate(self, now: int) -> None:
        start = now - self._bit
        self._start = None
        contenders = [station for station in self._pending.values() if station.ready <= start]
        if not contenders:  # every contender has withdrawn since the start of frame
            self._choose_start(now)
            return
        if len(contenders) == 1:
            winners = contenders
        else:
            heads = [station.queue.head().key for station in contenders]
            lowest = min(heads)
            winners = [station for station, key in zip(contenders, heads, strict=True) if key == lowest]
        for station in self._recovering:
            station.runs_seen += self._runs(station, start)
        self._flight = flight = self._take_off(start, winners)
        self._recessive_from = start + flight.course.recessive
        ceil_ns = self._rates.ceil_ns
        self._occupancy.add(ceil_ns(start), ceil_ns(start + flight.course.free))

    def _take_off(self, start: int, winners: list[Station]) -> Flight:
        waiting = {}
        for station in winners:
            station.sending = waiting[station.index] = station.queue.pop()
            if not len(station.queue):
                del self._pending[station.index]
        first = winners[0]
        senders = tuple(waiting)
        frame = waiting[first.index].frame
        receivers = self._receivers_of(senders)
        hit = None
        if self._disturbances:
            hit = self._disturbances.hit(self._attempt(frame, first.passive, start))
        if len(winners) == 1 and hit is None and receivers:
            course = undisturbed(senders, frame, first.passive, self._rates)
        else:
            sending = [
                Participant(station.index, station.passive, waiting[station.index].frame)
                for station in winners
            ]
            course = disturbed(sending, self._participants(receivers), hit, self._rates)
        return Flight(start, course, waiting, senders, receivers)

    def _attempt(self, frame: CanFrame, esi: bool, start: int) -> Attempt:
        def n_bits() -> int:
            return len(wire_frame(frame, esi).bits) - 1  # receivers accept the frame before its last bit

        def bit_at(time_ns: int) -> int | None:
            return self._bit_at(frame, esi, time_ns * self._rates.ticks_per_ns - start)

        return Attempt(frame, n_bits, bit_at)

    def _bit_at(self, frame: CanFrame, esi: bool, ticks: int) -> int | None:
        """Return the position of the bit sent ``ticks`` after the start of frame; None outside the frame."""
        if ticks < 0 or ticks >= undisturbed((), frame, esi, self._rates).end:
            return None
        wire = wire_frame(frame, esi)
        return next(bit for bit in range(len(wire.bits)) if self._rates.ticks(wire.bits_through(bit)) > ticks)

    def _receivers_of(self, senders: tuple[int, ...]) -> tuple[int, ...]:
        found = self._receivers.get(senders)
        if found is None:
            found = tuple(each.index for each in self._stations if each.on_bus and each.index not in senders)
            self._receivers[senders] = found
        return found

    def _participants(self, stations: Sequence[int]) -> list[Participant]:
        return [Participant(index, self._stations[index].passive) for index in stations]

    # --- outcomes

    def _deliver(self, now: int, flight: Flight) -> None:
        course, ceil_ns = flight.course, self._rates.ceil_ns
        time_ns, started_ns = ceil_ns(now), ceil_ns(flight.start)
        receivers = self._still_receiving(flight)
        heard = receivers
        for index in course.senders:
            sent = flight.waiting[index]
            self._events.append(Delivered(time_ns, index, sent.frame, heard, sent.queued_ns, started_ns))
            self._stations[index].sending = None
            heard = ()
        identifier = (sent.frame.can_id, sent.frame.extended)
        self._frames[identifier] = self._frames.get(identifier, 0) + 1
        if not self._counts_are_zero:
            for index in course.senders:
                self._set_counters(now, self._stations[index], transmission_succeeded(self.counters(index)))
            for index in receivers:
                self._set_counters(now, self._stations[index], reception_succeeded(self.counters(index)))
            self._counts_are_zero = all(station.counters == ZERO for station in self._stations)
        self._land(now, flight)

    def _destroy(self, now: int, flight: Flight, error: BitError) -> None:
        senders = flight.course.senders
        frames = tuple(flight.waiting[index].frame for index in senders or flight.waiting)
        time_ns = self._rates.ceil_ns(now)
        self._events.append(
            ErrorFrame(time_ns, senders, frames, error.bit, error.cause, error.detected_by, True)
        )
        receivers = self._still_receiving(flight)
        for index in senders:
            unanswered = error.cause is Cause.NO_ACK and not receivers
            counters = transmission_failed(self.counters(index), unanswered=unanswered)
            self._set_counters(now, self._stations[index], counters)
        for index in receivers:
            first = error.cause is Cause.DISTURBED and error.detected_by == (index,)
            self._set_counters(
                now, self._stations[index], reception_failed(self.counters(index), first=first)
            )
        for index in senders:
            self._return(self._stations[index])
        self._land(now, flight)

    def _side_error(self, now: int, flight: Flight) -> None:
        error = flight.course.side_errors[flight.side]
        flight.side += 1
        senders = tuple(index for index in error.detected_by if index in flight.waiting)
        frames = tuple(flight.waiting[index].frame for index in senders)
        if not frames:
            frames = (flight.waiting[flight.course.senders[0]].frame,)
        time_ns = self._rates.ceil_ns(now)
        self._events.append(
            ErrorFrame(time_ns, senders, frames, error.bit, error.cause, error.detected_by, False)
        )
        for index in error.detected_by:
            station = self._stations[index]
            if index in senders:
                self._set_counters(now, station, transmission_failed(station.counters))
                self._return(station)
                self._suspend(station, flight)
            else:
                self._set_counters(now, station, reception_failed(station.counters))

    def _still_receiving(self, flight: Flight) -> tuple[int, ...]:
        """Return the connected stations that have so far detected no error in the frame."""
        receivers, side_errors = flight.receivers, flight.course.side_errors
        if not side_errors and self._receivers.get(flight.senders) is receivers:
            return receivers
        lost = {station for error in side_errors for station in error.detected_by}
        return tuple(index for index in receivers if self._stations[index].on_bus and index not in lost)

    def _land(self, now: int, flight: Flight) -> None:
        """End the transmission attempt in progress."""
        self._flight = None
        self._free = flight.start + flight.course.free
        for index in flight.course.senders:
            self._suspend(self._stations[index], flight)
        self._choose_start(now)

    def _return(self, station: Station) -> None:
        """Put a station's interrupted frame back into its queue."""
        if station.sending is not None:
            station.queue.put_back(station.sending)
            station.sending = None
        if station.on_bus and len(station.queue):
            self._pending[station.index] = station

    def _suspend(self, station: Station, flight: Flight) -> None:
        """Apply suspend transmission to an error-passive station (Bosch CAN 2.0, part B, section 3.1.5)."""
        if station.passive:
            free = flight.start + flight.course.free
            station.ready = free + SUSPEND_BITS * self._rates.nominal_ticks

    def _leave(self, leaving: Station, flight: Flight) -> None:
        """Revise the course of the current transmission attempt after a station has been disconnected."""
        course = flight.course
        if course.error is not None:
            return
        if leaving.index in course.senders and len(course.senders) > 1:  # other stations send the same bits
            flight.course = course._replace(
                senders=tuple(each for each in course.senders if each != leaving.index)
            )
            self._return(leaving)
            return
        sender = self._stations[course.senders[0]]
        frame = flight.waiting[sender.index].frame
        bit = self._bit_at(frame, sender.passive, self._now - flight.start)
        if bit is None or bit > wire_frame(frame, sender.passive).ack_slot:
            return  # the frame has been acknowledged
        receivers = self._participants(self._still_receiving(flight))
        if leaving is sender:
            changed = cut_off(frame, sender.passive, bit, receivers, self._rates)
            self._return(leaving)
        elif not receivers:
            sending = [
                Participant(index, self._stations[index].passive, flight.waiting[index].frame)
                for index in course.senders
            ]
            changed = disturbed(sending, [], None, self._rates)
        else:
            return
        flight.course, flight.side = changed, 0
        self._recessive_from = flight.start + changed.recessive
        self._occupancy.end_last_at(self._rates.ceil_ns(flight.start + changed.free))

    # --- fault confinement

    def _set_counters(self, now: int, station: Station, counters: Counters) -> None:
        if counters == station.counters:
            return
        before = station.counters.state
        station.counters = counters
        station.passive = counters.state is ErrorState.PASSIVE
        self._counts_are_zero = False
        time_ns = self._rates.ceil_ns(now)
        self._events.append(CountersChanged(time_ns, station.index, counters))
        if counters.state is ErrorState.BUS_OFF and before is not ErrorState.BUS_OFF:
            self._events.append(BusOff(time_ns, station.index))
            self._pending.pop(station.index, None)
            self._receivers.clear()
            if station.options.restart_ns is not None:
                self._begin_recovery(station, now + station.options.restart_ns * self._rates.ticks_per_ns)

    def _begin_recovery(self, station: Station, at: int) -> None:
        station.recovers_from, station.runs_seen = at, 0
        if station not in self._recovering:
            self._recovering.append(station)

    def _runs(self, station: Station, until: int) -> int:
        """Return the number of complete recessive runs seen by a recovering station before ``until``."""
        assert station.recovers_from is not None
        since = max(station.recovers_from, self._recessive_from)
        return max(0, until - since) // (RECOVERY_RUN_BITS * self._rates.nominal_ticks)

    def _recovery_end(self, station: Station) -> int:
        """Return the time (ticks) at which a station recovers if the bus stays recessive."""
        assert station.recovers_from is not None
        since = max(station.recovers_from, self._recessive_from)
        missing = (RECOVERY_RUNS - station.runs_seen) * RECOVERY_RUN_BITS
        return since + missing * self._rates.nominal_ticks

    def _recover(self, now: int) -> bool:
        """Complete the bus-off recoveries that are due, and return whether there were any."""
        complete = [station for station in self._recovering if self._recovery_end(station) == now]
        if self._start is not None and self._start < now:
            return False
        for station in complete:
            self._recovering.remove(station)
            station.recovers_from = None
            self._receivers.clear()
            self._set_counters(now, station, ZERO)
            self._events.append(Recovered(self._rates.ceil_ns(now), station.index))
            if len(station.queue):
                self._pending[station.index] = station
        if complete:
            self._choose_start(now)
        return bool(complete)
