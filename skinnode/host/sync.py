"""Produce SYNC with a counter at a drift-free rate, or follow another producer's SYNC."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from skinnode.canopen.indices import SYNC_COB_ID
from skinnode.errors import BusError
from skinnode.host.containment import Defects, keep_on
from skinnode.process import clock
from skinnode.process.closing import Closing


class Tick(NamedTuple):
    """Number and monotonic time (ns) of one SYNC."""

    number: int
    t_ns: int


@dataclass(frozen=True, slots=True)
class SyncStats:
    """Counters of SYNC messages."""

    sent: int
    missed: int
    """Number of SYNC periods skipped because the sending thread was too late."""
    failed: int
    """Number of SYNC messages that could not be sent on a bus."""
    latest_ns: int
    """Largest delay (ns) of a SYNC message relative to its due time."""
    received: int = 0
    """Number of SYNC messages received on buses that another master runs."""
    irregular: int = 0
    """Number of received SYNC messages whose counter is missing, invalid or out of sequence. A lost SYNC or a
    second producer may be the cause.
    """


class Ticks:
    """Record of the newest SYNC for each counter value.

    Threads: the thread that sends or follows SYNC writes; the mainline reads.
    """

    def __init__(self, counter_overflow: int) -> None:
        self.counter_overflow = counter_overflow
        self._ticks: list[Tick | None] = [None] * (counter_overflow + 1)
        self.newest = 0
        """Number of the newest SYNC; 0 before the first one."""

    def note(self, number: int, t_ns: int) -> int:
        """Store the time of SYNC ``number``. Return its counter (1 to ``counter_overflow``)."""
        counter = self.counter_of(number)
        self._ticks[counter] = Tick(number, t_ns)
        self.newest = number
        return counter

    def counter_of(self, number: int) -> int:
        """Return the counter of SYNC ``number``."""
        return (number - 1) % self.counter_overflow + 1

    def find(self, counter: int) -> Tick | None:
        """Return the SYNC of a scan that has just arrived; None if no SYNC has had the scan's counter value.

        If the SYNC was lost, the newest one with this counter value is one counter cycle older than the scan.
        The result then has the right number and the time 0. A SYNC that would be more than three quarters of
        a cycle old is regarded as the lost SYNC of the next cycle.
        """
        overflow = self.counter_overflow
        tick = self._ticks[counter] if 0 < counter <= overflow else None
        if tick is None:
            return None
        most = overflow - overflow // 4
        newest = self.newest
        age = newest - tick.number
        if age < most:
            return tick
        age %= overflow
        return Tick(newest - age + (overflow if age >= most else 0), 0)


class SyncFollower:
    """Follower of another producer's SYNC; stores the SYNC times in ``ticks``. Used only by the mainline."""

    def __init__(self, ticks: Ticks) -> None:
        self._ticks = ticks
        self.received = self.irregular = 0
        self.t_newest_ns = 0
        """Monotonic time (ns) of the newest SYNC; 0 before the first one."""

    def on_sync(self, data: bytes, t_ns: int) -> None:
        """Process a received SYNC. A SYNC without a valid counter is counted but not stored."""
        self.received += 1
        self.t_newest_ns = t_ns
        overflow = self._ticks.counter_overflow
        if len(data) != (1 if overflow else 0) or (overflow and not 1 <= data[0] <= overflow):
            self.irregular += 1
            return
        if not overflow:
            return
        newest = self._ticks.newest
        ahead = (data[0] - newest - 1) % overflow + 1  # 1 if no SYNC was lost
        if newest == 0:
            self._ticks.note(data[0], t_ns)
            return
        self.irregular += ahead != 1
        self._ticks.note(newest + ahead, t_ns)


Send = Callable[[int, bytes], None]


class SyncProducer(Closing):
    """Producer of simultaneous or staggered SYNC on one or more buses; runs until :meth:`close`.

    The counter runs from 1 to its overflow value (CiA 301, 0x1019). SYNC number n + 1 is due n periods after
    the first SYNC. If the thread is a whole period late, it skips that period, so that two SYNC messages are
    never sent in quick succession. A SYNC that has been sent on one bus is also sent on the others.

    Threads: a dedicated thread sends the SYNC messages.

    Args:
        buses: For each bus, the function that sends frames, and the SYNC times.
        period_s: SYNC period (s).
        stagger_s: Delay (s) of SYNC from one bus to the next.
        defects: For each bus, the collector of exceptions.
    """

    def __init__(
        self,
        buses: Sequence[tuple[Send, Ticks]],
        period_s: float,
        stagger_s: float = 0.0,
        defects: Sequence[Defects] = (),
    ) -> None:
        self._buses = tuple(buses)
        self._defects = tuple(defects) or tuple(Defects("SYNC") for _ in buses)
        self._due_ns, self._number = clock.monotonic_ns(), 0
        self._period_ns, self._stagger_ns = round(period_s * 1e9), round(stagger_s * 1e9)
        self._sent = self._missed = self._failed = self._latest_ns = 0
        self._stop = clock.event()
        self._thread = clock.thread(target=self._run, name="sync")
        self._thread.start()

    def stats(self) -> SyncStats:
        """Return the counters. Thread-safe."""
        return SyncStats(self._sent, self._missed, self._failed, self._latest_ns)

    def close(self) -> None:
        """Stop sending SYNC, and join the sending thread."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        self._due_ns = clock.monotonic_ns()
        keep_on(self._turn, self._defects[0], "sending SYNC")

    def _turn(self) -> bool:
        """Send the next SYNC at its due time. Return False if the thread must end."""
        if self._wait(self._due_ns):
            return False
        self._number += 1
        due_ns, self._due_ns = self._due_ns, self._due_ns + self._period_ns
        now_ns = clock.monotonic_ns()  # all buses share one SYNC time
        for i in range(len(self._buses)):
            try:
                self._send(i, due_ns + i * self._stagger_ns, now_ns)
            except BusError:  # the bus may recover; the assembler counts the missed scans
                self._failed += 1
            except Exception as error:
                self._failed += 1
                self._defects[i].report("sending SYNC", error)
        self._sent += 1
        skipped = max(0, (clock.monotonic_ns() - self._due_ns) // self._period_ns)
        self._missed += skipped
        self._due_ns += skipped * self._period_ns
        return True

    def _send(self, i: int, due_ns: int, now_ns: int) -> None:
        send, ticks = self._buses[i]
        if i and self._stagger_ns:
            self._wait(due_ns)
            now_ns = clock.monotonic_ns()
        self._latest_ns = max(self._latest_ns, now_ns - due_ns)
        # store the time before sending: scans are matched to it as soon as they arrive
        payload = bytes([ticks.note(self._number, now_ns)])
        send(SYNC_COB_ID, payload)

    def _wait(self, until_ns: int) -> bool:
        """Wait until ``until_ns`` or :meth:`close`. Return whether the producer was closed."""
        return self._stop.wait(max(0.0, (until_ns - clock.monotonic_ns()) * 1e-9))
