"""Forces that are not calibrated cover a layer bonded to metal, solved independently by Hankel transform."""

from __future__ import annotations

import math

import numpy as np
import pytest

import skinnode as sk
from skinnode.bench.truth import RUBBER, Press, Skin
from skinnode.solve.layer_force import bonded_force_n, stiffening
from tests.lanes import some_long

from .loads import bonded, bonded_surface, inside, spheres

SIGMA = 1e-5


def last_field(tracker: sk.Tracker, moved_m: np.ndarray, rng: np.random.Generator) -> sk.FieldFrame:
    skin = Skin(tracker.layout)
    tracker.reset()
    for share in (0.5, 1.0):
        ohm = skin.resistance_ohm(share * moved_m)
        field = tracker.update(ohm * (1 + SIGMA * rng.standard_normal(ohm.shape)))
    return field


@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 3.0, 8.0])
def test_the_force_of_a_bonded_layer_is_that_of_the_integral(ratio):
    """Depth under 1 N on a layer, from the Stokes stream function; within 12 %."""
    layer = 2e-3
    depth, _ = bonded_surface(np.zeros(1), ratio * layer, layer)
    assert bonded_force_n(RUBBER, float(depth[0]), ratio * layer, layer) == pytest.approx(1.0, rel=0.12)


def test_a_thick_layer_is_a_half_space():
    """Hertz: F = 4/3 E* a δ."""
    depth, out = bonded_surface(np.zeros(1), 2e-3, 1.0)
    assert depth[0] == pytest.approx(0.75 / (RUBBER.contact_modulus_pa * 2e-3), rel=0.01)
    assert abs(out[0]) < 1e-3 * depth[0]
    assert stiffening(2e-3, 1.0) == pytest.approx(1.0, abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize("method", ["exact", "posterior"])
@pytest.mark.parametrize("layer_mm", some_long([2, 4, 8, 16], 4))
def test_five_deviations_reach_the_force_of_a_bonded_layer(layer_mm, method):
    """Contacts of 0.4 to 2.5 pitches; the half-space's force is down to a tenth of the true one."""
    layout = sk.PatchLayout.preset("staggered")
    tracker = sk.Tracker(layout, method=method, relative_noise=SIGMA)
    for seed in range(4):
        rng = np.random.default_rng([seed, layer_mm])
        load = bonded(
            layout, inside(layout, rng), rng.uniform(0.4, 2.5) * layout.pitch_m, 1e-3 * layer_mm,
            rng.uniform(0.08, 0.3) * layout.height_m,
        )  # fmt: skip
        field = last_field(tracker, load.moved_m, rng)
        (contact,) = field.contacts
        assert not contact.force_calibrated
        assert abs(contact.normal_force_n - load.force_n[0]) < 5 * contact.normal_force_std_n
        assert (np.abs(contact.centroid_m[:2] - load.centre_m[0]) < 5 * contact.centroid_std_m[:2]).all()
        assert contact.normal_force_std_n < 5 * load.force_n[0]  # nor is it said that nothing is known


@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_calibrated_forces_have_the_deviation_of_noise(method):
    layout = sk.PatchLayout.preset("staggered")
    load = spheres(layout, Press((0.018, 0.0165), 0.016, 6e-4))
    fields = [
        last_field(
            sk.Tracker(layout, method=method, relative_noise=SIGMA, force_calibrated=calibrated),
            load.moved_m, np.random.default_rng(1),
        )
        for calibrated in (False, True)
    ]  # fmt: skip
    (bound,), (known,) = fields[0].contacts, fields[1].contacts
    assert (bound.force_calibrated, known.force_calibrated) == (False, True)
    assert known.normal_force_n == bound.normal_force_n
    assert known.normal_force_std_n < 0.15 * known.normal_force_n
    found_n = bonded_force_n(RUBBER, 5e-4, math.sqrt(bound.area_m2 / math.pi), layout.height_m)
    assert bound.normal_force_n + 5 * bound.normal_force_std_n > found_n > known.normal_force_n
    np.testing.assert_array_equal(bound.centroid_m, known.centroid_m)
    np.testing.assert_array_equal(fields[0].displacement_m, fields[1].displacement_m)
