"""A simulated patch against the reference forward model."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from skinnode.config import SimulationConfig
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout
from vcan_sim.default_scene import Scene
from vcan_sim.sensor import SimulatedPatch

LAYOUT = PatchLayout.preset("staggered")
SCENE = Scene(LAYOUT, SimulationConfig(seed=5))
S = 1_000_000_000
TOUCHING = int((SCENE.lead_s + 2.0) * S)


@pytest.mark.parametrize(
    "layout", [LAYOUT, PatchLayout.preset("aligned", upper_wires=3, upper_electrodes=2, lower_electrodes=5)]
)
def test_reads_what_the_forward_model_gives_for_the_truth(layout: PatchLayout) -> None:
    patch = SimulatedPatch(Scene(layout, SimulationConfig(seed=5)), converter_noise=0.0)
    patch.start(7 * S)
    for t_ns in (7 * S, 7 * S + TOUCHING):
        truth = patch.truth_m(t_ns)
        np.testing.assert_allclose(patch.read(t_ns), resistance_ohm(layout, truth), rtol=1e-12)
    assert (truth != layout.upper_m).any()


def test_nothing_happens_before_the_start() -> None:
    """A tare at power-on may come any time, and sees the patch untouched."""
    patch = SimulatedPatch(SCENE, converter_noise=0.0)
    rest = resistance_ohm(LAYOUT, LAYOUT.upper_m)
    for t_ns in (0, TOUCHING, 10**15):
        np.testing.assert_allclose(patch.read(t_ns), rest, rtol=1e-12)
        np.testing.assert_array_equal(patch.truth_m(t_ns), LAYOUT.upper_m)
    assert not patch.started
    patch.start(10**15)
    assert patch.started
    assert (patch.truth_m(10**15 + TOUCHING) != LAYOUT.upper_m).any()
    assert patch.reads == 3


def test_scene_time_runs_in_seconds_from_the_start() -> None:
    patch = SimulatedPatch(SCENE)
    patch.start(10**15)
    for t_s in (SCENE.lead_s + 0.5, SCENE.lead_s + 2.5):
        expected = SCENE.upper_m(t_s)
        np.testing.assert_allclose(patch.truth_m(10**15 + round(t_s * S)), expected, atol=1e-11)


def test_truth_can_be_asked_for_later_and_in_any_order() -> None:
    patch = SimulatedPatch(SCENE)
    patch.start(0)
    times = [TOUCHING + k * S // 100 for k in range(5)]
    seen = [patch.truth_m(t_ns).copy() for t_ns in times]
    patch.read(TOUCHING + 9 * S)
    for t_ns, truth in reversed(list(zip(times, seen, strict=True))):
        np.testing.assert_array_equal(patch.truth_m(t_ns), truth)


def test_noise_is_relative_white_and_repeats_with_the_seed() -> None:
    noise = 3e-6
    exact = SimulatedPatch(SCENE, converter_noise=0.0)
    patch, twin = SimulatedPatch(SCENE, converter_noise=noise), SimulatedPatch(SCENE, converter_noise=noise)
    readings = np.array([patch.read(k) / exact.read(k) - 1.0 for k in range(200)])
    np.testing.assert_array_equal(readings, [twin.read(k + 99) / exact.read(k) - 1.0 for k in range(200)])
    n = readings.size
    assert abs(readings.mean()) < 5 * noise / np.sqrt(n)
    assert readings.std() == pytest.approx(noise, rel=5 / np.sqrt(2 * n))
    sequence = readings.reshape(200, -1)
    lagged = (sequence[1:] * sequence[:-1]).mean() / noise**2
    assert abs(lagged) < 5 / np.sqrt(n)
    other = SimulatedPatch(Scene(LAYOUT, SCENE.simulation, number=1), converter_noise=noise)
    assert (other.read(0) != twin.read(0)).all()


def test_a_fault_stands_between_patch_and_converter() -> None:
    def open_wire(resistance: NDArray[np.float64], t_ns: int) -> NDArray[np.float64]:
        broken = resistance.copy()
        broken[4] = np.inf if t_ns >= S else broken[4]
        return broken

    patch, sound = SimulatedPatch(SCENE, fault=open_wire), SimulatedPatch(SCENE)
    np.testing.assert_array_equal(patch.read(0), sound.read(0))
    got, expected = patch.read(S), sound.read(S)
    assert np.isinf(got[4]).all()
    np.testing.assert_array_equal(np.delete(got, 4, axis=0), np.delete(expected, 4, axis=0))
