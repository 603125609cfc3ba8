"""Rules of root selection: the table of thresholds, and each rule at its limit."""

from __future__ import annotations

import re

import numpy as np
import pytest

import skinnode as sk
from skinnode.solve import roots


def test_the_table_names_every_threshold_with_its_value():
    rows = re.findall(r"^([A-Z][A-Z_0-9]+) +([0-9.e-]+) ", roots.__doc__, re.MULTILINE)
    table = {name: float(value) for name, value in rows}
    constants = {
        name: value
        for name, value in vars(roots).items()
        if name.isupper() and isinstance(value, (int, float)) and not name.startswith("_")
    }
    assert table == constants


@pytest.mark.parametrize(
    ("status", "branch", "far", "accepted"),
    [
        (sk.Status.CONVERGED, 1, False, True),
        (sk.Status.CONVERGED, 0, False, True),  # a tall system has no determinant
        (sk.Status.CONVERGED, -1, False, False),
        (sk.Status.CONVERGED, 1, True, False),
        (sk.Status.MAX_STEPS, 1, False, False),
    ],
)
def test_a_root_counts_on_the_branch_of_the_rest_within_reach(status, branch, far, accepted):
    found = roots.on_rest_branch(np.array([status]), np.array([branch]), np.array([1]), np.array([far]))
    assert found.tolist() == [accepted]


def test_folds_and_blind_wires_of_the_presets():
    def layout(name, height):
        return sk.PatchLayout.preset(name, height_m=height * 4e-3)

    assert not roots.folded_wires(layout("staggered", 0.5)).any()
    assert roots.folded_wires(layout("staggered", 1.0)).all()
    assert roots.blind_wires(layout("symmetric", 0.5)).any()
    assert not roots.blind_wires(layout("staggered", 0.5)).any()


def test_an_estimate_agrees_within_its_reach_on_every_coordinate():
    gap = np.array([[0.9, 1.0], [0.5, 1.1], [0.0, np.nan]])
    assert roots.agrees(gap, np.ones_like(gap)).tolist() == [True, False, False]


def test_a_rough_wire_is_checked_again_after_it_moved_by_a_fifth():
    confirmed = np.full((3, 1, 3), 1.0)
    confirmed[2] = np.inf
    now = np.array([1.2, 1.3, 1.0])[:, None, None] * np.ones((3, 1, 3))
    assert roots.still_confirmed(now, confirmed).tolist() == [True, False, False]
