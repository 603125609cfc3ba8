"""SDO, the way to a node's object dictionary: canopen's client over our own port.

canopen's client waits in the thread that asks; the mainline feeds it the answers through
:meth:`SkinNetwork.notify`. One thread at a time may ask a node; different nodes may be asked side by side.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from typing import Any, Final

import canopen
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import BlockUploadStream
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from skinnode.errors import NodeError, NodeTimeout, SdoAbort
from skinnode.wire.indices import DEVICE_TYPE

ATTEMPTS: Final = 3
"""Tries of a transfer that was not answered or whose answer belongs to an earlier one."""

_SILENCES: Final = ("No SDO response", "could not be retransmitted")
"""What canopen says where nothing came, the second after it asked for segments again."""

_PLAIN: Final = {"u8": "<B", "u16": "<H", "u32": "<I", "f32": "<f"}

# What goes wrong in a transfer is raised here with the node and the object; the library's own log lines
# would reach a terminal as well, because Python prints warnings that nobody handles.
logging.getLogger("canopen").addHandler(logging.NullHandler())


class SkinNetwork(canopen.Network):
    """canopen's network over a port of ours: ``send`` is where its frames go."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a data frame. The host never requests by RTR."""
        if remote:
            raise ValueError("remote: got True, the host sends data frames only")
        self._send(can_id, bytes(data))


class RemoteOd:
    """The object dictionary of a node, read and written by SDO.

    Values have one of the types ``u8 u16 u32 f32``. Raises NodeTimeout where the node does not answer,
    SdoAbort where it refuses, NodeError where it answers something else.
    """

    def __init__(self, network: SkinNetwork, node_id: int) -> None:
        self.node_id = node_id
        empty: Any = ObjectDictionary  # values are decoded here; its constructor is not typed
        self._client = network.add_node(node_id, empty()).sdo

    def answers(self) -> bool:
        """Whether the node answers at all, be it with an abort. One try."""
        try:
            self._client.upload(DEVICE_TYPE, 0)
        except SdoAbortedError:
            return True
        except SdoCommunicationError:
            return False
        return True

    def read_bytes(self, index: int, subindex: int) -> bytes:
        """The value as it came."""
        return bytes(self._transfer(index, subindex, "read", lambda: self._client.upload(index, subindex)))

    def read_block(self, index: int) -> bytes:
        """A value of many bytes by block transfer with CRC."""

        def ask() -> bytes:
            with _BlockUpload(self._client, index) as stream:  # type: ignore[no-untyped-call]
                return bytes(stream.readall())

        return bytes(self._transfer(index, 0, "block read", ask))

    def read_large(self, index: int) -> bytes:
        """By block transfer, or segment by segment from a node that refuses that."""
        try:
            return self.read_block(index)
        except SdoAbort:
            return self.read_bytes(index, 0)

    def write_block(self, index: int, data: bytes) -> None:
        """Write a value of many bytes by block transfer with CRC."""

        def ask() -> None:
            with self._client.open(index, 0, "wb", size=len(data), block_transfer=True) as stream:
                stream.write(data)

        self._transfer(index, 0, "block write", ask)

    def read(self, index: int, subindex: int, kind: str) -> Any:
        """The value, decoded."""
        layout = struct.Struct(_PLAIN[kind])
        data = self.read_bytes(index, subindex)
        if len(data) != layout.size:
            shown = data.hex(" ") or "nothing"
            raise NodeError(
                self.node_id,
                f"object {_name(index, subindex)}: got {shown}, allowed: {layout.size} bytes ({kind})",
            )
        return layout.unpack(data)[0]

    def write(self, index: int, subindex: int, kind: str, value: float) -> None:
        """Write and believe it."""
        self.write_bytes(index, subindex, struct.pack(_PLAIN[kind], value))

    def write_bytes(self, index: int, subindex: int, data: bytes) -> None:
        """Write the value as it is to travel."""
        self._transfer(index, subindex, "write", lambda: self._client.download(index, subindex, data))

    def ensure(self, index: int, subindex: int, kind: str, value: float) -> None:
        """Write, and read back, only what differs."""
        if self.read(index, subindex, kind) != value:
            self.configure(index, subindex, kind, value)

    def configure(self, index: int, subindex: int, kind: str, value: float) -> None:
        """Write and read back. Raises NodeError where the node kept something else."""
        self.write(index, subindex, kind, value)
        kept = self.read(index, subindex, kind)
        if kept != value:
            raise NodeError(
                self.node_id,
                f"object {_name(index, subindex)}: got {_shown(kept)} back, allowed: {_shown(value)} as set",
            )

    def _transfer(self, index: int, subindex: int, verb: str, ask: Callable[[], Any]) -> Any:
        where = f"{verb} of object {_name(index, subindex)}"
        failure: SdoCommunicationError | None = None
        for _ in range(ATTEMPTS):
            try:
                return ask()
            except SdoAbortedError as error:
                text = SdoAbortedError.CODES.get(error.code, "no such code in CiA 301")
                raise SdoAbort(self.node_id, error.code, f"{where}: {text}") from None
            except SdoCommunicationError as error:
                failure = error
        if any(silence in str(failure) for silence in _SILENCES):
            waited_s = ATTEMPTS * self._client.RESPONSE_TIMEOUT
            raise NodeTimeout(
                self.node_id, f"{where}: got no answer, allowed: one within {waited_s:.1f} s"
            ) from None
        if "returned a value for" in str(failure):  # to a question that was not ours, or from another node
            got = f"{where}: got the answer for another object, allowed: that for this one"
            why = f"two nodes answer with node-ID {self.node_id}, or another SDO client asks it"
            raise NodeError(self.node_id, f"{got}; {why}")
        raise NodeError(self.node_id, f"{where}: got {failure}, allowed: an answer of CiA 301") from None


class _BlockUpload(BlockUploadStream):
    """canopen 2.4 asks twice for a segment that did not come in time, and leaves out the first answer: every
    pause longer than its time-out ended in a wrong CRC. One that comes out of order it asks for once, so a
    segment that is late is made to look like that."""

    def read(self, size: int = -1) -> bytes:
        """One segment, as canopen has it."""
        if size >= 0 and not self._done:
            try:
                response = self.sdo_client.read_response()
            except SdoCommunicationError:
                response = bytes(8)  # no segment has number 0
            self.sdo_client.responses.queue.appendleft(response)
        return bytes(super().read(size))  # type: ignore[no-untyped-call]  # as all of canopen


def _name(index: int, subindex: int) -> str:
    return f"0x{index:04X}:{subindex}"


def _shown(value: float) -> str:
    return f"0x{value:X}" if isinstance(value, int) else f"{value:g}"
