"""The patch of the exact tracker's tests, and a stream of its frames."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk

from .press import frame_ohm, hertz_press


@pytest.fixture(scope="module")
def staggered() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)


@pytest.fixture(scope="module")
def rest(staggered: sk.PatchLayout) -> np.ndarray:
    return frame_ohm(staggered, np.zeros_like(staggered.upper_m))


@pytest.fixture(scope="module")
def stream(staggered: sk.PatchLayout) -> list[tuple[np.ndarray, np.ndarray]]:
    """(displacement, frame) of two presses at different places, with release, without noise."""
    scenes = []
    for centre in ((18.3e-3, 17.1e-3), (9.1e-3, 30.4e-3)):
        for t in range(24):
            depth = 0.12 * np.sin(np.pi * t / 23) ** 2
            moved = hertz_press(staggered, depth if depth > 1e-12 else 0.0, centre_m=centre)
            scenes.append((moved, frame_ohm(staggered, moved)))
    return scenes
