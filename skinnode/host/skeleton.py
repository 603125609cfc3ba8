"""Define where the patches are on their links, and where the links are in the hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from skinnode.config import HandConfig
from skinnode.model.hand_contact import HAND, Mount
from skinnode.model.pose import Pose


@dataclass(frozen=True, slots=True)
class Skeleton:
    """Poses of the patches on their links, and of the links in the hand's coordinate frame."""

    mounts: Mapping[str, Mount] = field(default_factory=dict)
    """Link and pose of each patch, by patch name. A patch without an entry shares the hand's frame."""
    link_poses: Mapping[str, Pose] = field(default_factory=dict)
    """Pose of each link in the hand, by link name. A link without an entry shares the hand's frame."""

    @classmethod
    def of(cls, hand: HandConfig) -> Skeleton:
        """Return the poses defined in a hand file."""
        mounts = {each.name: Mount(each.link or HAND, each.pose.build()) for each in hand.patches}
        return cls(mounts, {link.name: link.pose.build() for link in hand.links})

    def mount(self, patch: str) -> Mount:
        """Return a patch's link, and the pose of the patch on that link."""
        return self.mounts.get(patch, Mount())

    def link_pose(self, link: str) -> Pose:
        """Return the pose of a link in the hand's coordinate frame."""
        return self.link_poses.get(link, Pose())
