"""Optional methods of a python-can interface that exchange frames without python-can's messages."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from skinnode.transport.frame import Frame


@runtime_checkable
class FrameInterface(Protocol):
    """python-can interface with methods that :class:`~skinnode.transport.CanPort` uses in place of messages.

    Converting each frame to a ``can.Message`` and back takes longer than all other work of a simulated bus.
    """

    def send_frame(self, can_id: int, data: bytes, *, remote: bool, fd: bool) -> None:
        """Queue a frame with an 11-bit identifier; a CAN FD frame switches the bit rate.

        Raises:
            can.CanError: if the interface rejects the frame or is closed.
        """

    def read_frames(self, timeout_s: float, most: int) -> list[Frame]:
        """Return the frames that have arrived; if there are none, wait for the first frame.

        Args:
            timeout_s: Maximum wait for the first frame, s.
            most: Maximum number of frames.

        Raises:
            can.CanError: if the interface is closed.
        """
        ...
