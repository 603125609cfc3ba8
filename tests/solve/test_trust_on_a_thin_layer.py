"""A sound patch whose rubber is no half-space is trusted: presses of the simulator's contact mechanics."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import skinnode as sk
from skinnode.config import parse_hand
from skinnode.model.forward import resistance_ohm
from skinnode.model.tolerances import ORDINARY
from vcan_sim.scenes import bind_scene, parse_scene

NOISE = 3e-6
BODIES: dict[str, dict[str, Any]] = {
    "ball of 5 mm": {"shape": "sphere", "radius_m": 5e-3},
    "ball of 10 mm": {"shape": "sphere", "radius_m": 10e-3},
    "ball of 20 mm": {"shape": "sphere", "radius_m": 20e-3},
    "finger": {"shape": "fingertip", "radii_m": [8e-3, 12e-3, 8e-3]},
    "punch": {"shape": "punch", "radius_m": 3e-3},
}
ON, BETWEEN = (16e-3, 16e-3), (16e-3, 18e-3)
"""Place on an electrode, and place between two electrodes."""


def press(body: str, at_m: tuple[float, float], force_n: float, thickness_m: float) -> Any:
    hand = parse_hand(
        {
            "buses": [{"name": "can0", "interface": "virtual"}],
            "patches": [{"name": "palm", "node_id": 1}],
        }
    )
    touch = {"body": "body", "patch": "palm", "at_m": at_m, "force_n": force_n, "from_s": 0.1, "to_s": 1.1}
    scene = {
        "skin": {"thickness_m": thickness_m},
        "bodies": [{"name": "body", **BODIES[body]}],
        "touches": [touch],
    }
    return bind_scene(parse_scene(scene), hand)["palm"]


PRESSES = [(ON, 2.0, 2e-3), (BETWEEN, 2.0, 2e-3), (ON, 1.0, 3e-3)]
"""Place, force in N and thickness in m."""


@pytest.mark.long
def test_presses_are_trusted_and_right() -> None:
    frames = trusted = far = total = 0
    for body, (at_m, force_n, thickness_m) in itertools.product(BODIES, PRESSES):
        scene = press(body, at_m, force_n, thickness_m)
        layout = scene.layout
        estimator = sk.Posterior(layout, relative_noise=NOISE, tolerances=ORDINARY)
        rng = np.random.default_rng(5)
        for t_s in np.arange(0.0, 0.7, 0.05):
            moved_m = scene.truth(float(t_s)).displacement_m
            noise = 1.0 + NOISE * rng.standard_normal(layout.shape)
            field = estimator.update(resistance_ohm(layout, layout.upper_m + moved_m) * noise)
            assert not field.faults, (body, at_m, t_s, field.faults)
            error_m = np.abs(field.displacement_m - moved_m)[field.wires_trusted]
            far += np.count_nonzero(error_m > 5.0 * field.displacement_std_m[field.wires_trusted])
            total += error_m.size
            frames, trusted = frames + 1, trusted + field.trusted
    assert trusted >= 0.99 * frames
    assert far <= 1e-3 * total
