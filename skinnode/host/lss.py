"""Finding a patch by its serial number: layer setting services, the master's side (CiA 305 v3.0).

One dialogue at a time on a bus. No sleeps: a slave answers a switch selective within a few milliseconds, and
one that is not there not at all.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Final

from skinnode.wire import indices as od

ANSWER_S: Final = 0.1
"""How long an answer may take; the frame has the lowest priority but for heartbeats."""

_SWITCH_GLOBAL, _CONFIGURE_NODE_ID, _INQUIRE_NODE_ID = 0x04, 0x11, 0x5E
_SELECT_VENDOR, _SELECT_PRODUCT, _SELECT_REVISION, _SELECT_SERIAL, _SELECTED = 0x40, 0x41, 0x42, 0x43, 0x44
_WAITING: Final = 0
_NOT_CONFIGURED: Final = 0xFF
_NMT_RESET_COMMUNICATION: Final = 0x82


class LssMaster:
    """Speaks through ``send``; :meth:`on_response` is given what comes on 0x7E4."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        self._send = send
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._dialogue = threading.Lock()

    def on_response(self, data: bytes, t_ns: int) -> None:
        """A frame of a slave. One that is not of 8 bytes is ignored, as the standard wants it."""
        if len(data) == 8:
            self._answers.put(data)

    def give_node_id(self, serial: int, node_id: int) -> bool:
        """Have the patch with this serial number boot at ``node_id``; False where there is none, or it does
        not take it. A patch that is there already is left alone. Nothing is stored in it: that is for
        technicians. Raises BusError."""
        with self._dialogue:
            if not self._select(serial):
                return False
            try:
                answer = self._ask(_INQUIRE_NODE_ID, b"", _INQUIRE_NODE_ID)
                if answer is None or answer[1] == node_id:
                    return answer is not None
                active = answer[1]
                taken = self._ask(_CONFIGURE_NODE_ID, bytes([node_id]), _CONFIGURE_NODE_ID)
            finally:  # a slave without a node-ID boots when it is let go
                self._request(_SWITCH_GLOBAL, bytes([_WAITING]))
            if taken is None or taken[1]:
                return False
            if active != _NOT_CONFIGURED:
                self._send(od.NMT_COB_ID, bytes([_NMT_RESET_COMMUNICATION, active]))
            return True

    def _select(self, serial: int) -> bool:
        """Switch the one patch with this serial number to configuration."""
        self._request(_SWITCH_GLOBAL, bytes([_WAITING]))
        for command, value in (
            (_SELECT_VENDOR, od.VENDOR_ID),
            (_SELECT_PRODUCT, od.PRODUCT_CODE),
            (_SELECT_REVISION, od.REVISION_NUMBER),
        ):
            self._request(command, value.to_bytes(4, "little"))
        return self._ask(_SELECT_SERIAL, serial.to_bytes(4, "little"), _SELECTED) is not None

    def _request(self, command: int, data: bytes) -> None:
        self._send(od.LSS_REQUEST_COB_ID, (bytes([command]) + data).ljust(8, b"\0"))

    def _ask(self, command: int, data: bytes, wanted: int) -> bytes | None:
        """The answer to a request, None where there is none."""
        while not self._answers.empty():  # of a dialogue that was given up, or of somebody else's
            self._answers.get()
        self._request(command, data)
        try:
            answer = self._answers.get(timeout=ANSWER_S)
        except queue.Empty:
            return None
        return answer if answer[0] == wanted else None
