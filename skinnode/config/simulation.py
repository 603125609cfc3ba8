"""``[simulation]``: what ``vcan-sim`` plays."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from skinnode.config.table import Allowed, Length, Ratio, Table

_Speed = Annotated[
    float, Field(ge=1e-6, le=10.0, allow_inf_nan=False), Allowed("a number of m/s from 1e-6 to 10")
]
_Cycle = Annotated[
    float, Field(ge=0.1, le=3600.0, allow_inf_nan=False), Allowed("a number of seconds from 0.1 to 3600")
]


class SimulationConfig(Table):
    """The scene ``vcan-sim`` plays on simulated patches: press, slide, lift, again. The host ignores it."""

    seed: Annotated[int, Field(ge=0), Allowed("an integer of at least 0")] = 1
    """Of the noise and of where each indenter presses."""
    indenter_radius_m: Length = 0.04
    """Radius of the sphere that presses."""
    depth: Ratio = 0.1
    """Deepest indentation as a share of the height of the upper layer; 0: nothing touches the hand."""
    shear_ratio: Annotated[float, Field(ge=0, le=2, allow_inf_nan=False), Allowed("a number from 0 to 2")] = (
        0.3
    )
    """Tangential over normal load while sliding, the coefficient of friction."""
    slide_speed_m_per_s: _Speed = 0.008
    """How fast it slides."""
    cycle_s: _Cycle = 4.0
    """Time of one press, slide and lift."""
    converter_noise: Ratio = 3e-6
    """Standard deviation of the noise of the simulated converter, relative to the resistance."""
