"""Defines the simulated hand of ``skinnode demo`` and ``skinnode monitor --simulate``."""

from __future__ import annotations

import uuid
from typing import Final

from skinnode.config import HandConfig, parse_hand

_NAMES: Final = ("palm", "thumb", "index", "middle", "ring", "little", "wrist", "back")
_PLACES: Final = {
    "palm": ((-18.0, -18.0, 0.0), (0.0, 0.0, 0.0)),
    "thumb": ((-88.0, -6.0, -10.0), (0.0, -0.75, 0.6)),
    "index": ((-66.0, 66.0, -8.0), (0.45, 0.0, 0.14)),
    "middle": ((-26.0, 74.0, -8.0), (0.45, 0.0, 0.0)),
    "ring": ((14.0, 69.0, -8.0), (0.45, 0.0, -0.14)),
    "little": ((52.0, 52.0, -8.0), (0.45, 0.0, -0.32)),
    "wrist": ((-18.0, -70.0, -4.0), (-0.25, 0.0, 0.0)),
    "back": ((18.0, -18.0, -28.0), (0.0, 3.1416, 0.0)),
}
"""Positions (mm) and roll, pitch and yaw angles (radians) of the named patches on a half-closed left hand.

The poses are fictitious; the palm faces along the z axis, and the fingers point along the y axis.
"""
_MORE_MM: Final = 50.0
"""Spacing, in mm, of the patches without a predefined name, which are placed in rows below the wrist."""
_SYNC_MS_PER_PATCH: Final = 20
"""SYNC period per patch, in ms. A scan consists of 101 frames of up to 135 bits, so the bus load is at most
68 % at 1 Mbit/s."""


def demo_hand(patches: int, seed: int) -> HandConfig:
    """Return a hand of reference patches on a virtual bus that no other program uses.

    Args:
        patches: Number of patches, 1 to 127.
        seed: Seed for the simulated touches and the converter noise.
    """
    names = [_NAMES[i] if i < len(_NAMES) else f"patch{i + 1}" for i in range(patches)]
    return parse_hand(
        {
            "name": "demo",
            "buses": [{"name": "can0", "interface": "virtual", "channel": f"demo-{uuid.uuid4().hex[:8]}"}],
            "patches": [
                {
                    "name": name,
                    "node_id": i + 1,
                    "layout": {"preset": "staggered"},
                    "tolerances": "exact",
                    "calibration": {"force_calibrated": True},
                    "pose": _pose(i, name),
                }
                for i, name in enumerate(names)
            ],
            "sync": {"period_ms": _SYNC_MS_PER_PATCH * patches},
            "simulation": {"seed": seed, "depth": 0.3},
        }
    )


def _pose(number: int, name: str) -> dict[str, list[float]]:
    """Return the pose of a patch in the format of the hand file."""
    row, column = divmod(number - len(_NAMES), 4)
    more = (_MORE_MM * (column - 2), _MORE_MM * (-2.5 - row), 0.0), (0.0, 0.0, 0.0)
    position_mm, rpy_rad = _PLACES.get(name, more)
    return {"position_m": [1e-3 * value for value in position_mm], "rpy_rad": list(rpy_rad)}
