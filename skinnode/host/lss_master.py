"""Layer setting services, the master's side (CiA 305 v3.0): nodes without a node-ID are found, a node is
selected by its address, gets a node-ID and a bit rate, and stores them.

A slave that does not agree is silent, so every *no* costs a waiting time. Answers bear no number: one that
comes late, to a question that was given up, looks like one to the question of now. So a node counts as found
or selected only when it has told its own address, which nobody else's answer can; and a service that got no
answer is given up only when none can be under way any more.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen import nmt
from skinnode.canopen.lss import (
    BIT_RATES_BPS,
    LSS_DONE,
    LSS_MANUFACTURER_ERROR,
    NOT_CONFIGURED,
    RESET_SCAN,
    LssAddress,
    LssCommand,
    LssState,
)
from skinnode.errors import BusError

ANSWER_S: Final = 0.1
"""How long an answer may take; the frame has the lowest priority but for heartbeats."""

STORE_ANSWER_S: Final = 2.0
"""Longest time to the answer to the store command: the node writes to flash memory, or to a file that it
synchronises to disk. CANopenNode's LSS master waits 1 s for any answer."""

_SCAN_ANSWERS_S: Final = (0.03, 0.15)
"""The same within a fastscan, where every *no* is waited for; the longer one where the first found nobody
who agrees in the end."""

_TRIES: Final = 2
"""Questions of which silence means that nobody is there; a busy machine may miss one."""

_SETTLE: Final = 0.2
"""Share of the waiting time that the answers of several slaves to one question may lie apart."""

_UNDER_WAY_S: Final = 0.4
"""After which an answer that was due is not waited for, nor feared, any more."""

_PARTS: Final = 4
_REVISIONS: Final = od.REVISION_NUMBER, od.UNCHECKED_REVISION_NUMBER
_LIKELY: Final = (od.VENDOR_ID,), (od.PRODUCT_CODE,), _REVISIONS
"""Addresses of skinnode patches, which fastscan tries first: three or four requests in place of 96."""


class LssFailed(BusError):
    """A slave refused a service or fell silent."""


class LssMaster:
    """Speaks through ``send``; :meth:`on_response` gets what comes on 0x7E4. One thread at a time may ask,
    but for :meth:`give_node_id`, which waits for its turn."""

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
            if self.select_patch(serial) is None:
                return False
            try:
                active = self.node_id()
                if active != node_id:
                    self.set_node_id(node_id)
            except LssFailed:
                return False
            finally:  # a slave without a node-ID boots when it is let go
                self.release()
            if active not in (None, node_id):
                self._send(od.NMT_COB_ID, nmt.encode(nmt.NmtCommand.RESET_COMMUNICATION, active))
            return True

    # --- who is there

    def any_unconfigured(self) -> bool:
        """Return whether there is a node without a node-ID. Sends *identify non-configured remote slave* and
        the first request of fastscan, because some stacks (CANopenNode) support fastscan only."""
        wanted = bytes((LssCommand.IDENTIFIED_NOT_CONFIGURED,))
        if any(self._ask(LssCommand.IDENTIFY_NOT_CONFIGURED, wanted=wanted) for _ in range(_TRIES)):
            return True
        return self._scan(0, RESET_SCAN, 0, 0, ANSWER_S) is not None

    def find_unconfigured(self) -> LssAddress | None:
        """One node without a node-ID, by fastscan; it is in configuration until :meth:`release`. None where
        there is none, or nobody agrees in the end."""
        for answer_s in _SCAN_ANSWERS_S:
            if self._scan(0, RESET_SCAN, 0, 0, ANSWER_S) is None:
                return None
            parts: list[int] = []
            while len(parts) < _PARTS:
                value = self._scan_part(len(parts), answer_s)
                if value is None:
                    break
                parts.append(value)
            else:
                address = LssAddress(*parts)
                if self._is_in_configuration(address):
                    return address
        return None

    def _scan_part(self, part: int, answer_s: float) -> int | None:
        """The part of the address of the node that stays in the race; None where nobody agrees in the end."""
        following = (part + 1) % _PARTS
        for likely in _LIKELY[part] if part < len(_LIKELY) else ():
            if self._scan(likely, 0, part, following, answer_s) is not None:
                return likely
        value = 0
        for bit in range(31, -1, -1):
            if self._scan(value, bit, part, part, answer_s) is None:
                value |= 1 << bit
        return value if self._scan(value, 0, part, following, answer_s) is not None else None

    def _scan(self, value: int, bit: int, part: int, following: int, answer_s: float) -> bytes | None:
        data = value.to_bytes(4, "little") + bytes((bit, part, following))
        answer = self._ask(LssCommand.FASTSCAN, data, bytes((LssCommand.IDENTIFIED,)), answer_s)
        if answer is not None:  # others may agree a little later: not to the next question
            time.sleep(answer_s * _SETTLE)
        return answer

    # --- one node

    def select(self, address: LssAddress) -> bool:
        """Switch the node with that address to configuration; False where there is none."""
        self.release()
        for command, value in enumerate(address[:3], LssCommand.SELECT_VENDOR):
            self._request(command, value.to_bytes(4, "little"))
        serial, selected = address.serial_number.to_bytes(4, "little"), bytes((LssCommand.SELECTED,))
        if self._ask(LssCommand.SELECT_SERIAL, serial, selected) is None:
            return False
        if self._is_in_configuration(address):
            return True
        self.release()
        return False

    def select_patch(self, serial: int) -> LssAddress | None:
        """Switch the patch with this serial number, of any revision, to LSS configuration state. Returns its
        address, or None if there is no such patch."""
        for revision in _REVISIONS:
            address = LssAddress(od.VENDOR_ID, od.PRODUCT_CODE, revision, serial)
            if self.select(address):
                return address
        return None

    def _is_in_configuration(self, address: LssAddress) -> bool:
        """Whether the node in configuration says that it has that address."""
        return all(
            self._ask(command, b"", bytes((command,)) + value.to_bytes(4, "little")) is not None
            for command, value in enumerate(address, LssCommand.INQUIRE_VENDOR)
        )

    def node_id(self) -> int | None:
        """Of the node in configuration; None for none. Raises LssFailed."""
        answer = self._must(LssCommand.INQUIRE_NODE_ID, b"", "the inquiry for its node-ID")
        return None if answer[1] == NOT_CONFIGURED else answer[1]

    def set_node_id(self, node_id: int) -> None:
        """It counts from the node's next reset of communication on. Raises LssFailed."""
        answer = self._must(LssCommand.CONFIGURE_NODE_ID, bytes((node_id,)), f"node-ID {node_id}")
        _require_done(answer, f"node-ID {node_id}")

    def set_bit_rate(self, bitrate_bps: int) -> None:
        """It counts from the node's next power-on on, if stored. Raises LssFailed, ValueError for a bit rate
        that CiA 301 does not have."""
        codes = {rate: code for code, rate in BIT_RATES_BPS.items()}
        if bitrate_bps not in codes:
            raise ValueError(f"bitrate: got {bitrate_bps}, must be one of {', '.join(map(str, codes))}")
        what = f"bit rate {bitrate_bps}"
        request = bytes((0, codes[bitrate_bps]))
        _require_done(self._must(LssCommand.CONFIGURE_BIT_TIMING, request, what), what)

    def store(self) -> None:
        """Have the node keep its node-ID and bit rate over a power cycle. Raises LssFailed."""
        answer = self._must(LssCommand.STORE, b"", "the store command", STORE_ANSWER_S)
        _require_done(answer, "the store command")

    def release(self) -> None:
        """All nodes back to waiting; one that got its first node-ID boots."""
        self._request(LssCommand.SWITCH_GLOBAL, bytes((LssState.WAITING,)))

    # --- frames

    def _must(self, command: int, data: bytes, what: str, answer_s: float = ANSWER_S) -> bytes:
        answer = self._ask(command, data, answer_s=answer_s)
        if answer is None:
            time.sleep(_UNDER_WAY_S)
            raise LssFailed(f"{what}: got no answer by LSS, allowed: one within {answer_s:g} s")
        return answer

    def _ask(
        self, command: int, data: bytes = b"", wanted: bytes | None = None, answer_s: float = ANSWER_S
    ) -> bytes | None:
        """The answer to a request, None where there is none in time: the first that begins with ``wanted``,
        by default with the command itself. Others belong to a question before."""
        wanted = bytes((command,)) if wanted is None else wanted
        while not self._answers.empty():
            self._answers.get()
        self._request(command, data)
        end_s = time.monotonic() + answer_s
        while (left_s := end_s - time.monotonic()) > 0:
            with contextlib.suppress(queue.Empty):
                answer = self._answers.get(timeout=left_s)
                if answer.startswith(wanted):
                    return answer
        return None

    def _request(self, command: int, data: bytes) -> None:
        self._send(od.LSS_REQUEST_COB_ID, (bytes((command,)) + data).ljust(8, b"\0"))


def _require_done(answer: bytes, what: str) -> None:
    if answer[1] != LSS_DONE:
        detail = f" (the maker's own code {answer[2]})" if answer[1] == LSS_MANUFACTURER_ERROR else ""
        raise LssFailed(f"{what}: got error code {answer[1]}{detail}, allowed: 0 (done)")
