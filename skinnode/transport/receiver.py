"""The receive context: a thread that copies frames into a bounded queue, counts what does not fit, and
nothing else. Whoever owns the receiver reads whole batches from the other end."""

from __future__ import annotations

import queue
import threading
import time
from types import TracebackType
from typing import Final, Self

from skinnode.errors import BusError
from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

CAPACITY_FRAMES: Final = 16384
"""Two seconds of a full bus at 1 Mbit/s (8,000 frames/s): longer than any pause a host survives otherwise."""

_POLL_S: Final = 0.02
"""How long the thread waits for a frame before it says that there is none, and sees whether it should end."""


GATHER_S: Final = 1e-3
"""Pause after a batch, as a network card moderates its interrupts: a thread that woke for each of 8,000
frames a second would spend more on waking than on frames. The first frame after a silence does not wait for
it, and each has the time of its arrival."""


class Receiver:
    """Frames of ``port``, received on a thread of its own from construction until :meth:`close`.

    When the queue is full the newest frame is dropped, as a kernel socket does: what has been queued stays
    complete and in order, and only the thread that fills the queue ever touches its end. ``dropped`` counts.

    An error of the bus ends the thread and is raised to the reader, after the frames that came before it.
    """

    def __init__(self, port: CanPort, capacity: int = CAPACITY_FRAMES) -> None:
        if capacity < 1:
            raise ValueError(f"capacity: got {capacity}, must be at least 1")
        self._port = port
        self._capacity = capacity
        self._queue: queue.SimpleQueue[list[Frame] | None] = queue.SimpleQueue()  # None: the bus failed
        self._left: list[Frame] = []  # of a batch that was longer than asked for
        self._put = self._taken = self._dropped = 0  # _taken is the reader's, the others the thread's
        self.seen_ns = 0
        """Whatever came before is queued, or was dropped; monotonic."""
        self._error: BusError | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"receive {port.config.name}", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames that found the queue full. What the kernel dropped is counted by the port."""
        return self._dropped

    @property
    def queued(self) -> int:
        """Frames waiting to be read."""
        taken = self._taken  # first: there are never fewer put than taken
        return self._put - taken

    def get_batch(self, timeout_s: float, max_frames: int = 1024) -> list[Frame]:
        """All frames waiting, at most ``max_frames``, in order of arrival; waits up to ``timeout_s`` for the
        first and returns an empty list if there is none. Raises BusError once the bus has failed."""
        frames, self._left = self._left, []
        try:
            while len(frames) < max_frames:
                wait_s = 0.0 if frames else timeout_s
                batch = self._queue.get(timeout=wait_s) if wait_s > 0.0 else self._queue.get_nowait()
                if batch is None:
                    self._queue.put(None)  # whoever asks next hears of the failure too
                    break
                frames = frames + batch if frames else batch
        except queue.Empty:
            pass
        else:
            if not frames:
                assert self._error is not None  # set before the mark was queued
                raise self._error
        frames, self._left = frames[:max_frames], frames[max_frames:]
        self._taken += len(frames)
        return frames

    def close(self) -> None:
        """End and join the thread. The port stays open: it belongs to whoever opened it."""
        self._stop.set()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        receive, put = self._port.recv_batch, self._queue.put
        stopped, pause_s = self._stop.is_set, GATHER_S if self._port.reads_batches else 0.0
        try:
            while not stopped():
                frames = receive(_POLL_S)
                if not frames:
                    now_ns = time.monotonic_ns()
                    frames = receive(
                        0.0
                    )  # this thread may have been away since it was told that there is none
                    if not frames:
                        self.seen_ns = now_ns
                        continue
                room = self._capacity - self.queued
                if len(frames) > room:
                    self._dropped += len(frames) - room
                    frames = frames[:room]
                self._put += len(frames)
                put(frames)
                if frames:
                    self.seen_ns = frames[-1].t_ns
                if pause_s:
                    time.sleep(pause_s)
        except BusError as error:
            self._error = error
            put(None)


def drain(port: CanPort, within_s: float) -> list[Frame]:
    """Every frame that arrives within ``within_s``. For tools and tests that need no thread."""
    frames: list[Frame] = []
    end_ns = time.monotonic_ns() + int(within_s * 1e9)
    while (left_ns := end_ns - time.monotonic_ns()) > 0:
        frame = port.recv(left_ns * 1e-9)
        if frame is not None:
            frames.append(frame)
    return frames
