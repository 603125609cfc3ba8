"""Interface methods that exchange frames directly instead of as ``can.Message``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from skinnode.transport.frame import Frame


@runtime_checkable
class FrameInterface(Protocol):
    """Interface with direct frame methods, which :class:`~skinnode.transport.CanPort` uses if present.

    On a simulated bus, converting frames to ``can.Message`` and back would take longer than all other work.
    A python-can interface may provide these methods; for udp_multicast,
    :class:`~skinnode.transport.multicast.MulticastSocket` does.
    """

    def send_frame(self, can_id: int, data: bytes, *, remote: bool, fd: bool) -> None:
        """Queue a frame with an 11-bit identifier. CAN FD frames use bit rate switching.

        Raises:
            can.CanError or OSError: if the interface rejects the frame or is closed.
        """

    def read_frames(self, timeout_s: float, most: int) -> list[Frame]:
        """Return the frames that have arrived; if there are none, wait for the next frame.

        Args:
            timeout_s: Maximum time to wait for a frame, in s.
            most: Maximum number of frames.

        Raises:
            can.CanError, OSError or ValueError: if the interface is closed.
        """
        ...


@runtime_checkable
class SignallingInterface(FrameInterface, Protocol):
    """Interface that announces frames by calling a function, so that no thread has to wait for them.

    On a simulated bus in virtual time, waking a thread for each batch of frames would take longer than
    receiving them.
    """

    def call_on_arrival(self, function: Callable[[], object]) -> None:
        """Call ``function``, which must not block, whenever frames have arrived.

        A frame that arrives before the time given to :meth:`hold_until` is announced at that time.
        """

    def hold_until(self, t_ns: int) -> None:
        """Defer announcements until monotonic time ``t_ns``, so that frames are fetched together."""
        ...
