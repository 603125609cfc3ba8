"""``[simulation]``: the scene that ``vcan-sim`` simulates."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from skinnode.config.table import Allowed, Length, Ratio, Table

_Speed = Annotated[
    float, Field(ge=1e-6, le=10.0, allow_inf_nan=False), Allowed("a number from 1e-6 to 10 (m/s)")
]
_Cycle = Annotated[
    float, Field(ge=0.1, le=3600.0, allow_inf_nan=False), Allowed("a number from 0.1 to 3600 (s)")
]


class SimulationConfig(Table):
    """Scene that ``vcan-sim`` simulates on each patch: an indenter presses, slides and lifts off repeatedly.

    The host ignores this table.
    """

    seed: Annotated[int, Field(ge=0), Allowed("a non-negative integer")] = 1
    """Random seed for the converter noise and the indenter positions."""
    indenter_radius_m: Length = 0.04
    """Radius of the spherical indenter, in metres."""
    depth: Ratio = 0.1
    """Maximum indentation, as a fraction of the height of the upper electrodes. If 0, nothing touches the
    hand."""
    shear_ratio: Annotated[float, Field(ge=0, le=2, allow_inf_nan=False), Allowed("a number from 0 to 2")] = (
        0.3
    )
    """Coefficient of friction: ratio of tangential to normal load while sliding."""
    slide_speed_m_per_s: _Speed = 0.008
    """Sliding speed of the indenter, in metres per second."""
    cycle_s: _Cycle = 4.0
    """Duration of one cycle (pressing, sliding and lifting off), in seconds."""
    converter_noise: Ratio = 3e-6
    """Standard deviation of the simulated converter's noise, relative to the resistance."""
