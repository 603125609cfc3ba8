"""A block upload in which segments are late, or lost: what arrives is what was sent, or the silence is named.

The server is a few lines of CiA 301, 7.2.4.3.12 to 7.2.4.3.14, and falls silent where a test says so."""

from __future__ import annotations

import binascii
from collections.abc import Iterable

import pytest

from skinnode.errors import NodeTimeout
from skinnode.host.sdo_client import RemoteOd, SkinNetwork

DATA = bytes(range(1, 61))  # nine segments, three bytes of the last unused


class Server:
    """Uploads ``DATA``. Of all segments that it sends, those of these numbers, from 1, do not arrive; after
    ``last`` it says nothing any more."""

    def __init__(self, lost: Iterable[int], last: int = 1000) -> None:
        self.network = SkinNetwork(self.on_request)
        self._lost, self._last = set(lost), last
        self._first = self._sent = 0
        self.initiated = 0

    def answer(self, data: bytes) -> None:
        self.network.notify(0x585, bytearray(data.ljust(8, b"\0")), 0.0)

    def block(self) -> None:
        parts = [DATA[i : i + 7] for i in range(7 * self._first, len(DATA), 7)]
        for number, part in enumerate(parts, 1):
            self._sent += 1
            if self._sent not in self._lost and self._sent <= self._last:
                self.answer(bytes((number | (0x80 if part is parts[-1] else 0),)) + part)

    def on_request(self, can_id: int, data: bytes) -> None:
        match data[0] & 0xE3:
            case 0xA0:
                self._first, self.initiated = 0, self.initiated + 1
                self.answer(b"\xc6" + data[1:4] + len(DATA).to_bytes(4, "little"))
            case 0xA3:
                self.block()
            case 0xA2:
                self._first += data[1]
                if 7 * self._first < len(DATA):
                    self.block()
                elif self._sent <= self._last:
                    crc = binascii.crc_hqx(DATA, 0)
                    self.answer(bytes((0xC1 | 3 << 2,)) + crc.to_bytes(2, "little"))


@pytest.mark.parametrize("lost", [range(4, 10), range(1, 10), [9], [3], [5, 6]])
def test_segments_that_do_not_come_are_asked_for_again(lost: Iterable[int]) -> None:
    """Those from one on, as where a thread stands still; all; the last; some with others behind them."""
    server = Server(lost)
    assert RemoteOd(server.network, 5).read_block(0x2301) == DATA
    assert server.initiated == 1  # in the same transfer


def test_a_node_that_falls_silent_in_a_block_is_silent() -> None:
    server = Server((), last=4)
    with pytest.raises(NodeTimeout, match=r"block read of object 0x2301:0: no response"):
        RemoteOd(server.network, 5).read_block(0x2301)
