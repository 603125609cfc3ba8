"""Thread that starts and ends a scene's faults on schedule."""

from __future__ import annotations

from queue import Empty
from typing import NamedTuple

from skinnode.process import clock
from vcan_sim.fault_schedule import FaultSchedule, TimedFault
from vcan_sim.fleet_faults import FleetFaults


class _Start(NamedTuple):
    """Message that starts the schedule."""

    origin_ns: int
    """Monotonic time at scene time 0, in ns."""
    from_s: float
    """Scene time from which the schedule is played, in s."""


class FaultPlayer:
    """Thread that applies a scene's fault schedule to a fleet.

    The thread can be started again after :meth:`stop`. The schedule then continues at the current scene time:
    faults that should have ended end, and faults that are due start.

    Args:
        schedule: Faults of the scene and their times.
        faults: Faults of the fleet, which the thread changes.
    """

    def __init__(self, schedule: FaultSchedule, faults: FleetFaults) -> None:
        self._schedule, self._faults = schedule, faults
        self._origin_ns: int | None = None
        self._active: tuple[TimedFault, ...] = ()
        self._new_thread()

    def _new_thread(self) -> None:
        self._inbox = clock.queue()
        """Queue that receives the start of the schedule, or None to stop the thread."""
        self._thread = clock.thread(self._run, "faults of the scene")

    def start(self) -> None:
        """Start the thread. It waits for :meth:`begin`, unless the schedule has already begun.

        The thread runs on the clock of the calling thread, even if the player was created on another clock.
        """
        self._new_thread()
        if self._origin_ns is not None:
            elapsed_s = (clock.monotonic_ns() - self._origin_ns) * 1e-9
            self._inbox.put(_Start(self._origin_ns, elapsed_s))
        self._thread.start()

    def begin(self, origin_ns: int) -> None:
        """Begin the schedule. Call this method only once.

        Args:
            origin_ns: Monotonic time at scene time 0, in ns.
        """
        self._origin_ns = origin_ns
        self._inbox.put(_Start(origin_ns, 0.0))

    def stop(self) -> None:
        """Stop the thread. Active faults remain active."""
        self._inbox.put(None)
        self._thread.join()

    def _run(self) -> None:
        start: _Start | None = self._inbox.get()
        if start is None:
            return
        due_s: float | None = start.from_s
        while due_s is not None:
            left_s = due_s - (clock.monotonic_ns() - start.origin_ns) * 1e-9
            if left_s > 0.0:
                try:
                    self._inbox.get(timeout=left_s)
                except Empty:
                    continue
                return
            self._follow(due_s)
            due_s = self._schedule.next_change_s(due_s)
        self._inbox.get()

    def _follow(self, t_s: float) -> None:
        """Start and end the faults that are due at scene time ``t_s``."""
        before, self._active = self._active, self._schedule.active(t_s)
        ended = [each for each in before if each not in self._active]
        started = [each for each in self._active if each not in before]
        if ended or started:
            self._faults.follow(ended, started)
