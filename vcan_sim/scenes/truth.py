"""Ground truth of a simulated patch at one instant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vcan_sim.scenes.shapes import Float


@dataclass(frozen=True, eq=False)
class BodyContact:
    """Contact between one body and the skin.

    Attributes:
        body: Name of the body.
        centre_m: (2,) centre of pressure in the patch frame, in metres.
        area_m2: Area of contact, m².
        depth_m: Depth of the body's lowest point below the undeformed surface, in metres.
        force_n: (3,) force (N) on the skin in the patch frame. The z component is negative because the force
            points into the skin.
        origin_m: (2,) centre of the first cell, in metres.
        cell_m: Side length of a cell, in metres.
        traction_pa: (3, X, Y) tractions on the skin (force per area) in the patch frame, in Pa. The last two
            axes run along x and y.
    """

    body: str
    centre_m: Float
    area_m2: float
    depth_m: float
    force_n: Float
    origin_m: Float
    cell_m: float
    traction_pa: Float

    @property
    def radius_m(self) -> float:
        """Radius of a circle that has the same area as the contact, in metres."""
        return math.sqrt(self.area_m2 / math.pi)

    @property
    def pressure_pa(self) -> Float:
        """Pressure (X, Y) on the skin, in Pa; positive under the body."""
        return np.asarray(-self.traction_pa[2])

    @property
    def cells_m(self) -> Float:
        """Centres (X, Y, 2) of the cells in the patch frame, in metres."""
        x, y = (np.arange(n) * self.cell_m for n in self.traction_pa.shape[1:])
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1) + self.origin_m


@dataclass(frozen=True, eq=False)
class PatchTruth:
    """Contacts and displacement of a patch at one instant.

    Attributes:
        t_s: Scene time, in s.
        displacement_m: (U, N, 3) displacement of the upper electrodes, in metres.
        contacts: Contacts, in the order of the touches in the scene.
        wrench: (6,) force on the patch (N), and moment about the origin of the patch frame (N m).
    """

    t_s: float
    displacement_m: Float
    contacts: tuple[BodyContact, ...]
    wrench: Float
