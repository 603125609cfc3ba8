"""Fields of known displacement, a small hand in virtual time, and the switch for tests that need the SDK."""

from __future__ import annotations

import os
import uuid
from importlib.util import find_spec

import numpy as np
import pytest

from skinnode.config import HandConfig, parse_hand
from skinnode.model.frames import Contact, FieldFrame, ScanStamp, SolveStats
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status

REQUIRE_VIEW = "SKINNODE_REQUIRE_VIEW"
"""Environment variable that turns a missing package rerun-sdk from a skip into a failure."""
LAYOUT = PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}


@pytest.fixture
def sdk() -> None:
    """Skip the test without the package rerun-sdk, unless it is required."""
    if find_spec("rerun") is None:
        if os.environ.get(REQUIRE_VIEW):
            pytest.fail("the package rerun-sdk is required, but missing")
        pytest.skip("needs the package rerun-sdk (sh install.sh view)")


def a_hand(interface: str = "timed", patches: int = 2, **tables: object) -> HandConfig:
    """Patches p0, p1 … of 4 × 4 electrodes with node-IDs from 5 on, one above the other, on one bus."""
    listed = [
        {
            "name": f"p{i}",
            "node_id": 5 + i,
            "layout": SMALL,
            "tolerances": "exact",
            "pose": {"position_m": [0.0, 0.0, 0.1 * i], "rpy_rad": [0.0, 0.3 * i, 0.0]},
        }
        for i in range(patches)
    ]
    bus = {"name": "can0", "interface": interface, "channel": uuid.uuid4().hex[:8]}
    return parse_hand(
        {
            "buses": [bus],
            "patches": listed,
            "sync": {"period_ms": 25},
            "solver": {"method": "posterior"},
            "simulation": {"seed": 2, "depth": 0.3, "cycle_s": 1.0},
            **tables,
        }
    )


def a_contact(
    normal_n: float = 2.0, shear_n: tuple[float, float] = (0.3, -0.4), **changes: object
) -> Contact:
    values = {
        "centroid_m": np.array([0.016, 0.012, 2e-3]),
        "centroid_std_m": np.array([1e-4, 2e-4, 0.0]),
        "area_m2": 3e-5,
        "area_std_m2": 1e-6,
        "normal_force_n": normal_n,
        "normal_force_std_n": 0.05,
        "shear_force_n": np.array(shear_n),
        "shear_force_std_n": np.array([0.02, 0.03]),
    }
    return Contact(**{**values, **changes})  # type: ignore[arg-type]


def a_field(
    displacement_m: Float, std_m: Float | float = 1e-6, contacts: tuple[Contact, ...] = (), patch: str = "p0"
) -> FieldFrame:
    wires = len(displacement_m)
    return FieldFrame(
        displacement_m=displacement_m,
        displacement_std_m=np.broadcast_to(np.asarray(std_m), displacement_m.shape).copy(),
        status=(Status.CONVERGED,) * wires,
        residual=np.zeros(wires),
        stats=SolveStats(0, 0, 0, 0.0),
        contacts=contacts,
        stamp=ScanStamp(patch, 7, 7, 0, 5_000_000_000, 5_010_000_000, 5_011_000_000),
    )
