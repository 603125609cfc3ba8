"""Find nodes without a node-ID, and set node-IDs and bit rates, as an LSS master (CiA 305 v3.0).

A slave that does not match a request stays silent, so every negative result costs a full timeout. LSS
responses are not numbered, so a late response to an earlier request looks like a response to the current
one. The master therefore counts a node as found or selected only when the node has returned its own
LSS address. After a timeout, the master waits until a late response can no longer arrive.
"""

from __future__ import annotations

import contextlib
import queue
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
from skinnode.process import clock

ANSWER_S: Final = 0.1
"""Time limit (s) for an LSS response. LSS frames have a low priority and may be delayed on a busy bus."""

STORE_ANSWER_S: Final = 2.0
"""Time limit (s) for the response to the store command. The node first writes to flash memory or syncs a file
to disk. For comparison, CANopenNode's LSS master waits 1 s for any response.
"""

_SCAN_ANSWERS_S: Final = (0.03, 0.15)
"""Time limits (s) for the response to a fastscan request, in the first and the second fastscan. The second,
slower fastscan runs only if the first finds no node.
"""

_TRIES: Final = 2
"""Number of unanswered requests after which a node counts as absent. A busy computer may miss one response.
"""

_SETTLE: Final = 0.2
"""Pause after the first response to a fastscan request, as a fraction of the timeout. It leaves time for
other slaves' responses.
"""

_UNDER_WAY_S: Final = 0.4
"""Pause (s) after a timeout, long enough for a late response to arrive."""

_PARTS: Final = 4
_REVISIONS: Final = od.REVISION_NUMBER, od.UNCHECKED_REVISION_NUMBER
_LIKELY: Final = (od.VENDOR_ID,), (od.PRODUCT_CODE,), _REVISIONS
"""Likely values of the first three parts of an LSS address: those of a skinnode patch. A fastscan tries them
first. If they match, three or four requests replace the 96 of a bit-by-bit search.
"""


class LssFailed(BusError):
    """Raised when a slave refuses an LSS service or does not respond."""


class LssMaster:
    """LSS master on one bus.

    The master sends its requests through ``send``. The caller must pass every response (COB-ID 0x7E4) to
    :meth:`on_response`.

    Threads: the mainline calls :meth:`on_response`. Among the other methods, only :meth:`give_node_id`
    may be called from several threads at once.
    """

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        self._send = send
        self._answers: queue.SimpleQueue[bytes] = clock.simple_queue()
        self._dialogue = clock.lock()

    def on_response(self, data: bytes, t_ns: int) -> None:
        """Process a slave's response. A response that is not 8 bytes long is ignored (CiA 305)."""
        if len(data) == 8:
            self._answers.put(data)

    def give_node_id(self, serial: int, node_id: int) -> bool:
        """Make the patch with this serial number boot with ``node_id``.

        The patch does not store the node-ID: that is left to a technician. A patch that already has the
        node-ID is left unchanged.

        Returns:
            Whether the patch was found and accepted the node-ID.

        Raises:
            BusError: if a frame cannot be sent.
        """
        with self._dialogue:
            if self.select_patch(serial) is None:
                return False
            try:
                active = self.node_id()
                if active != node_id:
                    self.set_node_id(node_id)
            except LssFailed:
                return False
            finally:  # a slave that has just received its first node-ID boots when released
                self.release()
            if active not in (None, node_id):
                self._send(od.NMT_COB_ID, nmt.encode(nmt.NmtCommand.RESET_COMMUNICATION, active))
            return True

    # --- nodes without a node-ID

    def any_unconfigured(self) -> bool:
        """Return whether any node on the bus lacks a node-ID.

        The master uses the service *identify non-configured remote slave* and, if there is no response, the
        first request of a fastscan. Some stacks, such as CANopenNode, support only fastscan.
        """
        expected = bytes((LssCommand.IDENTIFIED_NOT_CONFIGURED,))
        if any(self._ask(LssCommand.IDENTIFY_NOT_CONFIGURED, expected=expected) for _ in range(_TRIES)):
            return True
        return self._scan(0, RESET_SCAN, 0, 0, ANSWER_S) is not None

    def find_unconfigured(self) -> LssAddress | None:
        """Use fastscan to find a node without a node-ID.

        The node stays in configuration state until :meth:`release` is called.

        Returns:
            LSS address of the node; None if no node was found.
        """
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
        """Return one part of an LSS address found by fastscan; None if the node stops responding."""
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
        # before the next request, wait for other slaves' responses
        if answer is not None:
            clock.sleep(answer_s * _SETTLE)
        return answer

    # --- one node

    def select(self, address: LssAddress) -> bool:
        """Switch the node with this address to configuration state. Return whether it was found."""
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
        """Switch the patch with this serial number to configuration state.

        All known revision numbers are tried.

        Returns:
            LSS address of the patch; None if it was not found.
        """
        for revision in _REVISIONS:
            address = LssAddress(od.VENDOR_ID, od.PRODUCT_CODE, revision, serial)
            if self.select(address):
                return address
        return None

    def _is_in_configuration(self, address: LssAddress) -> bool:
        """Return whether the node in configuration state reports this LSS address."""
        return all(
            self._ask(command, b"", bytes((command,)) + value.to_bytes(4, "little")) is not None
            for command, value in enumerate(address, LssCommand.INQUIRE_VENDOR)
        )

    def node_id(self) -> int | None:
        """Return the node-ID of the node in configuration state; None if it has none.

        Raises:
            LssFailed: if the node does not respond.
        """
        answer = self._must(LssCommand.INQUIRE_NODE_ID, b"", "the node-ID inquiry")
        return None if answer[1] == NOT_CONFIGURED else answer[1]

    def set_node_id(self, node_id: int) -> None:
        """Set the node-ID of the node in configuration state.

        The node-ID takes effect at the next communication reset.

        Raises:
            LssFailed: if the node refuses the node-ID or does not respond.
        """
        answer = self._must(LssCommand.CONFIGURE_NODE_ID, bytes((node_id,)), f"node-ID {node_id}")
        _require_done(answer, f"node-ID {node_id}")

    def set_bit_rate(self, bitrate_bps: int) -> None:
        """Set the bit rate of the node in configuration state.

        The bit rate takes effect at the next power-on, and only if it has been stored.

        Raises:
            LssFailed: if the node refuses the bit rate or does not respond.
            ValueError: if CiA 301 does not define the bit rate.
        """
        codes = {rate: code for code, rate in BIT_RATES_BPS.items()}
        if bitrate_bps not in codes:
            raise ValueError(f"bitrate: got {bitrate_bps}, must be one of {', '.join(map(str, codes))}")
        what = f"bit rate {bitrate_bps}"
        request = bytes((0, codes[bitrate_bps]))
        _require_done(self._must(LssCommand.CONFIGURE_BIT_TIMING, request, what), what)

    def store(self) -> None:
        """Make the node in configuration state store its node-ID and bit rate permanently.

        Raises:
            LssFailed: if the node refuses the command or does not respond.
        """
        answer = self._must(LssCommand.STORE, b"", "the store command", STORE_ANSWER_S)
        _require_done(answer, "the store command")

    def release(self) -> None:
        """Switch all nodes to waiting state.

        A node that has just received its first node-ID boots on this command.
        """
        self._request(LssCommand.SWITCH_GLOBAL, bytes((LssState.WAITING,)))

    # --- frames

    def _must(self, command: int, data: bytes, what: str, answer_s: float = ANSWER_S) -> bytes:
        answer = self._ask(command, data, answer_s=answer_s)
        if answer is None:
            clock.sleep(_UNDER_WAY_S)
            raise LssFailed(f"{what}: no LSS response within {answer_s:g} s")
        return answer

    def _ask(
        self, command: int, data: bytes = b"", expected: bytes | None = None, answer_s: float = ANSWER_S
    ) -> bytes | None:
        """Send a request and return the first response that starts with ``expected``; None on timeout.

        By default, ``expected`` is the command itself. Other responses belong to earlier requests and are
        discarded.
        """
        expected = bytes((command,)) if expected is None else expected
        while not self._answers.empty():
            self._answers.get()
        self._request(command, data)
        end_s = clock.monotonic() + answer_s
        while (left_s := end_s - clock.monotonic()) > 0:
            with contextlib.suppress(queue.Empty):
                answer = self._answers.get(timeout=left_s)
                if answer.startswith(expected):
                    return answer
        return None

    def _request(self, command: int, data: bytes) -> None:
        self._send(od.LSS_REQUEST_COB_ID, (bytes((command,)) + data).ljust(8, b"\0"))


def _require_done(answer: bytes, what: str) -> None:
    if answer[1] != LSS_DONE:
        detail = f" (manufacturer code {answer[2]})" if answer[1] == LSS_MANUFACTURER_ERROR else ""
        raise LssFailed(f"{what}: got error code {answer[1]}{detail}, expected 0 (success)")
