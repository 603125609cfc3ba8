"""Streams for SDO transfers: canopen 2.4's streams, with fixes for lost frames.

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
"""Duration in s of the silence after an abort that rules out further responses to the old transfer."""

_SETTLE_S: Final = 0.1
"""Maximum wait for that silence, s: another SDO client may keep the node busy."""

_RETRANSMISSIONS: Final = 20
"""Maximum number of retransmitted blocks in one transfer; a node that needs more is assumed not to accept
any."""


class Client(SdoClient):
    """canopen's SDO client for the server on node ``node_id``, without an object dictionary."""

    def __init__(self, network: canopen.Network, node_id: int) -> None:
        empty: Any = ObjectDictionary  # its constructor is not typed
        cob_ids = sdo_request_cob_id(node_id), sdo_response_cob_id(node_id)
        super().__init__(*cob_ids, empty())  # type: ignore[no-untyped-call]  # as all of canopen
        self.network = network
        network.subscribe(self.tx_cobid, self.on_response)
        self._abort_code: int = AbortCode.TIMED_OUT

    def abort(self, abort_code: int = AbortCode.TIMED_OUT) -> None:
        """Store the code for :meth:`give_up`, which receives the object as an argument."""
        self._abort_code = abort_code

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request and return the response.

        For a request that begins a transfer, the first response that names the same object is returned,
        because a slow node may still be sending frames from the previous transfer.

        Raises:
            SdoError: if there is no response, or the response is an abort.
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
        """Abort the transfer of this object at the node, and discard late responses.

        Raises:
            BusError: if the abort cannot be sent.
        """
        code, self._abort_code = self._abort_code, AbortCode.TIMED_OUT
        self.send_request(struct.pack("<BHBI", ABORT, index, subindex, code))  # type: ignore[no-untyped-call]
        end_s = clock.monotonic() + _SETTLE_S
        with contextlib.suppress(queue.Empty):
            while clock.monotonic() < end_s:
                self.responses.get(timeout=_QUIET_S)


class BlockUpload(BlockUploadStream):
    """A block upload.

    canopen 2.4 requests a late segment twice and drops the first response, so every pause longer than its
    timeout results in a wrong CRC. canopen requests an out-of-order segment only once, so this class makes a
    late segment look out of order.
    """

    def read(self, size: int = -1) -> bytes:
        """Read one segment, as canopen does."""
        if size >= 0 and not self._done:
            try:
                response = self.sdo_client.read_response()
            except SdoCommunicationError:
                response = bytes(8)  # no segment has number 0
            self.sdo_client.responses.queue.appendleft(response)
        return bytes(super().read(size))  # type: ignore[no-untyped-call]  # as all of canopen

    def abort(self, abort_code: int) -> None:
        """Store the code. canopen calls this method if the end of the transfer does not arrive."""
        self._error = True
        self.sdo_client.abort(abort_code)


class Download(WritableStream):
    """An expedited or segmented download."""

    def close(self) -> None:
        """Send nothing: the final segment has already been marked as the last."""
        io.RawIOBase.close(self)


class BlockDownload(BlockDownloadStream):
    """A block download of ``data``, ended by :meth:`finish`."""

    def __init__(self, client: Client, index: int, data: bytes) -> None:
        super().__init__(client, index, 0, len(data))  # type: ignore[no-untyped-call]
        self._crc.process(data)
        self._retransmitting = True  # stops canopen from updating the CRC
        self._left = _RETRANSMISSIONS

    def close(self) -> None:
        """Send nothing: a failed transfer has been aborted."""
        io.RawIOBase.close(self)

    def finish(self) -> None:
        """Send the CRC and wait for the end of the transfer.

        Raises:
            SdoError: if the node does not confirm the end.
        """
        super().close()  # type: ignore[no-untyped-call]

    def _retransmit(self, ackseq: int, blksize: int) -> None:
        """Send the segments after number ``ackseq`` of the block again."""
        self._left -= 1
        if self._left < 0:
            raise SdoCommunicationError("the node does not acknowledge any segment")
        again = self._current_block[ackseq:]
        self.pos -= sum(len(segment) for segment in again)
        self._done = False
        self._current_block, self._seqno, self._blksize = [], 0, blksize
        for segment in again:
            self.write(segment)  # type: ignore[no-untyped-call]
