"""A patch whose scans are packed in C, on a bus with the real host."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
import pytest
from numpy.typing import NDArray

from skinnode.config import HandConfig
from skinnode.host import Condition, Host
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NodeRunner, PatchNode
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from tests.c_kit import COMPILERS, Kit

from .conftest import eventually

FRACTION_BITS = 8
"""A resistance is a number of 1/256 ohm."""
TARE_READS = 16
CHUNK, SUMMARY = 0x180, 0x280
SCANS = 30


def pressed_parts(layout: PatchLayout, scan: int) -> NDArray[np.int64]:
    """Resistances at a scan of a press that grows and recedes, in 1/256 ohm."""
    upper = layout.upper_m.copy()
    upper[1, 1:3, 2] -= 100e-6 * np.sin(np.pi * min(scan, SCANS) / SCANS)
    return np.rint(resistance_ohm(layout, upper) * (1 << FRACTION_BITS)).astype(np.int64)


class Press:
    """A converter that presses deeper with every reading after the tare."""

    def __init__(self, layout: PatchLayout) -> None:
        self._layout, self._reads = layout, -TARE_READS
        self.parts, self.t_ns = pressed_parts(layout, 0), 0

    def read(self, t_ns: int) -> Float:
        self.t_ns = t_ns
        self.parts = pressed_parts(self._layout, max(0, self._reads))
        self._reads += 1
        return self.parts / (1 << FRACTION_BITS)


class BoardInC:
    """A board whose firmware packs scans in C; the services of CANopen are those of the node in Python.

    In place of each chunk and each summary of the node, the board sends one that the kit packed. ``frames``
    counts them.
    """

    def __init__(self, kit: Kit, node_id: int, press: Press, port: CanPort) -> None:
        self._kit, self._press, self._port = kit, press, port
        self._ids = node_id + CHUNK, node_id + SUMMARY
        self._packed: list[tuple[int, bytes]] = []
        self.frames = 0
        for part in press.parts.ravel().tolist():
            kit.add("f", "QB", TARE_READS * part, FRACTION_BITS + 4)
        self._baseline_ohm = kit.ask().words().view(np.float32).tolist()
        kit.add("I")

    def send(self, can_id: int, data: bytes) -> None:
        if can_id not in self._ids:
            self._port.send(can_id, data)
            return
        if not self._packed:
            self._scan(data[1] if can_id == self._ids[0] else data[0])
        function, packed = self._packed.pop(0)
        assert function == can_id & 0x780
        self._port.send(can_id, packed)
        self.frames += 1

    def _scan(self, counter: int) -> None:
        codes = self._kit.encode(self._press.parts.ravel().tolist(), FRACTION_BITS, self._baseline_ohm)
        self._kit.add_scan(codes, counter, self._press.t_ns // 1000)
        self._packed, _ = self._kit.ask().scan_sent()


@pytest.fixture(params=COMPILERS)
def kit(request: pytest.FixtureRequest, make_hand: Callable[..., HandConfig]) -> Iterator[Kit]:
    layout = make_hand().patches[0].layout.build()
    with Kit(PatchProfile.from_layout(layout), request.param) as running:
        yield running


def test_fields_of_a_board_in_c_are_those_of_a_node_in_python(hand: HandConfig, kit: Kit) -> None:
    fields: dict[str, dict[int, FieldFrame]] = {"p0": {}, "p1": {}}
    with ExitStack() as stack:
        boards = []
        for patch in hand.patches:
            layout, port = patch.layout.build(), stack.enter_context(CanPort(hand.buses[0]))
            press = Press(layout)
            board = BoardInC(kit, patch.node_id, press, port)
            send = board.send if patch.name == "p0" else port.send
            node = PatchNode(
                patch.node_id, layout, press, send=send, profile=PatchProfile.from_layout(layout)
            )
            stack.enter_context(NodeRunner(port, [node]))
            boards.append(board)
        with Host.from_config(hand) as host:
            for field in host.fields():
                fields[field.stamp.patch][field.stamp.scan] = field
                if min(map(len, fields.values())) == SCANS:
                    break
            stats = host.stats().patches["p0"].assembler
            assert eventually(lambda: host.health("p0").condition is Condition.OPERATIONAL)
    both = sorted(fields["p0"].keys() & fields["p1"].keys())
    assert len(both) >= SCANS - 1
    for scan in both:
        in_c, in_python = fields["p0"][scan], fields["p1"][scan]
        np.testing.assert_array_equal(in_c.displacement_m, in_python.displacement_m)
        np.testing.assert_array_equal(in_c.displacement_std_m, in_python.displacement_std_m)
        assert in_c.trusted
    deepest = min(fields["p0"][scan].displacement_m[..., 2].min() for scan in both)
    assert deepest == pytest.approx(-100e-6, rel=0.02)
    assert stats.scans_complete >= SCANS
    assert stats.scans_torn == stats.scans_corrupt == stats.scans_mixed == 0
    assert boards[0].frames >= SCANS * 17
    assert boards[1].frames == 0
