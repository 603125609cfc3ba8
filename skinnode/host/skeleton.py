"""Places of the patches on a robot: each on its link, and each link in the frame of the hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from skinnode.config import HandConfig
from skinnode.model.hand_contact import HAND, Mount
from skinnode.model.pose import Pose


@dataclass(frozen=True, slots=True)
class Skeleton:
    """Places of a hand's patches: where each sits on its link, and where the links are."""

    mounts: Mapping[str, Mount] = field(default_factory=dict)
    """Place by patch name; a patch that is not listed is fixed to the hand, at its origin."""
    link_poses: Mapping[str, Pose] = field(default_factory=dict)
    """Pose in the hand by link name; the frame of a link that is not listed is that of the hand."""

    @classmethod
    def of(cls, hand: HandConfig) -> Skeleton:
        """Return the places that a hand file gives."""
        mounts = {each.name: Mount(each.link or HAND, each.pose.build()) for each in hand.patches}
        return cls(mounts, {link.name: link.pose.build() for link in hand.links})

    def mount(self, patch: str) -> Mount:
        """Return the place of a patch."""
        return self.mounts.get(patch, Mount())

    def link_pose(self, link: str) -> Pose:
        """Return the pose of a link in the frame of the hand."""
        return self.link_poses.get(link, Pose())
