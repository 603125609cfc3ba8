"""The receive context: threads that copy frames into bounded queues, count what does not fit, and nothing
else. Whoever owns the receiver takes whole batches from the other end."""

from __future__ import annotations

import contextlib
import queue
import select
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Final, Self

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

CAPACITY_FRAMES: Final = 16384
"""Two seconds of a full bus at 1 Mbit/s (8,000 frames/s): longer than any pause a host survives otherwise."""

_POLL_S: Final = 0.02
"""How long a thread waits for a frame before it says that there is none, and sees whether it should end."""


GATHER_S: Final = 1.5e-3
"""Pause after a batch, as a network card moderates its interrupts: a thread that woke for each of 8,000
frames a second would spend more on waking than on frames. The first frame after a silence does not wait for
it, and each has the time of its arrival."""

LONG_S: Final = 3e-3
"""The same while it is known when the next thing that somebody waits for should come. At 6 ms a frame costs
less again, but one scan in a hundred waits for it: the end of one on a classic bus is not known that well."""

_BEFORE_S: Final = 0.8e-3
"""What has gathered is fetched once more that long before something is expected, so that little is left to do
when it is there."""
_SHORT_S: Final = 0.2e-3
"""Least pause, when something is expected."""
_LATE_S: Final = 3e-3
"""For how long something overdue is still waited for with short pauses."""
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
        self._capacity = capacity
        self._queue: deque[list[Frame]] = deque()
        self._put = self._taken = self._dropped = 0  # _taken is the reader's, the others the receiver's
        self._error: Exception | None = None
        self._expected: dict[str, int] = {}
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

    def expect(self, what: str, t_ns: int) -> None:
        """The last frame of ``what`` should come at ``t_ns``, monotonic, and is not to wait for others then.
        Holds until the same is expected at another time."""
        self._expected[what] = t_ns

    def asked(self, t_ns: int) -> None:
        """Something was sent at ``t_ns``, monotonic, that may be answered. From any thread."""
        self._asked_ns = t_ns

    # --- the receiver's

    def pause_s(self, now_ns: int) -> float:
        """How long to let frames gather."""
        expected = tuple(self._expected.values())
        known = max(expected, default=0) > now_ns > self._asked_ns + _ANSWER_NS
        if any(now_ns - _GIVEN_UP_NS < t_ns < now_ns for t_ns in expected):
            known = False  # what is late may come at any time
        pause_s = LONG_S if known else GATHER_S
        for t_ns in expected:
            ahead_s = (t_ns + _LAG_NS - now_ns) * 1e-9
            if ahead_s >= _BEFORE_S + GATHER_S:
                ahead_s -= _BEFORE_S
            if -_LATE_S < ahead_s < pause_s:
                pause_s = max(_SHORT_S, ahead_s)
        return pause_s

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


class Receiver:
    """Receives on the ports of ``intakes`` from construction until :meth:`close`.

    Ports that read batches share one thread: for as many buses it wakes as often as for one. Any other may
    block in python-can, and has a thread of its own. What goes wrong on a port ends its receiving alone.
    """

    def __init__(self, intakes: Sequence[Intake]) -> None:
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
        intake.resume()
        if intake.port.reads_batches:
            self._joining.append(intake)
            return
        if intake in self._alone:
            self._alone[intake].join()  # it ended with the failure
        name = f"receive {intake.port.config.name}"
        thread = threading.Thread(target=self._receive_alone, args=(intake,), name=name, daemon=True)
        self._alone[intake] = thread
        thread.start()

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
        intakes: dict[Intake, None] = {}  # in order, each once
        poll = select.poll()
        while not self._stop.is_set():
            if self._joining:
                while self._joining:
                    intakes[self._joining.popleft()] = None
                poll = _poll_of(intakes)
            if not sum(intake.fetch(0.0) for intake in intakes):
                poll.poll(_POLL_S * 1e3)
                continue
            if any(intake.failed for intake in intakes):
                intakes = {intake: None for intake in intakes if not intake.failed}
                poll = _poll_of(intakes)
            self._tell()
            now_ns = time.monotonic_ns()
            time.sleep(min([intake.pause_s(now_ns) for intake in intakes], default=GATHER_S))

    def _receive_alone(self, intake: Intake) -> None:
        while not (self._stop.is_set() or intake.failed):
            # Asked twice: this thread may have been away since it was told that there is none.
            if intake.fetch(_POLL_S) or intake.fetch(0.0):
                self._tell()

    def _tell(self) -> None:
        if self._news.empty():  # once is enough
            self._news.put(None)


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
