"""Read and write a remote node's object dictionary over SDO.

The SDO client of the canopen package blocks the calling thread until the mainline delivers the response
through :meth:`SkinNetwork.notify`. It does not limit the length or duration of a transfer, so a faulty node
could exhaust memory or block a thread forever. This module adds both limits.

Threads: only one thread at a time may access a node. Different nodes may be accessed in parallel.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import canopen
from canopen.sdo.client import ReadableStream
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError, SdoError

from skinnode.canopen.abort import AbortCode
from skinnode.canopen.indices import DEVICE_TYPE
from skinnode.canopen.sdo import SEGMENT_BYTES
from skinnode.errors import NodeError, NodeTimeout, SdoAbort, SkinError
from skinnode.host.containment import one_line
from skinnode.host.sdo_streams import BlockDownload, BlockUpload, Client, Download
from skinnode.process import clock
from skinnode.text.words import counted

ATTEMPTS: Final = 3
"""Maximum number of attempts for a transfer that gets either no response or the response to an earlier
transfer."""

_SILENCES: Final = ("No SDO response", "could not be retransmitted")
"""canopen's error messages for a missing response. The second occurs after canopen's own retransmission
requests.
"""

_OUT_OF_STEP: Final = (
    AbortCode.TOGGLE_BIT,
    AbortCode.TIMED_OUT,
    AbortCode.UNKNOWN_COMMAND,
    AbortCode.INVALID_BLOCK_SIZE,
    AbortCode.INVALID_SEQUENCE,
    AbortCode.CRC,
)
"""SDO abort codes that indicate a lost frame. A transfer aborted with one of these codes is retried."""

MAX_UPLOAD_BYTES: Final = 4 * 254 * 254
"""Maximum length (bytes) of a value: the baseline of the largest possible patch."""

MAX_TEXT_BYTES: Final = 4096
"""Maximum length (bytes) of a short value, such as a string."""

_MAX_NUMBER_BYTES: Final = 8

_TRANSFER_S: Final = 5.0
_SEGMENT_S: Final = 0.02
"""Time limit (s) for a transfer: ``_TRANSFER_S``, plus ``_SEGMENT_S`` for each segment of the longest value
allowed.
"""

_PLAIN: Final = {"u8": "<B", "u16": "<H", "u32": "<I", "f32": "<f"}

# Keep canopen's warnings off the terminal: this module raises exceptions for the same errors.
logging.getLogger("canopen").addHandler(logging.NullHandler())


class Abandoned(Exception):
    """Raised when a transfer is aborted because the caller no longer needs the result."""


class _UploadTooLong(Exception):
    """Raised when an upload exceeds the maximum length or duration."""


class SkinNetwork(canopen.Network):
    """canopen network that sends its frames through ``send``."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a data frame.

        Raises:
            ValueError: if ``remote`` is True. Remote frames are not supported.
        """
        if remote:
            raise ValueError("remote: got True, the host sends data frames only")
        self._send(can_id, bytes(data))


class RemoteOd:
    """Object dictionary of a remote node, read and written over SDO.

    A value is of type ``u8``, ``u16``, ``u32`` or ``f32``. ``abandoned`` is called after each segment. If it
    returns True, the transfer is aborted and Abandoned is raised. A transfer that gets no response or raises
    an unexpected exception is retried.

    Threads: only one thread at a time may use an instance.

    Args:
        network: Network that sends the requests.
        node_id: Node-ID of the SDO server.
        on_defect: Function called with each exception that the node's response does not explain.

    Raises:
        NodeTimeout: if the node does not respond; raised by all methods.
        SdoAbort: if the node aborts the transfer; raised by all methods.
        NodeError: if a value is malformed or too long, or a transfer takes too long; raised by all methods.
    """

    def __init__(
        self,
        network: SkinNetwork,
        node_id: int,
        on_defect: Callable[[Exception], object] = lambda error: None,
    ) -> None:
        self.node_id, self._on_defect = node_id, on_defect
        self.abandoned: Callable[[], bool] = lambda: False
        self._client = Client(network, node_id)

    @contextmanager
    def abort_if(self, abandoned: Callable[[], bool]) -> Iterator[None]:
        """Abort a transfer in the ``with`` block as soon as ``abandoned`` returns True."""
        before, self.abandoned = self.abandoned, abandoned
        try:
            yield
        finally:
            self.abandoned = before

    def answers(self) -> bool:
        """Return whether the node responds to one SDO request. An abort counts as a response."""
        try:
            self._upload(DEVICE_TYPE, 0, _MAX_NUMBER_BYTES)
        except SdoAbortedError:
            return True
        except _UploadTooLong:
            self._client.give_up(DEVICE_TYPE, 0)
            return True
        except Abandoned:
            self._client.give_up(DEVICE_TYPE, 0)
            raise
        except SkinError:
            raise
        except Exception as error:  # no response, or a response that violates CiA 301
            if not isinstance(error, SdoError):
                self._on_defect(error)
            self._client.give_up(DEVICE_TYPE, 0)
            return False
        return True

    def read_bytes(self, index: int, subindex: int, most: int = MAX_TEXT_BYTES) -> bytes:
        """Return the undecoded value (at most ``most`` bytes) of an object."""
        return bytes(self._transfer(index, subindex, "read", lambda: self._upload(index, subindex, most)))

    def read_block(self, index: int, most: int = MAX_UPLOAD_BYTES) -> bytes:
        """Return a long value (at most ``most`` bytes) by block transfer with CRC."""

        def ask() -> bytes:
            with BlockUpload(self._client, index) as stream:  # type: ignore[no-untyped-call]
                return self._whole(stream, most)

        return bytes(self._transfer(index, 0, "block read", ask))

    def read_large(self, index: int, most: int = MAX_UPLOAD_BYTES) -> bytes:
        """Return a long value by block transfer or, if the node aborts that, by segmented transfer."""
        try:
            return self.read_block(index, most)
        except SdoAbort:
            return self.read_bytes(index, 0, most)

    def write_block(self, index: int, data: bytes) -> None:
        """Write a long value by block transfer with CRC."""

        def ask() -> None:
            with BlockDownload(self._client, index, data) as stream:
                _send(stream, data)
                stream.finish()

        self._transfer(index, 0, "block write", ask)

    def read(self, index: int, subindex: int, kind: str) -> Any:
        """Return the value of an object of type ``kind``."""
        layout = struct.Struct(_PLAIN[kind])
        data = self.read_bytes(index, subindex, _MAX_NUMBER_BYTES)
        if len(data) != layout.size:
            shown = data.hex(" ") or "nothing"
            raise NodeError(
                self.node_id,
                f"object {_name(index, subindex)}: got {shown}, expected {layout.size} bytes ({kind})",
            )
        return layout.unpack(data)[0]

    def write(self, index: int, subindex: int, kind: str, value: float) -> None:
        """Write a value without reading it back."""
        self.write_bytes(index, subindex, struct.pack(_PLAIN[kind], value))

    def write_bytes(self, index: int, subindex: int, data: bytes) -> None:
        """Write an encoded value."""

        def ask() -> None:
            with Download(self._client, index, subindex, len(data)) as stream:  # type: ignore[no-untyped-call]
                _send(stream, data)

        self._transfer(index, subindex, "write", ask)

    def write_if_different(self, index: int, subindex: int, kind: str, value: float) -> None:
        """Write a value and read it back, unless the node already has the value."""
        if self.read(index, subindex, kind) != value:
            self.write_checked(index, subindex, kind, value)

    def write_checked(self, index: int, subindex: int, kind: str, value: float) -> None:
        """Write a value and read it back.

        Raises:
            NodeError: if the value read back differs.
        """
        self.write(index, subindex, kind, value)
        kept = self.read(index, subindex, kind)
        if kept != value:
            raise NodeError(
                self.node_id,
                f"object {_name(index, subindex)}: read back {_shown(kept)} after writing {_shown(value)}",
            )

    def _transfer(self, index: int, subindex: int, verb: str, ask: Callable[[], Any]) -> Any:
        where = f"{verb} of object {_name(index, subindex)}"
        failure: Exception | None = None
        for _ in range(ATTEMPTS):
            try:
                return ask()
            except SkinError:  # the request could not be sent
                raise
            except _UploadTooLong as endless:
                self._client.give_up(index, subindex)
                raise NodeError(self.node_id, f"{where}: got {endless}") from None
            except Abandoned:
                self._client.give_up(index, subindex)
                raise
            except SdoAbortedError as abort:
                failure = abort
                if abort.code not in _OUT_OF_STEP:
                    break
            except Exception as error:  # bugs in canopen may raise AttributeError, struct.error etc.
                failure = error
                if not isinstance(error, SdoError):
                    self._on_defect(error)
                self._client.give_up(index, subindex)
        raise self._failed(where, failure) from (None if isinstance(failure, SdoError) else failure)

    def _upload(self, index: int, subindex: int, most: int) -> bytes:
        with ReadableStream(self._client, index, subindex) as stream:  # type: ignore[no-untyped-call]
            return self._whole(stream, most)

    def _whole(self, stream: Any, most: int) -> bytes:
        """Read a stream to its end.

        Raises SdoCommunicationError if the length of the data differs from the announced size, _UploadTooLong
        if the data exceed ``most`` bytes or the transfer takes too long, and Abandoned if ``abandoned``
        returns True.
        """
        if stream.size is not None and stream.size > most:
            raise _UploadTooLong(f"a value of {counted(stream.size, 'byte')}, expected at most {most}")
        limit_s = _TRANSFER_S + _SEGMENT_S * most / SEGMENT_BYTES
        end_s = clock.monotonic() + limit_s
        data = bytearray()
        while segment := stream.read(SEGMENT_BYTES):
            data += segment
            if len(data) > (most if stream.size is None else stream.size):
                if stream.size is None:
                    raise _UploadTooLong(f"more than {counted(most, 'byte')}, expected at most {most}")
                break
            if self.abandoned():
                raise Abandoned
            if clock.monotonic() > end_s:
                raise _UploadTooLong(
                    f"{counted(len(data), 'byte')} after {limit_s:.1f} s, expected the end of the transfer"
                )
        if stream.size is not None and len(data) != stream.size:
            raise SdoCommunicationError(f"{len(data)} of {stream.size} bytes")
        return bytes(data)

    def _failed(self, where: str, failure: Exception | None) -> NodeError:
        if isinstance(failure, SdoAbortedError):
            text = SdoAbortedError.CODES.get(failure.code, "no such code in CiA 301")
            return SdoAbort(self.node_id, failure.code, f"{where}: {text}")
        if any(silence in str(failure) for silence in _SILENCES):
            waited_s = ATTEMPTS * self._client.RESPONSE_TIMEOUT
            return NodeTimeout(self.node_id, f"{where}: no response within {waited_s:.1f} s")
        if "returned a value for" in str(failure):  # response to another client or from another node
            got = f"{where}: got the response for another object"
            why = f"two nodes respond with node-ID {self.node_id}, or another SDO client is using it"
            return NodeError(self.node_id, f"{got}; {why}")
        if isinstance(failure, SdoError):
            return NodeError(
                self.node_id, f"{where}: got {failure}, expected a response according to CiA 301"
            )
        return NodeError(
            self.node_id,
            f"{where}: the transfer failed ({one_line(failure)}), expected a response according to CiA 301",
        )


def _send(stream: Any, data: bytes) -> None:
    """Write ``data`` to a stream in segments. Empty data are sent as one empty segment."""
    at = stream.write(data[:SEGMENT_BYTES])
    while at < len(data):
        at += stream.write(data[at : at + SEGMENT_BYTES])


def _name(index: int, subindex: int) -> str:
    return f"0x{index:04X}:{subindex}"


def _shown(value: float) -> str:
    return f"0x{value:X}" if isinstance(value, int) else f"{value:g}"
