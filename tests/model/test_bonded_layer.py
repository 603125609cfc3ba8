"""Bonded layer against the simulator's own formulas, an incompressible volume, and the half-space."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skinnode.model.bonded_layer import bonded_layer_compliance
from skinnode.model.elastic import Rubber, rectangle_compliance
from vcan_sim.contact.layer import Layer, cell_response

RUBBER = Rubber()
CELL_M = 4e-3
RADIUS_M = CELL_M / math.sqrt(math.pi)
"""Radius of a disc as large as a cell."""


@pytest.mark.parametrize("thickness_m", [1e-3, 2e-3, 8e-3])
def test_as_the_simulator_says_which_shares_no_code(thickness_m: float) -> None:
    distance_m = np.array([0.0, 2.0, 3.0, 4.0]) * CELL_M
    parts = 15  # odd: a point at the corner of a cell has no closed form
    steps_m = (np.arange(parts) + 0.5) * CELL_M / parts - 0.5 * CELL_M
    centres_m = np.stack(np.meshgrid(steps_m, steps_m), axis=-1).reshape(-1, 2)
    places_m = np.stack([distance_m, 0.0 * distance_m], axis=-1)[:, None] - centres_m
    layer = Layer(thickness_m, RUBBER.young_pa, 0.5)
    theirs = (cell_response(layer, places_m, CELL_M / parts, 0.03) / (CELL_M / parts) ** 2).mean(axis=1)
    normal, outwards = bonded_layer_compliance(RUBBER, thickness_m, distance_m, RADIUS_M)
    close = 0.02 * normal[0]  # a disc is not a square
    np.testing.assert_allclose(normal, theirs[:, 2, 2], atol=close)
    np.testing.assert_allclose(-outwards, theirs[:, 0, 2], atol=close)


def test_a_press_pushes_the_rubber_next_to_it_outwards_and_up() -> None:
    normal, outwards = bonded_layer_compliance(RUBBER, 2e-3, np.array([0.0, CELL_M]), RADIUS_M)
    assert outwards[0] == 0.0
    assert outwards[1] > 0.2 * normal[0]
    assert normal[1] < -0.1 * normal[0]


@pytest.mark.long
def test_the_volume_stays() -> None:
    r = np.linspace(0.0, 40e-3, 4001)
    normal, _ = bonded_layer_compliance(RUBBER, 2e-3, r, RADIUS_M)
    volume = np.trapezoid(2.0 * math.pi * r * normal, r)
    pressed = np.trapezoid(2.0 * math.pi * r * np.maximum(normal, 0.0), r)
    assert abs(volume) < 1e-3 * pressed


def test_a_thick_layer_is_a_half_space() -> None:
    distance_m = np.array([0.0, 1.0, 2.0]) * CELL_M
    places_m = np.stack([distance_m, 0.0 * distance_m], axis=-1)
    half_space = rectangle_compliance(RUBBER, places_m, (CELL_M, CELL_M)) / CELL_M**2
    normal, outwards = bonded_layer_compliance(RUBBER, 4.0, distance_m, RADIUS_M)
    np.testing.assert_allclose(normal, half_space[:, 2, 2], rtol=0.02)
    assert np.abs(outwards).max() < 1e-3 * normal[0]


def test_bad_sizes() -> None:
    for thickness_m, radius_m in ((0.0, 1e-3), (math.inf, 1e-3), (1e-3, -1.0), (1e-3, math.nan)):
        with pytest.raises(ValueError, match="must be positive and finite"):
            bonded_layer_compliance(RUBBER, thickness_m, np.zeros(1), radius_m)
