"""Imperfect patches behind the real node, on a bus, and solved by the real host."""

from __future__ import annotations

import dataclasses
import uuid

import numpy as np
import pytest

from skinnode.config import HandConfig, SimulationConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.host import Host
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from tests.lanes import some_long
from vcan_sim.default_scene import Scene
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import parse_scene
from vcan_sim.sensor import SimulatedPatch
from vcan_sim.skin.imperfections import EXACT, Imperfections
from vcan_sim.skin.patch import PhysicalPatch
from vcan_sim.virtual_time import VirtualClock

S = 1_000_000_000
ORDINARY = Imperfections.ordinary(seed=3)


def hand(
    patches: int = 1, *, period_ms: int = 100, interface: str = "virtual", **simulation: object
) -> HandConfig:
    return parse_hand(
        {
            "buses": [{"name": "can0", "interface": interface, "channel": uuid.uuid4().hex[:8]}],
            "sync": {"period_ms": period_ms},
            "patches": [
                {"name": f"p{i}", "node_id": 5 + i, "tolerances": "ordinary"} for i in range(patches)
            ],
            "simulation": {"seed": 2, **simulation},
        }
    )


def test_a_simulated_patch_reads_its_skin() -> None:
    layout = PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4)
    scene = Scene(layout, SimulationConfig(seed=5), number=2)
    patch = SimulatedPatch(scene, converter_noise=0.0, imperfections=dataclasses.replace(ORDINARY, noise=0.0))
    twin = PhysicalPatch(layout, dataclasses.replace(ORDINARY, noise=0.0), number=2)
    np.testing.assert_array_equal(patch.read(0), twin.converted_ohm(twin.rest_ohm, 0))
    np.testing.assert_array_equal(patch.truth_m(0), twin.rest_m)
    assert (patch.displacement_m(0) == 0.0).all()
    assert (patch.truth_m(0) != layout.upper_m).any()
    patch.start(S)
    t_s = scene.lead_s + 1.5
    t_ns = S + round(t_s * S)
    t_s = (t_ns - S) * 1e-9
    np.testing.assert_array_equal(patch.read(t_ns), twin.resistance_ohm(t_s, scene.upper_m))
    truth = twin.upper_m(t_s, scene.upper_m)
    np.testing.assert_array_equal(patch.truth_m(t_ns), truth)
    np.testing.assert_array_equal(patch.displacement_m(t_ns), truth - twin.rest_m)
    # creep and hysteresis change the displacement by a few per cent, not beyond
    scale = float(np.abs(scene.upper_m(t_s) - layout.upper_m).max())
    off = np.abs(patch.displacement_m(t_ns) - (scene.upper_m(t_s) - layout.upper_m)).max() / scale
    assert 1e-3 < off < 0.06


def test_noise_of_an_imperfect_converter_differs_between_readings_and_repeats() -> None:
    scene = Scene(PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4))
    sizes = Imperfections(seed=9, noise=1e-5)
    one, two = (SimulatedPatch(scene, converter_noise=0.0, imperfections=sizes) for _ in range(2))
    first, second = one.read(0), one.read(0)
    assert (first != second).all()
    np.testing.assert_array_equal(two.read(5), first)
    np.testing.assert_array_equal(two.read(6), second)


def test_one_for_all_patches_or_by_name() -> None:
    plan = hand(3)
    fleet = Fleet(plan, imperfections=ORDINARY)
    rests = [patch.skin.rest_m.tobytes() for patch in fleet.patches.values()]
    assert len(set(rests)) == 3  # one layout, one seed, three patches
    again = Fleet(plan, imperfections=ORDINARY)
    assert [patch.skin.rest_m.tobytes() for patch in again.patches.values()] == rests
    some = Fleet(plan, imperfections={"p1": ORDINARY}).patches
    assert [patch.skin.imperfections for patch in some.values()] == [EXACT, ORDINARY, EXACT]
    assert some["p1"].skin.rest_m.tobytes() == rests[1]
    with pytest.raises(
        ConfigError, match=r"^imperfections: got 'p7', allowed: a patch of the hand: p0, p1, p2"
    ):
        Fleet(plan, imperfections={"p7": ORDINARY})


def test_the_truth_of_a_scene_is_what_the_node_measures() -> None:
    """The product's forward model, at the true displacement, gives the resistances of a skin that creeps."""
    press = {
        "body": "ball",
        "patch": "p0",
        "at_m": [0.006, 0.006],
        "depth_m": 2e-4,
        "from_s": 0.1,
        "to_s": 2.0,
    }
    scene = parse_scene(
        {"bodies": [{"name": "ball", "shape": "sphere", "radius_m": 0.02}], "touches": [press]}
    )
    sizes = Imperfections(creep=ORDINARY.creep, hysteresis=0.05, row_time_s=1e-3)
    fleet = Fleet(hand(), scene=scene, imperfections=sizes)
    patch = fleet.patches["p0"]
    layout = patch.scene.layout
    patch.start(S)
    for t_s in (0.2, 1.0, 1.95, 2.2):  # the press begins, goes on, ends, and has left the skin
        t_ns = S + round(t_s * S)
        moved_m = fleet.truth_at("p0", t_ns).displacement_m
        assert np.abs(moved_m).max() > 1e-7
        expected_ohm = resistance_ohm(layout, layout.upper_m + moved_m)
        np.testing.assert_allclose(patch.exact_ohm(t_ns), expected_ohm, rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("period_ms", some_long([100, 700], 100))  # frames of 700 ms have little in common
def test_the_host_is_right_about_an_ordinary_patch(period_ms: int) -> None:
    """With stated tolerances, fields are trusted, and 1 value in 1000 at most is beyond five deviations."""
    plan = hand(period_ms=period_ms, interface="timed", cycle_s=2.1)
    deviations: list[Float] = []
    with VirtualClock(), Fleet(plan, imperfections=ORDINARY) as fleet, Host.from_config(plan) as host:
        for field in host.fields(timeout_s=60, capacity=1000):
            assert field.stamp is not None
            truth_m = fleet.displacement_m("p0", field.stamp.device_time_us)
            if np.abs(truth_m).max() > 50e-6:
                assert field.trusted, field.distrust
                deviations.append(np.abs(field.displacement_m - truth_m) / field.displacement_std_m)
            if len(deviations) == 20:
                break
    beyond = np.mean(np.array(deviations) > 5.0)
    assert beyond <= 1e-3
    assert np.max(deviations) > 1.0  # a claim that covers everything would be no use
