"""Receive CAN frames on threads that only copy the frames into bounded queues, and count dropped frames.

A single reader thread takes all queued frames at a time.
"""

from __future__ import annotations

import contextlib
import queue
import select
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from skinnode.process import clock
from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

CAPACITY_FRAMES: Final = 16384
"""Capacity of an intake, frames: 2 s of traffic on a fully loaded bus at 1 Mbit/s (8,000 frames/s). If the
reader thread pauses for longer than 2 s, frames are lost."""

_POLL_S: Final = 0.02
"""Maximum time that a receiving thread waits for a frame before it checks whether to end, s."""


GATHER_NS: Final = 1_500_000
"""Pause after receiving a batch of frames, ns; comparable to a network card's interrupt moderation. Without
the pause, the thread would wake for each frame, 8,000 times a second, at a higher cost than handling the
frames. The first frame after a period of silence is not delayed, and every frame keeps its original arrival
time."""

LONG_NS: Final = 5_000_000
"""Pause after receiving a batch if the arrival time of every awaited frame is predicted, ns. An unpredicted
frame may remain in the kernel for up to 1.5 times this pause."""

_BEFORE_NS: Final = 800_000
"""Lead time of an extra fetch before each predicted arrival, ns. The extra fetch leaves little work for the
moment when the predicted frame arrives."""
_SHORT_NS: Final = 300_000
"""Minimum pause between two fetches, ns; used while a predicted frame is imminent or slightly overdue."""
_LATE_NS: Final = 600_000
"""Period after a predicted arrival, ns, in which the receiver fetches at the minimum pause."""
_GIVEN_UP_NS: Final = 200_000_000
"""Time limit, after a predicted arrival, for the predicted frame to arrive, ns."""
_ANSWER_NS: Final = 20_000_000
"""Period after sending a request, ns, in which a response may arrive at any time."""
_LAG_NS: Final = 50_000
"""Delay from a frame's arrival until the frame can be read from the socket, ns."""


class Intake:
    """Bounded queue between the receiving thread of a port and the reader.

    If the queue is full, the newest frame is dropped, as by a kernel socket. The queued frames therefore stay
    in order without gaps, and only the receiving thread modifies the end of the queue. ``dropped`` counts the
    lost frames.

    Threads: only the reader may call :meth:`take` and :meth:`expect`. Only the receiving thread may call the
    other methods, except those marked "Any thread".

    Args:
        port: Port from which frames are received.
        capacity: Maximum number of waiting frames.

    Raises:
        ValueError: if ``capacity`` is below 1.
    """

    def __init__(self, port: CanPort, capacity: int = CAPACITY_FRAMES) -> None:
        if capacity < 1:
            raise ValueError(f"capacity: got {capacity}, must be at least 1")
        self.port = port
        self.seen_ns = 0
        """Monotonic time, ns; all frames that arrived earlier have been queued or dropped."""
        self.due_ns = 0
        """Monotonic time of the next :meth:`fetch`, ns. Used only by the receiver."""
        self._capacity = capacity
        self._queue: deque[list[Frame]] = deque()
        # _taken is written by the reader, _put and _dropped by the receiving thread
        self._put = self._taken = self._dropped = 0
        self._error: Exception | None = None
        self._expected: dict[str, tuple[int, ...]] = {}
        self._first_ns = 0  # earliest predicted arrival; 0 if a group has no prediction
        self._asked_ns = 0

    @property
    def dropped(self) -> int:
        """Number of frames lost because the queue was full.

        The port counts the frames dropped by the kernel.
        """
        return self._dropped

    @property
    def queued(self) -> int:
        """Number of frames waiting in the queue."""
        taken = self._taken  # _taken is read before _put, so that the difference is never negative
        return self._put - taken

    def take(self) -> list[Frame]:
        """Return all queued frames in order of arrival, without waiting.

        Raises:
            BusError: if the bus failed and all frames received before the failure have already been taken.
            Exception: any other exception raised by the receiving thread.
        """
        # read the error before the queue, which then contains all frames received before the error
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
        """Set the predicted arrival time of a group's last frame, so that the frame is fetched without delay.

        Args:
            what: Name of the group of frames. A new prediction replaces the group's previous prediction.
            times_ns: Possible monotonic arrival times in ascending order, ns; empty if the frame may arrive
                at any time.
        """
        self._expected[what] = times_ns
        self._first_ns = min([times[0] if times else 0 for times in self._expected.values()])

    def asked(self, t_ns: int) -> None:
        """Record that a request was sent at monotonic time ``t_ns``, so a response may arrive soon.

        Any thread may call this method.
        """
        self._asked_ns = t_ns

    # --- called by the receiver

    def gather(self, now_ns: int) -> None:
        """Set the time of the next fetch, :attr:`due_ns`, so that frames accumulate until then."""
        known = now_ns > self._asked_ns + _ANSWER_NS
        if now_ns < self._first_ns:  # fast path: this method runs after every batch from every bus
            awaited_ns = _before(self._first_ns, now_ns)
        else:
            awaited_ns, all_known = self._next_awaited(now_ns)
            known &= all_known
        self.due_ns = min(awaited_ns, _together(now_ns, LONG_NS if known else GATHER_NS))

    def _next_awaited(self, now_ns: int) -> tuple[int, bool]:
        """Return the fetch time (ns) of the next predicted frame, and whether all frames are predicted."""
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
        """Whether reception has failed and is stopped until :meth:`Receiver.resume` is called."""
        return self._error is not None

    def resume(self) -> None:
        """Clear the error of the failed port."""
        self._error = None

    def fetch(self, timeout_s: float) -> bool:
        """Move the frames that have arrived at the port into the queue.

        Args:
            timeout_s: Maximum wait for the first frame, s.

        Returns:
            Whether new frames or an error can be taken.
        """
        now_ns = clock.monotonic_ns()
        try:
            frames = self.port.recv_batch(timeout_s)
        except Exception as error:  # pass every exception to the reader thread
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
    """Intakes and poll object of the shared receiving thread."""

    intakes: dict[Intake, None]
    """Intakes in order of addition, without duplicates."""
    poll: select.poll


class Receiver:
    """Receiver that fills ``intakes`` with frames from their ports, from construction until :meth:`close`.

    Threads: all ports that read batches share one thread, which wakes once for several buses where possible.
    Each other port has its own thread, because receiving with python-can may block. If a port fails, only the
    reception from that port stops.

    Args:
        intakes: Queues to fill.
        on_defect: Function called with any exception raised outside the ports, on the thread that raised the
            exception. Reception continues.
    """

    def __init__(
        self, intakes: Sequence[Intake], on_defect: Callable[[Exception], object] = lambda error: None
    ) -> None:
        self._on_defect = on_defect
        self._news: queue.SimpleQueue[None] = clock.simple_queue()
        self._joining: deque[Intake] = deque()  # new intakes, which the shared thread adds to its poll object
        self._stop = clock.event()
        self._shared: threading.Thread | None = None
        self._alone: dict[Intake, threading.Thread] = {}
        if any(intake.port.reads_batches for intake in intakes):
            self._shared = clock.thread(target=self._receive_batches, name="receive")
            self._shared.start()
        for intake in intakes:
            self.resume(intake)

    def wait(self, timeout_s: float) -> None:
        """Wait up to ``timeout_s`` for frames or an error in any intake.

        Only one thread may call this method.
        """
        with contextlib.suppress(queue.Empty):
            self._news.get(timeout=timeout_s)

    def resume(self, intake: Intake) -> None:
        """Resume reception on a port that has failed and been reopened. Any thread may call this method."""
        if intake.port.reads_batches:
            intake.resume()
            self._joining.append(intake)
            return
        if intake in self._alone:
            # The port's thread ends because the error is set, so clear the error only after the thread's end.
            self._alone[intake].join()
        intake.resume()
        name = f"receive {intake.port.config.name}"
        thread = clock.thread(target=self._receive_alone, args=(intake,), name=name)
        thread.start()
        self._alone[intake] = thread  # only after start(): a thread must be started before it can be joined

    def close(self) -> None:
        """End and join the receiving threads. The ports stay open and are closed by their owner."""
        self._stop.set()
        for thread in self._alone.values():
            thread.join()
        if self._shared is not None:
            self._shared.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

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
        """Run one iteration of the shared receiving thread's loop."""
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
                # Fetch twice: this thread may have been suspended after the first fetch found no frames.
                if intake.fetch(_POLL_S) or intake.fetch(0.0):
                    self._notify()
            except Exception as error:
                self._on_defect(error)
                clock.sleep(_POLL_S)

    def _notify(self) -> None:
        if self._news.empty():  # one notification covers all intakes
            self._news.put(None)


def _fetch(intakes: Iterable[Intake]) -> bool:
    """Fetch frames from every port, and return whether any intake has new frames or an error."""
    return sum(intake.fetch(0.0) for intake in intakes) > 0  # any() would skip intakes after a success


def _together(now_ns: int, pause_ns: int) -> int:
    """Return the end of a pause that lasts 0.5 to 1.5 times ``pause_ns``.

    Pauses end at multiples of ``pause_ns``, so that all buses are read in one wake-up.
    """
    return (now_ns + pause_ns // 2) // pause_ns * pause_ns + pause_ns


def _before(t_ns: int, now_ns: int) -> int:
    """Return the fetch time for a frame that is predicted to arrive at ``t_ns``."""
    due_ns = t_ns + _LAG_NS
    if due_ns >= now_ns + _BEFORE_NS + GATHER_NS:
        due_ns -= _BEFORE_NS
    return max(now_ns + _SHORT_NS, due_ns)


def _poll_of(intakes: Iterable[Intake]) -> select.poll:
    poll = select.poll()
    for intake in intakes:
        with contextlib.suppress(ValueError):  # the port is closed; the next fetch reports the error
            poll.register(intake.port.fileno(), select.POLLIN)
    return poll


def drain(port: CanPort, within_s: float) -> list[Frame]:
    """Return all frames that arrive within ``within_s``; only for use without a receiving thread."""
    frames: list[Frame] = []
    end_ns = clock.monotonic_ns() + int(within_s * 1e9)
    while (left_ns := end_ns - clock.monotonic_ns()) > 0:
        frame = port.recv(left_ns * 1e-9)
        if frame is not None:
            frames.append(frame)
    return frames
