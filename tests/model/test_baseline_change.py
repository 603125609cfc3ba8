"""A touch during a tare is distinguished from temperature, contact resistance and noise."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.model.baseline_change import touched_crossings
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout

LAYOUT = PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
REST_OHM = resistance_ohm(LAYOUT, LAYOUT.upper_m)


def drifted(seed: int) -> np.ndarray:
    """The patch, hotter and older: 20 %, and 5 % per wire; noise of 16 readings of rubber; two dead wires."""
    rng = np.random.default_rng(seed)
    ohm = REST_OHM * 1.2 * np.exp(0.05 * rng.standard_normal((10, 1)) + 0.05 * rng.standard_normal(30))
    ohm *= 1 + 2.5e-4 * rng.standard_normal(ohm.shape)
    ohm[3] = ohm[:, 7] = np.nan
    return ohm


def pressed(depth: float) -> np.ndarray:
    moved = LAYOUT.upper_m.copy()
    away = np.hypot(*np.moveaxis(moved - moved.reshape(-1, 3).mean(axis=0), 2, 0)[:2])
    moved[..., 2] -= depth * 2e-3 * np.exp(-((away / 6e-3) ** 2))
    return resistance_ohm(LAYOUT, moved)


@pytest.mark.parametrize("seed", range(20))
def test_heat_and_wires_and_noise_are_no_touch(seed: int) -> None:
    assert touched_crossings(REST_OHM, drifted(seed)) == (0, 0.0)


@pytest.mark.parametrize("depth", [0.2, 0.3, 0.5])
def test_a_press_is_seen_whether_it_began_or_ended(depth: float) -> None:
    ratio = pressed(depth) / REST_OHM
    for seed in range(5):
        began = touched_crossings(REST_OHM, drifted(seed) * ratio)
        ended = touched_crossings(drifted(seed) * ratio, REST_OHM)
        assert min(began[0], ended[0]) >= 3
        assert began[1] == pytest.approx(np.abs(ratio - 1).max(), rel=0.5)


def test_nothing_to_compare_is_no_touch() -> None:
    assert touched_crossings(np.full((2, 3), np.nan), np.ones((2, 3))) == (0, 0.0)
    assert touched_crossings(np.zeros((2, 3)), np.ones((2, 3))) == (0, 0.0)
