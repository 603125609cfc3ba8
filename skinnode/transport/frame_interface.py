"""Methods with which an interface exchanges frames directly, not as ``can.Message``."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from skinnode.transport.frame import Frame


@runtime_checkable
class FrameInterface(Protocol):
    """Interface with methods for frames, which :class:`~skinnode.transport.CanPort` then uses.

    On a simulated bus, converting frames to ``can.Message`` and back would take longer than everything else.
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
            timeout_s: Maximum time to wait for a frame, s.
            most: Maximum number of frames.

        Raises:
            can.CanError, OSError or ValueError: if the interface is closed.
        """
        ...
