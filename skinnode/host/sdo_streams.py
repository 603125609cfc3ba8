"""Transfer SDO data with canopen 2.4's streams, modified to recover from lost frames.

==================  =========================================================  ==============================
stream              canopen 2.4.1                                              here
==================  =========================================================  ==============================
block upload        calls its own ``abort``, which it does not have, if the    has one
                    end of the transfer does not arrive
block upload        requests a late segment twice                              requests it once
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
"""Required quiet time (s) after an abort: if no response arrives for this time, the aborted transfer is
considered finished.
"""

_SETTLE_S: Final = 0.1
"""Maximum time (s) to wait for responses to cease after an abort. The wait is limited because another SDO
client may keep the node busy.
"""

_RETRANSMISSIONS: Final = 20
"""Maximum number of retransmitted blocks in one transfer. If a node requests more retransmissions, the
transfer fails, because the node probably rejects every block.
"""


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
        """Store the abort code; :meth:`give_up` sends the abort message."""
        self._abort_code = abort_code

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send an SDO request and return the response.

        If the request starts a transfer, responses for other objects are skipped: a slow node may still be
        responding to the previous transfer.

        Raises:
            SdoError: if no response arrives before the timeout, or the response is an abort.
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
        """Abort the current transfer of an object, and discard late responses.

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

    canopen 2.4 requests a late segment twice and drops the first response, so the CRC is wrong after any
    pause longer than canopen's timeout. An out-of-order segment, in contrast, is requested only once. This
    class therefore presents a late segment to canopen as an out-of-order segment.
    """

    def read(self, size: int = -1) -> bytes:
        """Read one segment of the upload; overrides canopen's method."""
        if size >= 0 and not self._done:
            try:
                response = self.sdo_client.read_response()
            except SdoCommunicationError:
                response = bytes(8)  # sequence number 0 is never valid
            self.sdo_client.responses.queue.appendleft(response)
        return bytes(super().read(size))  # type: ignore[no-untyped-call]  # canopen is not typed

    def abort(self, abort_code: int) -> None:
        """Store the abort code. canopen calls this method if the node does not end the transfer."""
        self._error = True
        self.sdo_client.abort(abort_code)


class Download(WritableStream):
    """Expedited or segmented SDO download."""

    def close(self) -> None:
        """Close the stream without sending a frame: the final segment is already marked as the last."""
        io.RawIOBase.close(self)


class BlockDownload(BlockDownloadStream):
    """SDO block download of ``data``, completed by :meth:`finish`."""

    def __init__(self, client: Client, index: int, data: bytes) -> None:
        super().__init__(client, index, 0, len(data))  # type: ignore[no-untyped-call]
        self._crc.process(data)
        self._retransmitting = True  # prevents canopen from updating the CRC
        self._left = _RETRANSMISSIONS

    def close(self) -> None:
        """Close the stream without sending a frame, because a failed transfer has already been aborted."""
        io.RawIOBase.close(self)

    def finish(self) -> None:
        """Send the CRC and wait for the node to confirm the end of the transfer.

        Raises:
            SdoError: if the node does not confirm the end of the transfer.
        """
        super().close()  # type: ignore[no-untyped-call]

    def _retransmit(self, ackseq: int, blksize: int) -> None:
        """Retransmit the segments of the current block after segment number ``ackseq``."""
        self._left -= 1
        if self._left < 0:
            raise SdoCommunicationError("the node does not acknowledge any segment")
        again = self._current_block[ackseq:]
        self.pos -= sum(len(segment) for segment in again)
        self._done = False
        self._current_block, self._seqno, self._blksize = [], 0, blksize
        for segment in again:
            self.write(segment)  # type: ignore[no-untyped-call]
