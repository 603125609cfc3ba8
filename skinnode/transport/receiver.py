"""Threads that receive CAN frames and put them into bounded queues, from which a reader thread takes them.

Frames that arrive while a queue is full are dropped and counted.
"""

from __future__ import annotations

import contextlib
import functools
import queue
import select
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

CAPACITY_FRAMES: Final = 16384
"""Default capacity of a queue, in frames. It holds 2 s of traffic from a fully loaded 1 Mbit/s bus (8,000
frames/s)."""

_POLL_S: Final = 0.02
"""Maximum time (s) to wait for a frame before the thread checks whether it must stop."""
_POLL_NS: Final = round(_POLL_S * 1e9)

GATHER_NS: Final = 1_500_000
"""Pause (ns) between batches of frames. Without it, the receiving thread would wake up for every frame, up to
8,000 times per second. The pause does not affect the timestamps of the frames."""

LONG_NS: Final = 5_000_000
"""Pause (ns) between batches of frames while all arrival times are predicted. An unexpected frame is delayed
by up to 1.5 times this pause."""

_BEFORE_NS: Final = 800_000
"""Time (ns) before a predicted arrival at which the preceding frames are fetched, so that the predicted frame
itself is fetched without delay."""
_SHORT_NS: Final = 300_000
"""Minimum pause (ns) between batches of frames; used around a predicted arrival."""
_LATE_NS: Final = 600_000
"""Time (ns) after a predicted arrival during which the minimum pause is used."""
_GIVEN_UP_NS: Final = 200_000_000
"""Time (ns) after its predicted arrival at which a frame is considered lost."""
_ANSWER_NS: Final = 20_000_000
"""Time (ns) after a request within which the response is expected."""
_LAG_NS: Final = 50_000
"""Time (ns) from the arrival of a frame until it can be read from the socket."""


class Intake:
    """Bounded queue of frames between a receiving thread and the reader thread.

    While the queue is full, new frames are dropped and counted in :attr:`dropped`.

    Threads: only the reader thread may call :meth:`take` and :meth:`expect`. Any thread may call
    :meth:`asked`. Only the receiving thread may call the other methods. For a port that announces its frames,
    the reader thread is also the receiving thread.

    Args:
        port: Port from which frames are received.
        capacity: Maximum number of frames in the queue.

    Raises:
        ValueError: if ``capacity`` is below 1.
    """

    def __init__(self, port: CanPort, capacity: int = CAPACITY_FRAMES) -> None:
        if capacity < 1:
            raise ValueError(f"capacity: got {capacity}, must be at least 1")
        self.port = port
        self.seen_ns = 0
        """Monotonic time (ns) up to which all received frames have been queued or dropped."""
        self.due_ns = 0
        """Monotonic time (ns) of the next :meth:`fetch`."""
        self._capacity = capacity
        self._queue: deque[list[Frame]] = deque()
        # _taken is written by the reader thread, _put and _dropped by the receiving thread.
        self._put = self._taken = self._dropped = 0
        self._error: Exception | None = None
        self._expected: dict[str, tuple[int, ...]] = {}
        self._first_ns = 0  # earliest predicted arrival; 0 if any group has no prediction
        self._asked_ns = 0

    @property
    def dropped(self) -> int:
        """Number of frames dropped because this queue was full.

        :attr:`CanPort.dropped` counts the frames dropped by the kernel.
        """
        return self._dropped

    @property
    def queued(self) -> int:
        """Number of frames in the queue."""
        taken = self._taken  # must be read before _put; otherwise, the result might be negative
        return self._put - taken

    def take(self) -> list[Frame]:
        """Return all queued frames in order of arrival, without waiting.

        Raises:
            BusError: if the bus has failed and the queue is empty.
            Exception: any other exception raised by the port, if the queue is empty.
        """
        # Read the error first, so that no frame received before the error is missed.
        error, batches = self._error, self._queue
        if not batches:
            if error is not None:
                raise error
            return []
        frames = batches.popleft()
        for _ in range(len(batches)):
            frames += batches.popleft()
        self._taken += len(frames)
        return frames

    def expect(self, what: str, times_ns: tuple[int, ...]) -> None:
        """Predict when the last frame of a group arrives, so that it is fetched without delay.

        Args:
            what: Name of the group. A new prediction replaces the previous one.
            times_ns: Possible arrival times on the monotonic clock, in ns and in ascending order; empty if
                unknown.
        """
        self._expected[what] = times_ns
        self._first_ns = min([times[0] if times else 0 for times in self._expected.values()])

    def asked(self, t_ns: int) -> None:
        """Announce that a response to a request sent at monotonic time ``t_ns`` is expected."""
        self._asked_ns = t_ns

    # --- called by the receiving thread

    def gather(self, now_ns: int) -> None:
        """Choose the time of the next fetch, :attr:`due_ns`."""
        known = now_ns > self._asked_ns + _ANSWER_NS
        if now_ns < self._first_ns:  # fast path, because this method runs after every batch
            awaited_ns = _before(self._first_ns, now_ns)
        else:
            awaited_ns, all_known = self._next_awaited(now_ns)
            known &= all_known
        self.due_ns = min(awaited_ns, _together(now_ns, LONG_NS if known else GATHER_NS))

    def _next_awaited(self, now_ns: int) -> tuple[int, bool]:
        """Return the next predicted frame's fetch time (ns), and whether all arrivals are predicted."""
        awaited_ns, all_known = now_ns + LONG_NS, bool(self._expected)
        for times in tuple(self._expected.values()):
            for t_ns in times:
                if now_ns < t_ns + _LATE_NS:
                    awaited_ns = min(awaited_ns, _before(t_ns, now_ns))
                    break
            else:
                all_known &= bool(times) and now_ns > times[-1] + _GIVEN_UP_NS
        return awaited_ns, all_known

    @property
    def failed(self) -> bool:
        """Whether an error has stopped reception. :meth:`Receiver.resume` restarts it."""
        return self._error is not None

    def resume(self) -> None:
        """Clear the error."""
        self._error = None

    def fetch(self, timeout_s: float) -> bool:
        """Move all received frames from the port to the queue.

        Args:
            timeout_s: Maximum time to wait for a frame, in s.

        Returns:
            Whether there are new frames or an error for :meth:`take`.
        """
        now_ns = clock.monotonic_ns()
        try:
            frames = self.port.recv_batch(timeout_s)
        except Exception as error:  # passed to the reader thread
            self._error = error
            return True
        if not frames:
            self.seen_ns = now_ns
            return False
        seen_ns = frames[-1].t_ns
        room = self._capacity - self.queued
        if len(frames) > room:
            self._dropped += len(frames) - room
            frames = frames[:room]
        if frames:
            self._put += len(frames)
            self._queue.append(frames)
        self.seen_ns = seen_ns
        return True


@dataclass(slots=True)
class _Shared:
    """State of the receiving thread shared by several ports."""

    intakes: dict[Intake, None]
    """Intakes as keys, in the order in which they were added."""
    poll: select.poll


class Receiver(Closing):
    """Receives frames from several ports until :meth:`close` is called.

    All ports that can be polled (socketcan and udp_multicast) share one receiving thread. Ports that announce
    their frames (timed) are read in :meth:`wait`, without a thread. Each other port has its own thread,
    because receiving with python-can can block. If a port fails, reception from the other ports continues.

    Args:
        intakes: Queues to fill, one per port.
        on_defect: Callback for an exception that is not raised by a port. Reception then continues.
    """

    def __init__(
        self, intakes: Sequence[Intake], on_defect: Callable[[Exception], object] = lambda error: None
    ) -> None:
        self._on_defect = on_defect
        self._news: queue.SimpleQueue[None] = clock.simple_queue()
        self._joining: deque[Intake] = deque()  # intakes that the shared thread has yet to add
        self._stop = clock.event()
        self._shared: threading.Thread | None = None
        self._alone: dict[Intake, threading.Thread] = {}
        self._signalled: dict[Intake, None] = {}
        self._announced: deque[Intake] = deque()
        self._swept_ns = 0  # time at which all signalled intakes were last fetched
        self._fresh: deque[Intake] = deque()  # intakes with frames or an error since the last wait
        if any(intake.port.pollable for intake in intakes):
            self._shared = clock.thread(target=self._receive_batches, name="receive")
            self._shared.start()
        for intake in intakes:
            self.resume(intake)

    def wait(self, timeout_s: float) -> list[Intake]:
        """Wait up to ``timeout_s`` for frames or an error in any intake. Only one thread may wait.

        Returns:
            Intakes that have received frames or an error since the last call.
        """
        with contextlib.suppress(queue.Empty):
            self._news.get(timeout=timeout_s)
        if self._signalled:
            self._fetch_signalled()
        return _drained(self._fresh)

    def resume(self, intake: Intake) -> None:
        """Resume reception from a port that has been reopened after a failure. Any thread may call this."""
        if intake.port.pollable:
            intake.resume()
            self._joining.append(intake)
            return
        if (signalling := intake.port.signalling) is not None:
            intake.resume()
            self._signalled[intake] = None
            signalling.call_on_arrival(functools.partial(self._on_signal, intake))
            self._on_signal(intake)  # frames may already have arrived
            return
        if intake in self._alone:
            # The error causes the old thread to end, so it must not be cleared earlier.
            self._alone[intake].join()
        intake.resume()
        name = f"receive {intake.port.config.name}"
        thread = clock.thread(target=self._receive_alone, args=(intake,), name=name)
        thread.start()
        self._alone[intake] = thread  # not before start(), because close() joins these threads

    def close(self) -> None:
        """Stop the receiving threads. The ports stay open."""
        self._stop.set()
        for thread in self._alone.values():
            thread.join()
        if self._shared is not None:
            self._shared.join()

    def _on_signal(self, intake: Intake) -> None:
        self._announced.append(intake)
        self._notify()

    def _fetch_signalled(self) -> None:
        """Fetch the announced frames. Fetch from all ports every :data:`_POLL_S`.

        This detects failed ports, and updates :attr:`Intake.seen_ns` for ports without frames.
        """
        now_ns = clock.monotonic_ns()
        intakes = _drained(self._announced)
        if now_ns - self._swept_ns >= _POLL_NS:
            intakes, self._swept_ns = list(self._signalled), now_ns
        for intake in intakes:
            if intake.failed:
                continue
            try:
                if intake.fetch(0.0):
                    self._fresh.append(intake)
                    self._gather_signalled(intake, now_ns)
            except Exception as error:
                self._on_defect(error)

    def _gather_signalled(self, intake: Intake, now_ns: int) -> None:
        """Fetch the remaining frames, and defer the port's announcements until the next fetch is due."""
        while not intake.failed and intake.fetch(0.0):
            pass
        intake.gather(now_ns)
        port = intake.port.signalling
        if port is not None:
            port.hold_until(intake.due_ns)

    def _receive_batches(self) -> None:
        shared = _Shared({}, select.poll())
        while True:
            try:
                if self._stop.is_set():
                    return
                self._receive_batch(shared)
            except Exception as error:
                self._on_defect(error)
                clock.sleep(_POLL_S)

    def _receive_batch(self, shared: _Shared) -> None:
        """Wait for frames from the shared ports, fetch them, and pause."""
        intakes = shared.intakes
        if self._joining:
            while self._joining:
                intakes[self._joining[0]] = None
                self._joining.popleft()
            shared.poll = _poll_of(intakes)
        now_ns = clock.monotonic_ns()
        fetched = [intake for intake in intakes if intake.due_ns <= now_ns + _SHORT_NS]
        if not _fetch(fetched):
            fetched = list(intakes)
            if not _fetch(fetched):
                shared.poll.poll(_POLL_S * 1e3)
                for intake in intakes:
                    intake.due_ns = 0
                return
        failed = [intake for intake in intakes if intake.failed]
        if failed:
            for intake in failed:
                del intakes[intake]
            shared.poll = _poll_of(intakes)
        self._fresh.extend(fetched)
        self._notify()
        now_ns = clock.monotonic_ns()
        for intake in fetched:
            intake.gather(now_ns)
        due_ns = min([intake.due_ns for intake in intakes], default=now_ns + GATHER_NS)
        clock.sleep(max(0, due_ns - now_ns) * 1e-9)

    def _receive_alone(self, intake: Intake) -> None:
        while True:
            try:
                if self._stop.is_set() or intake.failed:
                    return
                # After a timeout, fetch once more: frames may have arrived while the thread was suspended.
                if intake.fetch(_POLL_S) or intake.fetch(0.0):
                    self._fresh.append(intake)
                    self._notify()
                    if intake.port.reads_batches:
                        now_ns = clock.monotonic_ns()
                        intake.gather(now_ns)
                        clock.sleep(max(0, intake.due_ns - now_ns) * 1e-9)
            except Exception as error:
                self._on_defect(error)
                clock.sleep(_POLL_S)

    def _notify(self) -> None:
        if self._news.empty():  # one notification serves all intakes
            self._news.put(None)


def _drained(intakes: deque[Intake]) -> list[Intake]:
    """Remove all intakes from a queue, and return each of them once, in order."""
    found: dict[Intake, None] = {}
    while intakes:
        found[intakes.popleft()] = None
    return list(found)


def _fetch(intakes: Iterable[Intake]) -> bool:
    """Fetch frames for all ``intakes``. Return whether there are new frames or an error."""
    return sum(intake.fetch(0.0) for intake in intakes) > 0  # any() would stop at the first success


def _together(now_ns: int, pause_ns: int) -> int:
    """Return the time (ns) at which a pause of about ``pause_ns`` ends.

    Pauses end at multiples of ``pause_ns``, so that all buses are read at the same time. A pause therefore
    lasts 0.5 to 1.5 times ``pause_ns``.
    """
    return (now_ns + pause_ns // 2) // pause_ns * pause_ns + pause_ns


def _before(t_ns: int, now_ns: int) -> int:
    """Return the time (ns) of the next fetch, given that a frame is predicted to arrive at ``t_ns``."""
    due_ns = t_ns + _LAG_NS
    if due_ns >= now_ns + _BEFORE_NS + GATHER_NS:
        due_ns -= _BEFORE_NS
    return max(now_ns + _SHORT_NS, due_ns)


def _poll_of(intakes: Iterable[Intake]) -> select.poll:
    poll = select.poll()
    for intake in intakes:
        with contextlib.suppress(ValueError):  # a closed port; the next fetch reports it
            poll.register(intake.port.fileno(), select.POLLIN)
    return poll


def drain(port: CanPort, within_s: float) -> list[Frame]:
    """Return all frames that arrive within ``within_s``. No other thread may receive from the port."""
    frames: list[Frame] = []
    end_ns = clock.monotonic_ns() + int(within_s * 1e9)
    while (left_ns := end_ns - clock.monotonic_ns()) > 0:
        frame = port.recv(left_ns * 1e-9)
        if frame is not None:
            frames.append(frame)
    return frames
