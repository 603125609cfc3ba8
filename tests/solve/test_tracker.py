"""The tracker everyone uses: what it passes on."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.solve.exact import ExactTracker

from .press import frame_ohm, hertz_press


@pytest.fixture(scope="module")
def layout() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4, lower_electrodes=4)


def test_exact_method_is_the_exact_tracker(layout):
    noise = np.random.default_rng(3).uniform(1e-6, 1e-4, layout.shape)
    baseline = 1.1 * frame_ohm(layout, np.zeros_like(layout.upper_m))
    options = {
        "operator": "dogleg", "relative_noise": noise, "baseline_ohm": baseline, "stiffness_n_per_m": 250.0,
    }  # fmt: skip
    tracker, exact = sk.Tracker(layout, method="exact", **options), ExactTracker(layout, **options)
    assert tracker.layout is layout
    for _ in range(2):
        for depth in (0.0, 0.1, 0.2):
            frame = 1.1 * frame_ohm(layout, hertz_press(layout, depth, centre_m=(6e-3, 6e-3)))
            field = tracker.update(frame, None, 2 * noise)
            expected = exact.update(frame, None, 2 * noise)
            np.testing.assert_array_equal(field.displacement_m, expected.displacement_m)
            np.testing.assert_array_equal(field.displacement_std_m, expected.displacement_std_m)
            np.testing.assert_array_equal(field.force_n, expected.force_n)
            assert field.status == expected.status
        tracker.reset()
        exact.reset()


def test_unknown_method_is_named(layout):
    with pytest.raises(ValueError, match="method: got 'magic'"):
        sk.Tracker(layout, method="magic")
