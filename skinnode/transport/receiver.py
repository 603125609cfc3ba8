"""The receive context: threads that copy frames into bounded queues, count what does not fit, and nothing
else. Whoever owns the receiver takes whole batches from the other end."""

from __future__ import annotations

import contextlib
import queue
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

CAPACITY_FRAMES: Final = 16384
"""Two seconds of a full bus at 1 Mbit/s (8,000 frames/s): longer than any pause a host survives otherwise."""

_POLL_S: Final = 0.02
"""How long a thread waits for a frame before it says that there is none, and sees whether it should end."""


GATHER_NS: Final = 1_500_000
"""Pause after a batch, as a network card moderates its interrupts: a thread that woke for each of 8,000
frames a second would spend more on waking than on frames. The first frame after a silence does not wait for
it, and each has the time of its arrival."""

LONG_NS: Final = 5_000_000
"""The same while it is known when everything that somebody waits for should come. What comes unforeseen all
the same may wait for it, and half as long again."""

_BEFORE_NS: Final = 800_000
"""What has gathered is fetched once more that long before something is expected, so that little is left to do
when it is there."""
_SHORT_NS: Final = 300_000
"""Least pause, when something is expected or overdue."""
_LATE_NS: Final = 600_000
"""For how long something overdue is waited for with such pauses."""
_GIVEN_UP_NS: Final = 200_000_000
"""What is later than that does not come any more."""
_ANSWER_NS: Final = 20_000_000
"""For how long after a question an answer may come at any time."""
_LAG_NS: Final = 50_000
"""A frame is there to be read that long after the time of its arrival."""


class Intake:
    """Frames of ``port`` on their way from the thread that receives them to the one that takes them.

    When the queue is full the newest frame is dropped, as a kernel socket does: what has been queued stays
    complete and in order, and only the thread that fills the queue ever touches its end. ``dropped`` counts.
    """

    def __init__(self, port: CanPort, capacity: int = CAPACITY_FRAMES) -> None:
        if capacity < 1:
            raise ValueError(f"capacity: got {capacity}, must be at least 1")
        self.port = port
        self.seen_ns = 0
        """Whatever came before is queued, or was dropped; monotonic."""
        self.due_ns = 0
        """When to :meth:`fetch` again. The receiver's."""
        self._capacity = capacity
        self._queue: deque[list[Frame]] = deque()
        self._put = self._taken = self._dropped = 0  # _taken is the reader's, the others the receiver's
        self._error: Exception | None = None
        self._expected: dict[str, tuple[int, ...]] = {}
        self._first_ns = 0  # the earliest of them all; 0 while one of them may come at any time
        self._asked_ns = 0

    @property
    def dropped(self) -> int:
        """Frames that found the queue full. What the kernel dropped is counted by the port."""
        return self._dropped

    @property
    def queued(self) -> int:
        """Frames waiting to be taken."""
        taken = self._taken  # first: there are never fewer put than taken
        return self._put - taken

    def take(self) -> list[Frame]:
        """All frames waiting, in order of arrival; never waits. Raises BusError once the bus has failed,
        after the frames that came before; and whatever else went wrong in receiving."""
        error, batches = self._error, self._queue  # the error first: what is queued came before it
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
        """The last frame of ``what`` should come at one of ``times_ns``, monotonic and ascending, and is not
        to wait for others then; empty: at any time. Holds until the same is expected anew."""
        self._expected[what] = times_ns
        self._first_ns = min([times[0] if times else 0 for times in self._expected.values()])

    def asked(self, t_ns: int) -> None:
        """Something was sent at ``t_ns``, monotonic, that may be answered. From any thread."""
        self._asked_ns = t_ns

    # --- the receiver's

    def gather(self, now_ns: int) -> None:
        """After a batch: set :attr:`due_ns`, so that frames gather until then."""
        known = now_ns > self._asked_ns + _ANSWER_NS
        if now_ns < self._first_ns:  # mostly so, and asked after every batch of every bus
            awaited_ns = _before(self._first_ns, now_ns)
        else:
            awaited_ns, all_known = self._next_awaited(now_ns)
            known &= all_known
        self.due_ns = min(awaited_ns, _together(now_ns, LONG_NS if known else GATHER_NS))

    def _next_awaited(self, now_ns: int) -> tuple[int, bool]:
        """When to fetch for the sake of what is expected, and whether that is all that may come. What is late
        may come at any time."""
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
        """Whether nothing more is received until :meth:`Receiver.resume`."""
        return self._error is not None

    def resume(self) -> None:
        """Forget the error."""
        self._error = None

    def fetch(self, timeout_s: float) -> bool:
        """Queue what has come, waiting up to ``timeout_s`` for it; whether there is anything new to take."""
        now_ns = time.monotonic_ns()
        try:
            frames = self.port.recv_batch(timeout_s)
        except Exception as error:  # a defect, too, must reach the reader and not die with the thread
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
    """Intakes and poller of the shared thread."""

    intakes: dict[Intake, None]
    """Intakes in order, each once."""
    poll: select.poll


class Receiver:
    """Receives on the ports of ``intakes`` from construction until :meth:`close`.

    Ports that read batches share one thread, which wakes for several buses at once where it can. Any other
    may block in python-can, and has a thread of its own. A failure of a port stops only its own reception.
    Any other exception is passed to ``on_defect``, on the thread that raised it, and reception continues.
    """

    def __init__(
        self, intakes: Sequence[Intake], on_defect: Callable[[Exception], object] = lambda error: None
    ) -> None:
        self._on_defect = on_defect
        self._news: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._joining: deque[Intake] = deque()  # to those of the shared thread
        self._stop = threading.Event()
        self._shared: threading.Thread | None = None
        self._alone: dict[Intake, threading.Thread] = {}
        if any(intake.port.reads_batches for intake in intakes):
            self._shared = threading.Thread(target=self._receive_batches, name="receive", daemon=True)
            self._shared.start()
        for intake in intakes:
            self.resume(intake)

    def wait(self, timeout_s: float) -> None:
        """Wait up to ``timeout_s`` until there is something to take. One thread may."""
        with contextlib.suppress(queue.Empty):
            self._news.get(timeout=timeout_s)

    def resume(self, intake: Intake) -> None:
        """Receive again on a port that failed and was opened again. From any thread."""
        if intake.port.reads_batches:
            intake.resume()
            self._joining.append(intake)
            return
        if intake in self._alone:
            self._alone[intake].join()  # it ends after the failure, which must not be forgotten before
        intake.resume()
        name = f"receive {intake.port.config.name}"
        thread = threading.Thread(target=self._receive_alone, args=(intake,), name=name, daemon=True)
        thread.start()
        self._alone[intake] = thread  # set after start(): a thread that did not start cannot be joined

    def close(self) -> None:
        """End and join the threads. The ports stay open: they belong to whoever opened them."""
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
                time.sleep(_POLL_S)

    def _receive_batch(self, shared: _Shared) -> None:
        """Run one turn of the shared thread."""
        intakes = shared.intakes
        if self._joining:
            while self._joining:
                intakes[self._joining[0]] = None
                self._joining.popleft()
            shared.poll = _poll_of(intakes)
        now_ns = time.monotonic_ns()
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
        self._tell()
        now_ns = time.monotonic_ns()
        for intake in fetched:
            intake.gather(now_ns)
        due_ns = min([intake.due_ns for intake in intakes], default=now_ns + GATHER_NS)
        time.sleep(max(0, due_ns - now_ns) * 1e-9)

    def _receive_alone(self, intake: Intake) -> None:
        while True:
            try:
                if self._stop.is_set() or intake.failed:
                    return
                # Polled twice: this thread may have been suspended since the first poll found nothing.
                if intake.fetch(_POLL_S) or intake.fetch(0.0):
                    self._tell()
            except Exception as error:
                self._on_defect(error)
                time.sleep(_POLL_S)

    def _tell(self) -> None:
        if self._news.empty():  # once is enough
            self._news.put(None)


def _fetch(intakes: Iterable[Intake]) -> bool:
    """Whether there is anything new to take from any of them."""
    return sum(intake.fetch(0.0) for intake in intakes) > 0  # of each, whatever another has


def _together(now_ns: int, pause_ns: int) -> int:
    """The end of a pause of about ``pause_ns``, from half of it to one and a half: the same instant for all
    buses, so that one waking does for all."""
    return (now_ns + pause_ns // 2) // pause_ns * pause_ns + pause_ns


def _before(t_ns: int, now_ns: int) -> int:
    """When to fetch for the sake of what is expected at ``t_ns``."""
    due_ns = t_ns + _LAG_NS
    if due_ns >= now_ns + _BEFORE_NS + GATHER_NS:
        due_ns -= _BEFORE_NS
    return max(now_ns + _SHORT_NS, due_ns)


def _poll_of(intakes: Iterable[Intake]) -> select.poll:
    poll = select.poll()
    for intake in intakes:
        with contextlib.suppress(ValueError):  # it was closed: the next fetch says so
            poll.register(intake.port.fileno(), select.POLLIN)
    return poll


def drain(port: CanPort, within_s: float) -> list[Frame]:
    """Every frame that arrives within ``within_s``. For tools and tests that need no thread."""
    frames: list[Frame] = []
    end_ns = time.monotonic_ns() + int(within_s * 1e9)
    while (left_ns := end_ns - time.monotonic_ns()) > 0:
        frame = port.recv(left_ns * 1e-9)
        if frame is not None:
            frames.append(frame)
    return frames
