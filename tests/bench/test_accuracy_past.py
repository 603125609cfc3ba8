"""The streams of ``skinnode bench accuracy --only past``: what happens in each phase."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.bench import accuracy_past
from skinnode.bench.case import preset
from skinnode.bench.truth import Skin


@pytest.mark.parametrize(("family", "number"), [("punch", 0), ("ridge", 1), ("two", 0)])
def test_a_press_is_held_slides_deepens_and_is_released(family, number):
    frames = accuracy_past.truth(family, Skin(preset(*accuracy_past.LAYOUT)), number)
    phases = {name: [moved for of, moved in frames if of == name] for name, _ in frames}
    for name in accuracy_past.UNTOUCHED:
        assert not np.any(phases[name])
    held = phases["onset"][0]
    for moved in [*phases["hold"], *phases["hold, frame 28"]]:
        np.testing.assert_array_equal(moved, held)
    slide = [np.linalg.norm(moved - held) for moved in phases["slide"]]
    assert (np.diff(slide) > 0.0).all()
    depths = [-moved[..., 2].min() for moved in phases["creep"]]
    assert depths[-1] / depths[0] > 1.05
    assert depths[1] - depths[0] > 3.0 * (depths[-1] - depths[-2])  # creep slows down
    release = [np.abs(moved).max() for moved in phases["slow release"]]
    assert (np.diff(release) < 0.0).all()
    assert release[-1] < 0.4 * release[0]


def test_a_frame_counts_the_coordinates_within_and_far_beyond_its_claim():
    class Field:
        displacement_m = np.array([[[0.0, 0.0, -1.0], [0.0, 0.05, 0.0]]])
        displacement_std_m = np.full((1, 2, 3), 0.02)
        half_width_95_m = np.full((1, 2, 3), 0.03)
        contacts = ()
        trusted = True

    truth = np.array([[[0.0, 0.0, -1.2], [0.0, 0.06, 0.0]]])
    found = accuracy_past.Sum()
    found.add(Field(), truth, 2e-3)  # the depth is wrong by ten deviations, the shear by half of one
    row = found.row()
    assert row["coverage_moved"] == 0.0
    assert row["coverage_rest"] == 1.0
    assert row["far"] == pytest.approx(1 / 6)
    assert row["worst"] == pytest.approx(10.0)
    assert row["ms"] == pytest.approx(2.0)
