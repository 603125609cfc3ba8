"""Adapt the SDO streams of canopen 2.4 so that transfers recover from lost frames.

==================  =========================================================  ==============================
stream              canopen 2.4.1                                              here
==================  =========================================================  ==============================
block upload        calls a missing method, ``abort``, if the end of the       has the method
                    transfer does not arrive
block upload        requests a late segment twice                              requests it once
block upload        limits a retransmission on the system clock, even in       limits it on the clock of
                    virtual time                                               :mod:`skinnode.process`
block download      raises RuntimeError if a segment of the last block must    sends it again
                    be sent again; its CRC then counts segments twice
both downloads      closing a failed transfer continues it, and waits for      closing sends nothing
                    responses, even in a destructor
all streams         the abort names no object                                  :meth:`Client.give_up` sends it
all streams         takes a late frame of the previous transfer for the first  waits for a response that names
                    response                                                   the object
==================  =========================================================  ==============================
"""

from __future__ import annotations

import contextlib
import io
import queue
import struct
from typing import Any, Final

import canopen
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import BlockDownloadStream, BlockUploadStream, SdoClient, WritableStream
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from skinnode.canopen.abort import AbortCode
from skinnode.canopen.indices import sdo_request_cob_id, sdo_response_cob_id
from skinnode.canopen.sdo import ABORT
from skinnode.process import clock

_QUIET_S: Final = 0.02
"""Time (s) without a response after which an aborted transfer counts as finished."""

_SETTLE_S: Final = 0.1
"""Time limit (s) for responses to cease after an abort. Another SDO client may keep the node responding."""

_RETRANSMISSIONS: Final = 20
"""Maximum number of retransmissions in one transfer. If a node requests more than this, it is probably
rejecting every block, so the transfer fails.
"""

_SEQUENCE: Final = 0x7F
"""Bits of a segment's first byte that contain its sequence number."""


class Client(SdoClient):
    """canopen SDO client for node ``node_id``, without an object dictionary."""

    def __init__(self, network: canopen.Network, node_id: int) -> None:
        empty: Any = ObjectDictionary  # canopen's constructor has no type annotations
        cob_ids = sdo_request_cob_id(node_id), sdo_response_cob_id(node_id)
        super().__init__(*cob_ids, empty())  # type: ignore[no-untyped-call]  # canopen is not typed
        self.network = network
        network.subscribe(self.tx_cobid, self.on_response)
        self._abort_code: int = AbortCode.TIMED_OUT

    def abort(self, abort_code: int = AbortCode.TIMED_OUT) -> None:
        """Store the abort code. :meth:`give_up` sends it."""
        self._abort_code = abort_code

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send an SDO request and return the response.

        A slow node may still be responding to the previous transfer. After a request that begins a transfer,
        responses for other objects are therefore skipped, unless nothing else arrives.

        Raises:
            SdoError: if no response arrives in time, or the response is an abort.
        """
        begins = sdo_request[0] >> 5 in (1, 2) or (sdo_request[0] >> 5, sdo_request[0] & 1) in (
            (5, 0),
            (6, 0),
        )
        objects = (bytes(sdo_request[1:4]), bytes(3))
        self.responses = clock.queue()
        self.send_request(sdo_request)  # type: ignore[no-untyped-call]
        end_s = clock.monotonic() + self.RESPONSE_TIMEOUT
        late: bytes | None = None
        while True:
            try:
                response: bytes = self.responses.get(timeout=max(0.0, end_s - clock.monotonic()))
            except queue.Empty:
                if late is None:
                    raise SdoCommunicationError("No SDO response received") from None
                response = late
            is_abort = response[0] == ABORT
            if response is late or not begins or response[1:4] in (objects if is_abort else objects[:1]):
                if is_abort:
                    raise SdoAbortedError(int.from_bytes(response[4:8], "little"))
                return response
            late = response

    def give_up(self, index: int, subindex: int) -> None:
        """Abort the transfer of an object, and discard late responses.

        Raises:
            BusError: if the abort message cannot be sent.
        """
        code, self._abort_code = self._abort_code, AbortCode.TIMED_OUT
        self.send_request(struct.pack("<BHBI", ABORT, index, subindex, code))  # type: ignore[no-untyped-call]
        end_s = clock.monotonic() + _SETTLE_S
        with contextlib.suppress(queue.Empty):
            while clock.monotonic() < end_s:
                self.responses.get(timeout=_QUIET_S)


class BlockUpload(BlockUploadStream):
    """Block upload that tolerates late segments.

    canopen 2.4 requests a late segment twice and drops the first response. After a pause longer than
    canopen's timeout, the CRC is therefore wrong. A segment with a wrong sequence number is requested only
    once, so this class presents a late segment as one with a wrong sequence number.
    """

    def read(self, size: int = -1) -> bytes:
        """Read one segment. Overrides canopen's method."""
        if size >= 0 and not self._done:
            try:
                response = self.sdo_client.read_response()
            except SdoCommunicationError:
                response = bytes(8)  # sequence number 0 is invalid
            self.sdo_client.responses.queue.appendleft(response)
        return bytes(super().read(size))  # type: ignore[no-untyped-call]  # canopen is not typed

    def _retransmit(self) -> bytes:
        """Request again all segments after the last valid one, and return the first of them.

        Raises:
            SdoError: if the segment does not arrive in time, or the response is an abort.
        """
        end_s = clock.monotonic() + self.sdo_client.RESPONSE_TIMEOUT
        self._ack_block()  # type: ignore[no-untyped-call]  # canopen is not typed
        while clock.monotonic() < end_s:
            response: bytes = self.sdo_client.read_response()
            if response[0] & _SEQUENCE == self._ackseq + 1:
                self._ackseq += 1
                return response
        self.abort(AbortCode.TIMED_OUT)
        raise SdoCommunicationError("Some data was lost and could not be retransmitted")

    def abort(self, abort_code: int) -> None:
        """Store the abort code. canopen calls this method if the end of the transfer does not arrive."""
        self._error = True
        self.sdo_client.abort(abort_code)


class Download(WritableStream):
    """Expedited or segmented SDO download."""

    def close(self) -> None:
        """Close the stream without sending a frame. The last segment has already been marked as such."""
        io.RawIOBase.close(self)


class BlockDownload(BlockDownloadStream):
    """SDO block download of ``data``, completed by :meth:`finish`."""

    def __init__(self, client: Client, index: int, data: bytes) -> None:
        super().__init__(client, index, 0, len(data))  # type: ignore[no-untyped-call]
        self._crc.process(data)
        self._retransmitting = True  # prevents canopen from updating the CRC
        self._left = _RETRANSMISSIONS

    def close(self) -> None:
        """Close the stream without sending a frame. A failed transfer has already been aborted."""
        io.RawIOBase.close(self)

    def finish(self) -> None:
        """Send the CRC and wait for the node to confirm the end of the transfer.

        Raises:
            SdoError: if the node does not confirm the end of the transfer.
        """
        super().close()  # type: ignore[no-untyped-call]

    def _retransmit(self, ackseq: int, blksize: int) -> None:
        """Retransmit the segments of the current block that follow segment ``ackseq``."""
        self._left -= 1
        if self._left < 0:
            raise SdoCommunicationError("the node does not acknowledge any segment")
        again = self._current_block[ackseq:]
        self.pos -= sum(len(segment) for segment in again)
        self._done = False
        self._current_block, self._seqno, self._blksize = [], 0, blksize
        for segment in again:
            self.write(segment)  # type: ignore[no-untyped-call]
