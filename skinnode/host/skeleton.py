"""Define where the patches are on their links, and where the links are in the hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from skinnode.config import HandConfig
from skinnode.model.hand_contact import HAND, Mount
from skinnode.model.pose import Pose


@dataclass(frozen=True, slots=True)
class Skeleton:
    """Poses of the patches on their links, and of the links in the coordinate frame of the hand."""

    mounts: Mapping[str, Mount] = field(default_factory=dict)
    """Link and pose of each patch, by patch name. Without an entry, the frame of the patch is that of the
    hand.
    """
    link_poses: Mapping[str, Pose] = field(default_factory=dict)
    """Pose of each link in the hand, by link name. Without an entry, the frame of the link is that of the
    hand.
    """

    @classmethod
    def of(cls, hand: HandConfig) -> Skeleton:
        """Return the poses defined in a hand file."""
        mounts = {each.name: Mount(each.link or HAND, each.pose.build()) for each in hand.patches}
        return cls(mounts, {link.name: link.pose.build() for link in hand.links})

    def mount(self, patch: str) -> Mount:
        """Return the link of a patch, and the pose of the patch on it."""
        return self.mounts.get(patch, Mount())

    def link_pose(self, link: str) -> Pose:
        """Return the pose of a link in the coordinate frame of the hand."""
        return self.link_poses.get(link, Pose())
