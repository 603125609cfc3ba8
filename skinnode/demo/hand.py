"""Defines the simulated hand of ``skinnode demo`` and ``skinnode monitor --simulate``."""

from __future__ import annotations

import uuid
from typing import Final

from skinnode.config import HandConfig, parse_hand

_NAMES: Final = ("palm", "thumb", "index", "middle", "ring", "little", "wrist", "back")
_SYNC_MS_PER_PATCH: Final = 20
"""SYNC period per patch, ms. A scan consists of 101 frames of up to 135 bits, so the bus load is at most 68 %
at 1 Mbit/s."""


def demo_hand(patches: int, seed: int) -> HandConfig:
    """Return a hand of reference patches on a virtual bus that no other program uses.

    Args:
        patches: Number of patches, 1 to 127.
        seed: Seed of the simulated touches and of the converter noise.
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
                }
                for i, name in enumerate(names)
            ],
            "sync": {"period_ms": _SYNC_MS_PER_PATCH * patches},
            "simulation": {"seed": seed, "depth": 0.3},
        }
    )
