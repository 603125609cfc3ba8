"""The crossbar of a simulated patch, against nodal analysis resistor by resistor and closed forms."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skinnode.config import SimulationConfig
from skinnode.model.layout import PatchLayout
from vcan_sim.default_scene import Scene
from vcan_sim.skin.crossbar import Side, floating_ohm, grounded_ohm
from vcan_sim.skin.imperfections import Imperfections
from vcan_sim.skin.patch import PhysicalPatch

Array = NDArray[np.float64]
LAYOUT = PatchLayout.preset("staggered", upper_wires=3, upper_electrodes=4, lower_wires=5, lower_electrodes=3)
SCENE = Scene(LAYOUT, SimulationConfig(seed=5, depth=0.3))
TOUCHED_S = SCENE.lead_s + 1.5


class Network:
    """Resistors between named nodes; solved densely for the potentials of all nodes without a source."""

    def __init__(self) -> None:
        self.resistors: list[tuple[Any, Any, float]] = []
        self.same: dict[Any, Any] = {}

    def connect(self, one: Any, other: Any, ohm: float) -> None:
        """A resistor; without resistance the two names mean one node."""
        if ohm == 0.0:
            self.same[self.name(one)] = self.name(other)
        else:
            self.resistors.append((one, other, ohm))

    def name(self, node: Any) -> Any:
        while node in self.same:
            node = self.same[node]
        return node

    def potentials(self, sources: dict[Any, float], fed: dict[Any, float]) -> dict[Any, float]:
        """Potentials in volts for given ``sources`` in volts and currents ``fed`` in amperes."""
        known = {self.name(node): volt for node, volt in sources.items()}
        pairs = [(self.name(a), self.name(b), ohm) for a, b, ohm in self.resistors]
        nodes = sorted({n for a, b, _ in pairs for n in (a, b)} - known.keys(), key=repr)
        index = {node: i for i, node in enumerate(nodes)}
        matrix, right = np.zeros((len(nodes), len(nodes))), np.zeros(len(nodes))
        for node, ampere in fed.items():
            right[index[self.name(node)]] += ampere
        for a, b, ohm in pairs:
            for here, there in ((a, b), (b, a)):
                if here in index:
                    matrix[index[here], index[here]] += 1.0 / ohm
                    if there in index:
                        matrix[index[here], index[there]] -= 1.0 / ohm
                    else:
                        right[index[here]] += known[there] / ohm
        return known | dict(zip(nodes, np.linalg.solve(matrix, right).tolist(), strict=True))

    def current_into(self, node: Any, volts: dict[Any, float]) -> float:
        """Current in amperes that the resistors carry into a node."""
        there = self.name(node)
        total = 0.0
        for a, b, ohm in self.resistors:
            one, other = self.name(a), self.name(b)
            if there in (one, other) and one != other:
                total += (volts[other if one == there else one] - volts[there]) / ohm
        return total


def contacts_of(sizes: Imperfections) -> tuple[Array, Array]:
    """Resistances in series with the upper and the lower wires, of which those of the contacts are drawn."""
    drawn = PhysicalPatch(LAYOUT, sizes)
    return drawn._sides[0].series_ohm, drawn._sides[1].series_ohm


def slow(sizes: Imperfections, upper_m: Array) -> Array:
    """Readings of the patch with its electrodes at ``upper_m``, one pair of wires after another."""
    upper_series, lower_series = contacts_of(sizes)
    upper, per_upper, lower, per_lower = *upper_m.shape[:2], *LAYOUT.lower_m.shape[:2]
    network = Network()
    for u, n, k, m in itertools.product(range(upper), range(per_upper), range(lower), range(per_lower)):
        ohm = LAYOUT.resistivity_ohm_per_m * float(np.linalg.norm(upper_m[u, n] - LAYOUT.lower_m[k, m]))
        network.connect(("upper", u, n), ("lower", k, m), ohm)
    sides = (
        ("upper", upper_series, sizes.upper_wire_ohm, per_upper),
        ("lower", lower_series, sizes.lower_wire_ohm, per_lower),
    )
    for name, series, along, electrodes in sides:
        for wire, ohm in enumerate(series):
            network.connect((name, wire, "source"), (name, wire, "connector"), float(ohm))
            network.connect((name, wire, "connector"), (name, wire, 0), along)
            for each in range(1, electrodes):
                network.connect((name, wire, each - 1), (name, wire, each), along)
    found = np.empty((upper, lower))
    if sizes.readout == "floating":
        for u, k in np.ndindex(found.shape):
            one, other = ("upper", u, "source"), ("lower", k, "source")
            volts = network.potentials({other: 0.0}, {one: 1.0})
            found[u, k] = volts[network.name(one)]
        return found
    for u in range(upper):
        sources = {("upper", v, "source"): float(v == u) for v in range(upper)}
        sources |= {("lower", k, "source"): 0.0 for k in range(lower)}
        volts = network.potentials(sources, {})
        for k in range(lower):
            found[u, k] = 1.0 / network.current_into(("lower", k, "source"), volts)
    return found


SERIES = [
    {},
    {"contact_ohm": 100.0},
    {"multiplexer_ohm": 300.0},
    {"virtual_ground_ohm": 200.0},
    {"contact_ohm": 40.0, "multiplexer_ohm": 300.0, "virtual_ground_ohm": 200.0},
]


@pytest.mark.parametrize(
    "wires",
    [
        {},
        {"upper_wire_ohm": 50.0},
        {"lower_wire_ohm": 80.0},
        {"upper_wire_ohm": 50.0, "lower_wire_ohm": 80.0},
    ],
    ids=str,
)
@pytest.mark.parametrize("series", SERIES, ids=str)
@pytest.mark.parametrize("readout", ["grounded", "floating"])
def test_readings_are_those_of_the_network_resistor_by_resistor(
    readout: Any, series: dict[str, float], wires: dict[str, float]
) -> None:
    sizes = Imperfections(seed=6, readout=readout, **series, **wires)
    found = PhysicalPatch(LAYOUT, sizes).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    np.testing.assert_allclose(found, slow(sizes, SCENE.upper_m(TOUCHED_S)), rtol=1e-10)


def test_contacts_are_drawn_uniformly_around_their_mean() -> None:
    drawn = np.concatenate(
        [
            np.concatenate(contacts_of(Imperfections(seed=seed, readout="grounded", contact_ohm=10.0)))
            for seed in range(100)
        ]
    )
    assert drawn.min() >= 5.0
    assert drawn.max() <= 15.0
    deviation = 10.0 / np.sqrt(12.0)
    assert drawn.mean() == pytest.approx(10.0, abs=5 * deviation / np.sqrt(drawn.size))
    assert drawn.std() == pytest.approx(deviation, rel=5 / np.sqrt(2 * drawn.size))


def test_a_grounded_network_without_series_resistances_reads_the_crossings() -> None:
    exact = PhysicalPatch(LAYOUT).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    found = PhysicalPatch(LAYOUT, Imperfections(readout="grounded")).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    np.testing.assert_allclose(found, exact, rtol=1e-13)


def wires(ohm: list[float]) -> Side:
    return Side(np.array(ohm), 0.0, 1)


OHM = st.floats(10.0, 1e5)


@given(a=OHM, b=OHM, c=OHM, d=OHM)
@settings(max_examples=50, deadline=None)
def test_two_by_two_floating(a: float, b: float, c: float, d: float) -> None:
    """Each crossing is in parallel with the other three in series."""
    found = floating_ohm(1.0 / np.array([[a, b], [c, d]]), wires([0.0, 0.0]), wires([0.0, 0.0]))
    around = a + b + c + d
    expected = [[a * (b + c + d) / around, b * (a + c + d) / around],
                [c * (a + b + d) / around, d * (a + b + c) / around]]  # fmt: skip
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    apart = floating_ohm(1.0 / np.array([[a, b], [c, d]]), wires([3.0, 5.0]), wires([7.0, 11.0]))
    np.testing.assert_allclose(apart, np.add(expected, [[10.0, 14.0], [12.0, 16.0]]), rtol=1e-8)


@given(a=OHM, b=OHM, c=OHM, d=OHM, r=st.floats(0.1, 1e3))
@settings(max_examples=50, deadline=None)
def test_two_by_two_grounded(a: float, b: float, c: float, d: float, r: float) -> None:
    """An imperfect virtual ground lets current flow back through the other upper wire, and an imperfect
    source divides its voltage; the closed forms of both."""
    crossings = np.array([[a, b], [c, d]])
    column = 1.0 / a + 1.0 / c
    found = grounded_ohm(1.0 / crossings, wires([0.0, 0.0]), wires([r, r]))
    assert found[0, 0] == pytest.approx(a * (1.0 + r * column), rel=1e-9)
    found = grounded_ohm(1.0 / crossings, wires([r, r]), wires([0.0, 0.0]))
    assert found[0, 1] == pytest.approx(b * (1.0 + r * (1.0 / a + 1.0 / b)), rel=1e-9)


@pytest.mark.parametrize(
    "name", ["contact_ohm", "upper_wire_ohm", "lower_wire_ohm", "multiplexer_ohm", "virtual_ground_ohm"]
)
def test_small_resistances_act_in_proportion(name: str) -> None:
    exact = PhysicalPatch(LAYOUT).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    one, two = (
        PhysicalPatch(LAYOUT, Imperfections(readout="grounded", **{name: ohm}))  # type: ignore[arg-type]
        .resistance_ohm(TOUCHED_S, SCENE.upper_m) - exact
        for ohm in (0.01, 0.02)
    )  # fmt: skip
    assert (one > 0.0).all()
    np.testing.assert_allclose(two / one, 2.0, rtol=1e-4)


def test_sneak_paths_lower_every_reading() -> None:
    exact = PhysicalPatch(LAYOUT).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    found = PhysicalPatch(LAYOUT, Imperfections(readout="floating")).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    assert (found < 0.8 * exact).all()
    # Foster's theorem: the resistances times the conductances of all crossings add up to nodes minus one
    assert float((found / exact).sum()) == pytest.approx(sum(LAYOUT.shape) - 1, rel=1e-10)
