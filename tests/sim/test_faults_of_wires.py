"""Wires that are broken, shorted or noisy, of the patch that is named."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.config import parse_hand
from skinnode.errors import ConfigError
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NmtState
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.profile import PatchProfile
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.faulty_converter import WIRE_NOISE, FaultyConverter
from vcan_sim.faulty_node import FaultyNode
from vcan_sim.fleet import Fleet

SHAPE = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
HAND = parse_hand(
    {
        "buses": [{"name": "can0", "interface": "virtual"}],
        "patches": [{"name": name, "node_id": i, "layout": SHAPE} for i, name in enumerate(("a", "b"), 1)],
    }
)
REST_OHM = np.arange(1.0, 49.0).reshape(4, 12)


class Steady:
    def __init__(self, layout: PatchLayout) -> None:
        assert layout.shape == REST_OHM.shape

    def read(self, t_ns: int) -> Float:
        return REST_OHM


def node_with(faults: Faults) -> FaultyNode:
    patch = HAND.patches[0]
    layout = patch.layout.build()
    return FaultyNode(
        1,
        layout,
        Steady(layout),
        emit=lambda can_id, data, *, remote=False: None,
        on_sent=lambda can_id: None,
        serial=1,
        profile=PatchProfile.from_config(patch, HAND.buses[0]),
        faults=faults,
    )


def test_what_the_converter_sees() -> None:
    node = node_with(Faults(open_upper=2, shorted_lower=5, noisy_upper=0))
    np.testing.assert_array_equal(node.converter.read(0), REST_OHM)  # before it is up: the tare
    node.power_on(0)
    node.on_timer(10**9)
    assert node.nmt_state is NmtState.PRE_OPERATIONAL
    seen = np.array([node.converter.read(i) for i in range(400)])
    assert np.isinf(seen[:, 2]).all()  # a pair with both stays open
    assert (seen[:, [0, 1, 3], 5] == 0.0).all()
    sound = np.delete(seen, 5, axis=2)
    np.testing.assert_array_equal(sound[:, [1, 3]] - np.delete(REST_OHM, 5, axis=1)[[1, 3]], 0.0)
    ratio = sound[:, 0] / np.delete(REST_OHM, 5, axis=1)[0]
    assert ratio.std() == pytest.approx(WIRE_NOISE, rel=0.06)  # 4400 values: ±1.1 %
    assert node.injected.miswired == 400
    node.faults = NO_FAULTS
    np.testing.assert_array_equal(node.converter.read(0), REST_OHM)


def test_of_one_patch_or_of_all() -> None:
    faults = Fleet(HAND).faults
    faults.inject("lost=0.5", "b:open_upper=3,silent", "b:noisy_lower=0")
    assert faults.patch("a") == Faults(lost=0.5)
    assert faults.patch("b") == Faults(lost=0.5, open_upper=3, silent=True, noisy_lower=0)
    assert Fleet(HAND).faults.patch("a") == NO_FAULTS


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("c:silent", "--fault: got 'c', allowed: a patch of the hand: a, b; or a bus: can0"),
        ("a:open_upper=4", "a: open_upper: got 4, allowed: an integer from 0 to 3"),
        ("a:noisy_lower=12", "a: noisy_lower: got 12, allowed: an integer from 0 to 11"),
        ("a:crossed_upper=3", "a: crossed_upper: got 3, allowed: an integer from 0 to 2"),
        (
            "a:stuck_lower=3",
            "stuck_lower: got 3, allowed: both stuck_upper and stuck_lower, which name a crossing",
        ),
        ("a:open_upper=-1", "open_upper: got -1, allowed: a non-negative integer"),
        ("a:open_upper=x", "--fault open_upper: got 'x', allowed: an integer, or none"),
    ],
)
def test_what_cannot_be(text: str, line: str) -> None:
    fleet = Fleet(HAND)
    with pytest.raises(ConfigError) as caught:
        fleet.faults.inject(text)
    assert str(caught.value) == line


class Counting(Steady):
    def __init__(self, layout: PatchLayout) -> None:
        super().__init__(layout)
        self.conversions = 0

    def read(self, t_ns: int) -> Float:
        self.conversions += 1
        return super().read(t_ns)


def test_a_frozen_converter_counts_no_conversions() -> None:
    node = node_with(NO_FAULTS)
    converter = FaultyConverter(
        Counting(HAND.patches[0].layout.build()),
        node._injector,
        booting=lambda: False,
        baseline_ohm=lambda: REST_OHM,
        scale=CodeScale(),
    )
    counts = []
    for faults in (NO_FAULTS, Faults(frozen=True), Faults(frozen=True), NO_FAULTS, Faults(uncounted=True)):
        node.faults = faults
        converter.read(0)
        counts.append(converter.conversions)
    assert counts == [1, 1, 1, 2, None]
    assert (node.injected.frozen, node.injected.uncounted) == (2, 1)


class Rising:
    """Readings of which each is larger than the one before."""

    def __init__(self) -> None:
        self.reads = 0

    def read(self, t_ns: int) -> Float:
        self.reads += 1
        return REST_OHM * (1.0 - 1e-3 * self.reads)


def converter_of(node: FaultyNode) -> FaultyConverter:
    options = {"booting": lambda: False, "baseline_ohm": lambda: REST_OHM, "scale": CodeScale()}
    return FaultyConverter(Rising(), node._injector, **options)


def test_what_is_frozen_keeps_its_reading_until_the_fault_ends() -> None:
    node = node_with(NO_FAULTS)
    converter = converter_of(node)
    converter.read(0)
    node.faults = Faults(frozen_lower=3, stuck_upper=1, stuck_lower=5)
    seen = np.array([converter.read(0) for _ in range(4)]) / REST_OHM
    expected = np.tile(1.0 - 1e-3 * np.arange(2, 6)[:, None, None], (1, 4, 12))
    expected[:, :, 3] = expected[0, 0, 0]
    expected[:, 1, 5] = expected[0, 0, 0]
    np.testing.assert_allclose(seen, expected, rtol=1e-12)
    node.faults = Faults(frozen_upper=2)
    np.testing.assert_allclose(converter.read(0) / REST_OHM, 1.0 - 6e-3, rtol=1e-12)
    after = converter.read(0) / REST_OHM
    np.testing.assert_allclose(after[2], 1.0 - 6e-3, rtol=1e-12)
    np.testing.assert_allclose(np.delete(after, 2, axis=0), 1.0 - 7e-3, rtol=1e-12)


def test_crossed_wires() -> None:
    node = node_with(Faults(crossed_upper=0, crossed_lower=10))
    seen = converter_of(node).read(0) / (1.0 - 1e-3)
    np.testing.assert_allclose(seen, REST_OHM[[1, 0, 2, 3]][:, [*range(10), 11, 10]], rtol=1e-12)


def test_one_bit_of_one_code_is_flipped() -> None:
    node = node_with(Faults(flipped=0.25))
    converter = converter_of(node)
    bits = []
    for i in range(1, 401):
        codes = encode(converter.read(0), REST_OHM, CodeScale())
        sound = encode(REST_OHM * (1.0 - 1e-3 * i), REST_OHM, CodeScale())
        bits += (codes ^ sound)[codes != sound].tolist()
    assert len(bits) == node.injected.flipped
    assert 60 < len(bits) < 140
    assert {bit.bit_count() for bit in bits} == {1}
    assert len(set(bits)) > 10
