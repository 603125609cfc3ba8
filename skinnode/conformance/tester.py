"""Sends and receives raw frames, and keeps a trace of them for the report.

Received frames stay in an inbox until a case asks for them. A PDO that arrives while a case waits for an SDO
response is therefore not lost. Every wait has a time limit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from skinnode.process import clock
from skinnode.transport import CanPort, Frame

ANSWER_S: Final = 1.0
"""Maximum wait for a response, in s.

Devices respond much faster. The limit is generous, so that a delay on the tester's machine does not cause a
failure.
"""

QUIET_S: Final = 0.06
"""Time to listen for a frame that must not be sent, in s."""

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
    """Time since the start of the case, in s."""
    sent: bool
    """Whether the tester sent the frame."""
    can_id: int
    data: bytes
    remote: bool

    def __str__(self) -> str:
        payload = "remote" if self.remote else self.data.hex(" ").upper()
        return f"{self.t_s:9.4f} {'Tx' if self.sent else 'Rx'} {self.can_id:03X} [{len(self.data)}] {payload}"


def describe(frame: Frame | None) -> str:
    """Return a frame as text for a failure message; None means that no frame arrived."""
    if frame is None:
        return "nothing"
    return f"0x{frame.can_id:03X} [{len(frame.data)}] {frame.data.hex(' ').upper()}".rstrip()


class Tester:
    """Sends and receives raw frames on a bus; must be used by one thread only."""

    def __init__(self, port: CanPort) -> None:
        self._port = port
        self.fd = port.config.fd
        """Whether PDOs may be sent in CAN FD frames of up to 64 bytes."""
        self._inbox: deque[Frame] = deque(maxlen=_INBOX_FRAMES)
        self._trace: deque[TraceLine] = deque(maxlen=_TRACE_FRAMES)
        self._begun_ns = clock.monotonic_ns()

    def begin(self) -> None:
        """Begin a case: discard all received frames and clear the trace."""
        self.clear()
        self._trace.clear()
        self._begun_ns = clock.monotonic_ns()

    @property
    def trace(self) -> tuple[TraceLine, ...]:
        """Most recent frames (at most 400) sent and received since :meth:`begin`."""
        return tuple(self._trace)

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False) -> int:
        """Send a frame; return the time of transmission (monotonic clock, ns)."""
        now_ns = clock.monotonic_ns()
        self._note(now_ns, True, can_id, data, remote)
        self._port.send(can_id, data, remote=remote)
        return now_ns

    def clear(self) -> None:
        """Discard all frames received so far, including those still queued in the interface."""
        self._fetch()
        self.forget()

    def forget(self) -> None:
        """Empty the inbox; frames that are still queued in the interface are kept."""
        self._inbox.clear()

    def take(
        self, can_id: int, within_s: float = ANSWER_S, match: Callable[[Frame], bool] | None = None
    ) -> Frame | None:
        """Return the oldest data frame with ``can_id`` in the inbox, or wait for the next one.

        Args:
            can_id: CAN-ID of the frame.
            within_s: Maximum wait, in s.
            match: Additional condition that the frame must meet.

        Returns:
            The frame; None if none arrives within ``within_s``.
        """

        def wanted(frame: Frame) -> bool:
            return frame.can_id == can_id and not frame.remote and (match is None or match(frame))

        for frame in self._inbox:
            if wanted(frame):
                self._inbox.remove(frame)
                return frame
        end_s = clock.monotonic() + within_s
        while (left_s := end_s - clock.monotonic()) > 0:
            received = self._receive(left_s)
            if received is not None and not self._ignored(received) and wanted(received):
                return self._inbox.pop()
        return None

    def expect(
        self,
        can_id: int,
        what: str,
        within_s: float = ANSWER_S,
        match: Callable[[Frame], bool] | None = None,
    ) -> Frame:
        """Return a frame, like :meth:`take`.

        Raises Failed if none arrives; ``what`` describes the frame in the message.
        """
        frame = self.take(can_id, within_s, match)
        if frame is None:
            raise Failed(f"{what} (0x{can_id:03X}) within {within_s:g} s", "nothing")
        return frame

    def listen(self, can_id: int, for_s: float) -> list[Frame]:
        """Return the data frames with ``can_id`` that arrive during the next ``for_s`` seconds."""
        self.pending(can_id)
        self.wait(for_s)
        return self.pending(can_id)

    def wait(self, for_s: float) -> None:
        """Receive frames into the inbox for ``for_s`` seconds."""
        end_s = clock.monotonic() + for_s
        while (left_s := end_s - clock.monotonic()) > 0:
            self._receive(left_s)

    def pending(self, can_id: int) -> list[Frame]:
        """Return the data frames with ``can_id`` received so far, and remove them from the inbox."""
        self._fetch()
        found = [frame for frame in self._inbox if frame.can_id == can_id and not frame.remote]
        for frame in found:
            self._inbox.remove(frame)
        return found

    def expect_silence(self, can_id: int, what: str, for_s: float = QUIET_S) -> None:
        """Raise Failed if a data frame with ``can_id`` is in the inbox or arrives within ``for_s``."""
        frame = self.take(can_id, for_s)
        if frame is not None:
            raise Failed(f"no {what}", describe(frame))

    def _fetch(self) -> None:
        # On a fully loaded bus, frames never stop arriving.
        for _ in range(_INBOX_FRAMES):
            if self._receive(0.0) is None:
                return

    def _receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None if none arrives. Unless it is ignored, it is put into the inbox."""
        frame = self._port.recv(timeout_s)
        if frame is not None and not self._ignored(frame):
            self._note(frame.t_ns, False, frame.can_id, frame.data, frame.remote)
            self._inbox.append(frame)
        return frame

    def _ignored(self, frame: Frame) -> bool:
        return frame.error or frame.extended or (frame.fd and not self.fd)

    def _note(self, t_ns: int, sent: bool, can_id: int, data: bytes, remote: bool) -> None:
        self._trace.append(TraceLine((t_ns - self._begun_ns) * 1e-9, sent, can_id, data, remote))
