"""Sends and receives raw frames on a bus, and keeps a trace of them.

Received frames are kept in an inbox, in order of arrival, until a case requests them. A PDO that arrives
before an expected SDO response is therefore not lost. Every wait is bounded.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from skinnode.transport import CanPort, Frame

ANSWER_S: Final = 1.0
"""Maximum wait for a response, s.

Devices respond much faster; the limit is generous so that a busy machine does not cause failures.
"""

QUIET_S: Final = 0.06
"""Time without frames after which the bus is considered silent, s."""

_INBOX_FRAMES: Final = 20_000
_TRACE_FRAMES: Final = 400


class Failed(Exception):
    """Raised if the device violates the standard."""

    def __init__(self, expected: str, got: str) -> None:
        self.expected, self.got = expected, got
        super().__init__(f"expected {expected}; got {got}")


class TraceLine(NamedTuple):
    """Frame sent or received during a case."""

    t_s: float
    """Time since the case began."""
    sent: bool
    """Whether the tester sent the frame."""
    can_id: int
    data: bytes
    remote: bool

    def __str__(self) -> str:
        payload = "remote" if self.remote else self.data.hex(" ").upper()
        return f"{self.t_s:9.4f} {'Tx' if self.sent else 'Rx'} {self.can_id:03X} [{len(self.data)}] {payload}"


def describe(frame: Frame | None) -> str:
    """Describe a frame, or its absence, for a failure message."""
    if frame is None:
        return "nothing"
    return f"0x{frame.can_id:03X} [{len(frame.data)}] {frame.data.hex(' ').upper()}".rstrip()


class Tester:
    """Sender and receiver of raw frames, for use by a single thread."""

    def __init__(self, port: CanPort) -> None:
        self._port = port
        self.fd = port.config.fd
        """Whether PDOs may be sent in CAN FD frames of up to 64 bytes."""
        self._inbox: deque[Frame] = deque(maxlen=_INBOX_FRAMES)
        self._trace: deque[TraceLine] = deque(maxlen=_TRACE_FRAMES)
        self._begun_ns = time.monotonic_ns()

    def begin(self) -> None:
        """Start a case: discard all frames received so far and clear the trace."""
        self.clear()
        self._trace.clear()
        self._begun_ns = time.monotonic_ns()

    @property
    def trace(self) -> tuple[TraceLine, ...]:
        """Newest frames sent or received since the last :meth:`begin`."""
        return tuple(self._trace)

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False) -> int:
        """Send a frame and return the timestamp (ns, monotonic clock) of its transmission."""
        now_ns = time.monotonic_ns()
        self._note(now_ns, True, can_id, data, remote)
        self._port.send(can_id, data, remote=remote)
        return now_ns

    def clear(self) -> None:
        """Discard all frames received so far, including those still queued at the interface."""
        self._fetch()
        self.forget()

    def forget(self) -> None:
        """Empty the inbox without discarding frames that are still queued at the interface."""
        self._inbox.clear()

    def take(
        self, can_id: int, within_s: float = ANSWER_S, match: Callable[[Frame], bool] | None = None
    ) -> Frame | None:
        """Return the first matching frame with ``can_id`` from the inbox, or else from the bus.

        Args:
            can_id: CAN-ID of a data frame.
            within_s: Maximum wait.
            match: Additional condition on the frame.

        Returns:
            The frame; None if no matching frame arrives within ``within_s``.
        """

        def wanted(frame: Frame) -> bool:
            return frame.can_id == can_id and not frame.remote and (match is None or match(frame))

        for frame in self._inbox:
            if wanted(frame):
                self._inbox.remove(frame)
                return frame
        end_s = time.monotonic() + within_s
        while (left_s := end_s - time.monotonic()) > 0:
            if self._receive(left_s) and wanted(self._inbox[-1]):
                return self._inbox.pop()
        return None

    def expect(
        self,
        can_id: int,
        what: str,
        within_s: float = ANSWER_S,
        match: Callable[[Frame], bool] | None = None,
    ) -> Frame:
        """Return a frame as :meth:`take` does.

        Raises Failed if no frame arrives; the message then describes the frame as ``what``.
        """
        frame = self.take(can_id, within_s, match)
        if frame is None:
            raise Failed(f"{what} (0x{can_id:03X}) within {within_s:g} s", "nothing")
        return frame

    def listen(self, can_id: int, for_s: float) -> list[Frame]:
        """Return all frames with ``can_id`` that arrive within the next ``for_s`` seconds."""
        self.pending(can_id)
        self.wait(for_s)
        return self.pending(can_id)

    def wait(self, for_s: float) -> None:
        """Wait ``for_s`` seconds and store the frames that arrive in the inbox."""
        end_s = time.monotonic() + for_s
        while (left_s := end_s - time.monotonic()) > 0:
            self._receive(left_s)

    def pending(self, can_id: int) -> list[Frame]:
        """Remove the frames with ``can_id`` received so far from the inbox and return them."""
        self._fetch()
        found = [frame for frame in self._inbox if frame.can_id == can_id and not frame.remote]
        for frame in found:
            self._inbox.remove(frame)
        return found

    def expect_silence(self, can_id: int, what: str, for_s: float = QUIET_S) -> None:
        """Raise Failed if a frame with ``can_id`` is in the inbox or arrives within ``for_s`` seconds."""
        frame = self.take(can_id, for_s)
        if frame is not None:
            raise Failed(f"no {what}", describe(frame))

    def _fetch(self) -> None:
        # The loop is bounded, because frames may arrive continuously on a fully loaded bus.
        for _ in range(_INBOX_FRAMES):
            if not self._receive(0.0):
                return

    def _receive(self, timeout_s: float) -> bool:
        frame = self._port.recv(timeout_s)
        if frame is None or frame.error or frame.extended or (frame.fd and not self.fd):
            return False
        self._note(frame.t_ns, False, frame.can_id, frame.data, frame.remote)
        self._inbox.append(frame)
        return True

    def _note(self, t_ns: int, sent: bool, can_id: int, data: bytes, remote: bool) -> None:
        self._trace.append(TraceLine((t_ns - self._begun_ns) * 1e-9, sent, can_id, data, remote))
