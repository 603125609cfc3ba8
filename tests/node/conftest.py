"""A node on a desk: no bus, no thread, the clock is a number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skinnode.errors import BusError
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import Pacing, PatchNode

NODE_ID = 4
MS = 1_000_000


class Source:
    """Resistances a test sets; counts how often it was read."""

    def __init__(self, layout: PatchLayout) -> None:
        self.ohm: Float = resistance_ohm(layout, layout.upper_m)
        self.reads = 0

    def read(self, t_ns: int) -> Float:
        self.reads += 1
        return self.ohm


class Desk:
    """A node, what it sent (identifier, payload, time), and the time."""

    def __init__(self, layout: PatchLayout, node_id: int = NODE_ID, **options: Any) -> None:
        self.layout = layout
        self.source = Source(layout)
        self.t_ns = 1_000 * MS
        self.sent: list[tuple[int, bytes, int]] = []
        self.bus_refuses = False
        self.node = PatchNode(node_id, layout, self.source, send=self._send, **options)

    def _send(self, can_id: int, data: bytes) -> None:
        if self.bus_refuses:
            raise BusError("can0: no buffer space available")
        self.sent.append((can_id, data, self.t_ns))

    def power_on(self) -> None:
        self.node.power_on(self.t_ns)

    def take(self) -> list[tuple[int, str]]:
        """What was sent since last asked, payloads in hexadecimal."""
        taken, self.sent = self.sent, []
        return [(can_id, data.hex(" ")) for can_id, data, _ in taken]

    def frame(self, can_id: int, data: str = "", *, remote: bool = False) -> list[tuple[int, str]]:
        """Give the node a frame; returns what it sent before and because of it."""
        self.node.on_frame(can_id, bytes.fromhex(data), self.t_ns, remote)
        return self.take()

    def run(self, ms: float) -> None:
        """Let time pass; timers are served on the nanosecond."""
        end_ns = self.t_ns + round(ms * MS)
        while (due_ns := self.node.next_deadline_ns()) is not None and due_ns <= end_ns:
            self.t_ns = max(self.t_ns, due_ns)
            self.node.on_timer(self.t_ns)
        self.t_ns = end_ns

    def sdo(self, request: str) -> str:
        """The one frame that answers an SDO request."""
        node_id = self.node.node_id
        answers = [data for can_id, data in self.frame(0x600 + node_id, request) if can_id == 0x580 + node_id]
        assert len(answers) == 1, answers
        return answers[0]

    def write(self, index: int, subindex: int, value: int, size: int) -> None:
        """Expedited download that must be accepted."""
        head = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([subindex])
        answer = self.sdo((head + value.to_bytes(size, "little").ljust(4, b"\0")).hex())
        assert bytes.fromhex(answer) == b"\x60" + head[1:] + bytes(4), answer

    def read(self, index: int, subindex: int) -> int:
        """Expedited upload that must be answered."""
        head = index.to_bytes(2, "little") + bytes([subindex])
        answer = bytes.fromhex(self.sdo((b"\x40" + head + bytes(4)).hex()))
        assert answer[0] & 0xE3 == 0x43, answer.hex(" ")
        assert answer[1:4] == head
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little")

    def configure_pdo(self, parameter: int, *entries: int, cob_id: int, **values: int) -> None:
        """The standard's procedure: off, mapping off, map, mapping on, parameters, on. ``parameter`` is the
        index of the communication record, ``values`` are any of kind, inhibit, timer and start."""
        mapping = parameter + 0x200
        self.write(parameter, 1, 0x8000_0000 | cob_id, 4)
        self.write(mapping, 0, 0, 1)
        for slot, entry in enumerate(entries, 1):
            self.write(mapping, slot, entry, 4)
        self.write(mapping, 0, len(entries), 1)
        for name, value in values.items():
            subindex, size = {"kind": (2, 1), "inhibit": (3, 2), "timer": (5, 2), "start": (6, 1)}[name]
            self.write(parameter, subindex, value, size)
        self.write(parameter, 1, cob_id, 4)
        self.take()

    def times(self, can_id: int, since_ns: int) -> list[float]:
        """When the frames of ``can_id`` were sent, ms since ``since_ns``."""
        return [(t_ns - since_ns) / MS for sent_id, _, t_ns in self.sent if sent_id == can_id]

    def start(self) -> None:
        """NMT start of all nodes."""
        self.frame(0, "01 00")


@pytest.fixture
def layout() -> PatchLayout:
    """2 × 6 wires: 4 chunks of 3 codes."""
    return PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=2, lower_wires=6)


@pytest.fixture
def make(layout: PatchLayout) -> Callable[..., Desk]:
    """Makes a node that has been powered on and has said so; ``ohm`` is what its source reads."""

    def make(of: PatchLayout = layout, ohm: Float | None = None, **options: Any) -> Desk:
        desk = Desk(of, **options)
        if ohm is not None:
            desk.source.ohm = ohm
        desk.power_on()
        desk.take()
        return desk

    return make


@pytest.fixture
def desk(make: Callable[..., Desk]) -> Desk:
    """A node in PRE-OPERATIONAL, inhibit time strict."""
    return make(pacing=Pacing(slack_ns=0, catch_up_ns=0))


@pytest.fixture
def operational(desk: Desk) -> Desk:
    """An OPERATIONAL node that counts SYNC up to 240 and sends a chunk each 0.5 ms."""
    desk.write(0x1019, 0, 240, 1)
    desk.write(0x1800, 1, 0x80000184, 4)
    desk.write(0x1800, 3, 5, 2)
    desk.write(0x1800, 1, 0x184, 4)
    desk.start()
    desk.take()
    return desk


@pytest.fixture
def rest_ohm(layout: PatchLayout) -> Float:
    return np.array(resistance_ohm(layout, layout.upper_m))
