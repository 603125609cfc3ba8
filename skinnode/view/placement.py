"""Places the patches in the picture, at their poses from the hand file or, without poses, side by side."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.config import HandConfig
from skinnode.host.skeleton import Skeleton
from skinnode.model.hand_contact import Mount
from skinnode.model.layout import PatchLayout
from skinnode.model.pose import Pose

ROOT: Final = "skin"
"""Parent entity of the links and patches; its coordinate frame is the hand's."""
_GAP: Final = 1.4
"""Centre-to-centre distance of patches drawn side by side, as a multiple of the largest patch's width."""
_SAME_M: Final = 1e-6
"""Maximum distance at which two patches count as being in the same place, in m."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Positions at which the patches are drawn."""

    skeleton: Skeleton
    """Patch poses on their links, and link poses in the hand."""
    side_by_side: bool
    """Whether the patches are drawn side by side, because the hand file puts several patches in the same
    place."""

    def path(self, patch: str) -> list[str]:
        """Return the parts of a patch's entity path: ``skin``, the link's name and the patch's name."""
        return [ROOT, self.skeleton.mount(patch).link, patch]


def placement_of(hand: HandConfig, layouts: Mapping[str, PatchLayout]) -> Placement:
    """Return the positions at which a hand's patches are drawn.

    Args:
        hand: The hand.
        layouts: Layout of each patch, by name.
    """
    skeleton = Skeleton.of(hand)
    places = []
    for name in layouts:
        mount = skeleton.mount(name)
        places.append(np.array((skeleton.link_pose(mount.link) @ mount.pose).position_m))
    if all(np.linalg.norm(one - other) > _SAME_M for one, other in itertools.combinations(places, 2)):
        return Placement(skeleton, side_by_side=False)
    return Placement(Skeleton(_rows(layouts)), side_by_side=True)


def _rows(layouts: Mapping[str, PatchLayout]) -> dict[str, Mount]:
    """Return a mount for each patch, in rows from left to right and from top to bottom."""
    spans = {name: np.ptp(each.upper_m.reshape(-1, 3), axis=0) for name, each in layouts.items()}
    width, height = (
        _GAP * max(float(span[axis]) + layouts[name].pitch_m for name, span in spans.items())
        for axis in (0, 1)
    )
    columns = math.ceil(math.sqrt(len(layouts)))
    found = {}
    for number, (name, layout) in enumerate(layouts.items()):
        row, column = divmod(number, columns)
        middle = layout.upper_m.reshape(-1, 3).mean(axis=0)
        x, y, z = column * width - middle[0], -row * height - middle[1], -middle[2]
        found[name] = Mount(pose=Pose((float(x), float(y), float(z))))
    return found
