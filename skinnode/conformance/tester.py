"""Raw frames on a bus: send, await with a deadline, and keep what went to and fro.

Frames that were received but not asked for yet wait in an inbox, in order of arrival, so that a PDO that
comes before the SDO answer is not lost. Every wait is bounded.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from skinnode.transport import CanPort, Frame

ANSWER_S: Final = 1.0
"""How long an answer may take: far more than a device takes, so that a busy machine fails no case."""

QUIET_S: Final = 0.06
"""How long nothing must come before nothing is taken to come."""

_INBOX_FRAMES: Final = 20_000
_TRACE_FRAMES: Final = 400


class Failed(Exception):
    """The device did not do what the standard asks for."""

    def __init__(self, expected: str, got: str) -> None:
        self.expected, self.got = expected, got
        super().__init__(f"expected {expected}; got {got}")


class TraceLine(NamedTuple):
    """A frame of a case, in the order in which it was sent or received."""

    t_s: float
    """Since the case began."""
    sent: bool
    """By this program."""
    can_id: int
    data: bytes
    remote: bool

    def __str__(self) -> str:
        payload = "remote" if self.remote else self.data.hex(" ").upper()
        return f"{self.t_s:9.4f} {'Tx' if self.sent else 'Rx'} {self.can_id:03X} [{len(self.data)}] {payload}"


def describe(frame: Frame | None) -> str:
    """A frame, or the lack of one, in the words of a failure."""
    if frame is None:
        return "nothing"
    return f"0x{frame.can_id:03X} [{len(frame.data)}] {frame.data.hex(' ').upper()}".rstrip()


class Tester:
    """One side of a bus. Used by one thread."""

    def __init__(self, port: CanPort) -> None:
        self._port = port
        self.fd = port.config.fd
        """Whether PDOs may be CAN FD frames of up to 64 bytes."""
        self._inbox: deque[Frame] = deque(maxlen=_INBOX_FRAMES)
        self._trace: deque[TraceLine] = deque(maxlen=_TRACE_FRAMES)
        self._begun_ns = time.monotonic_ns()

    def begin(self) -> None:
        """A case begins: what came before is forgotten."""
        self.clear()
        self._trace.clear()
        self._begun_ns = time.monotonic_ns()

    @property
    def trace(self) -> tuple[TraceLine, ...]:
        """The last frames since :meth:`begin`."""
        return tuple(self._trace)

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False) -> int:
        """Send a frame; returns the time, ns of the monotonic clock."""
        now_ns = time.monotonic_ns()
        self._note(now_ns, True, can_id, data, remote)
        self._port.send(can_id, data, remote=remote)
        return now_ns

    def clear(self) -> None:
        """Forget what has come so far."""
        self._fetch()
        self.forget()

    def forget(self) -> None:
        """Empty the inbox; what still waits at the interface comes in later."""
        self._inbox.clear()

    def take(
        self, can_id: int, within_s: float = ANSWER_S, match: Callable[[Frame], bool] | None = None
    ) -> Frame | None:
        """The first frame of ``can_id`` that matches, out of the inbox or to come; None after
        ``within_s``.
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
        """As :meth:`take`; raises Failed, naming ``what`` was awaited, where nothing comes."""
        frame = self.take(can_id, within_s, match)
        if frame is None:
            raise Failed(f"{what} (0x{can_id:03X}) within {within_s:g} s", "nothing")
        return frame

    def listen(self, can_id: int, for_s: float) -> list[Frame]:
        """All frames of ``can_id`` that come from now on for ``for_s``."""
        self.pending(can_id)
        self.wait(for_s)
        return self.pending(can_id)

    def wait(self, for_s: float) -> None:
        """Let time pass; what comes waits in the inbox."""
        end_s = time.monotonic() + for_s
        while (left_s := end_s - time.monotonic()) > 0:
            self._receive(left_s)

    def pending(self, can_id: int) -> list[Frame]:
        """Frames of ``can_id`` that have come so far; they leave the inbox."""
        self._fetch()
        found = [frame for frame in self._inbox if frame.can_id == can_id and not frame.remote]
        for frame in found:
            self._inbox.remove(frame)
        return found

    def expect_silence(self, can_id: int, what: str, for_s: float = QUIET_S) -> None:
        """Raises Failed where a frame of ``can_id`` has come or comes within ``for_s``."""
        frame = self.take(can_id, for_s)
        if frame is not None:
            raise Failed(f"no {what}", describe(frame))

    def _fetch(self) -> None:
        for _ in range(_INBOX_FRAMES):  # a bus may be so full that it never falls silent
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
