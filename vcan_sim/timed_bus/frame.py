"""CAN frames, as a station passes them to its controller."""

from __future__ import annotations

from typing import Final, NamedTuple, Self

from skinnode.bus_load.stuffing import classic_frame_bits
from skinnode.bus_load.timing import exact_bits, exact_fd_bits
from skinnode.canopen.data_length import FD_LENGTHS
from skinnode.text.words import counted

_VALID_FD_LENGTHS: Final = frozenset(FD_LENGTHS)


class _Fields(NamedTuple):
    can_id: int
    data: bytes
    extended: bool
    remote: bool
    dlc: int
    fd: bool
    brs: bool


class CanFrame(_Fields):
    """Classic CAN or CAN FD data frame, or classic CAN remote frame.

    The error state indicator (ESI) of a CAN FD frame is not included, because the controller sets it:
    dominant in an error-active station, recessive in an error-passive station.

    Args:
        can_id: Identifier with 11 bits, or with 29 bits if ``extended``.
        data: Data: 0 to 8 bytes, or 12, 16, 20, 24, 32, 48 or 64 bytes in CAN FD; empty in a remote frame.
        extended: Whether the identifier has 29 bits.
        remote: Whether the frame is a remote frame.
        dlc: Data length code (DLC) of a remote frame, 0 to 8; ignored for data frames.
        fd: Whether the frame is a CAN FD frame.
        brs: Whether a CAN FD frame switches to the data bit rate.

    Raises:
        ValueError: If the identifier, the length or the combination of flags is not valid.
    """

    __slots__ = ()

    def __new__(  # noqa: PLR0913 - the fields of a frame
        cls,
        can_id: int,
        data: bytes = b"",
        extended: bool = False,
        remote: bool = False,
        dlc: int = 0,
        fd: bool = False,
        brs: bool = False,
    ) -> Self:
        """Check the fields of a new frame."""
        frame = tuple.__new__(cls, (can_id, data, extended, remote, dlc, fd, brs))
        if extended or remote or fd or brs or dlc or not 0 <= can_id < 0x800 or len(data) > 8:
            frame._check()
        return frame

    def _check(self) -> None:
        width = 29 if self.extended else 11
        if not 0 <= self.can_id < 1 << width:
            raise ValueError(f"can_id: got 0x{self.can_id:X}, must fit {width} bits")
        length = len(self.data)
        if self.fd:
            if self.remote:
                raise ValueError("remote: got a remote CAN FD frame, must be a classic frame")
            if length not in _VALID_FD_LENGTHS:
                raise ValueError(f"data: got {counted(length, 'byte')}, must be one of {FD_LENGTHS}")
            return
        if self.brs:
            raise ValueError("brs: got a classic frame that switches the bit rate, must be a CAN FD frame")
        if length > 8:
            raise ValueError(f"data: got {counted(length, 'byte')}, must be at most 8")
        if self.remote and length:
            raise ValueError(f"data: got {counted(length, 'byte')} in a remote frame, must be none")
        if not 0 <= self.dlc <= 8:
            raise ValueError(f"dlc: got {self.dlc}, must be 0 to 8")


def arbitration_key(frame: CanFrame) -> int:
    """Return the arbitration field as a number. The frame with the lowest number wins arbitration.

    The bits are in transmission order: base identifier, RTR or SRR, IDE, identifier extension, RTR
    (ISO 11898-1:2015). Dominant bits are 0. A base frame has zeros in place of the extension, because an
    extended frame with the same base identifier has already lost at SRR or IDE.

    Args:
        frame: Frame to send.

    Returns:
        32-bit number.
    """
    if frame.extended:
        base, extension = frame.can_id >> 18, frame.can_id & 0x3FFFF
        return base << 21 | 0b11 << 19 | extension << 1 | frame.remote
    return frame.can_id << 21 | frame.remote << 20


def frame_bits(frame: CanFrame, esi: bool = False) -> tuple[int, int]:
    """Return the exact number of bits from the start of frame to the end of the intermission.

    Args:
        frame: Frame to measure.
        esi: Whether the error state indicator of a CAN FD frame is recessive.

    Returns:
        Number of bits at the nominal bit rate, and number of bits at the data bit rate. The bit rate actually
        changes at the sample points of BRS and the CRC delimiter. Counting BRS as a nominal bit and the CRC
        delimiter as a data bit gives the same total duration.
    """
    if frame.fd:
        return exact_fd_bits(frame.can_id, frame.data, extended=frame.extended, brs=frame.brs, esi=esi)
    if frame.extended:
        return exact_bits(frame.can_id, frame.data, extended=True, remote=frame.remote, dlc=frame.dlc), 0
    length = frame.dlc if frame.remote else len(frame.data)
    return classic_frame_bits(frame.can_id << 7 | frame.remote << 6 | length, frame.data), 0
