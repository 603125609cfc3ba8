"""Converts the poses of patches and links to ``tf2_msgs/TFMessage``."""

from __future__ import annotations

from typing import Any, Final

from skinnode.host.skeleton import Skeleton
from skinnode.messages.topics import patch_frame
from skinnode.messages.typestore import header, message_type
from skinnode.model.hand_contact import HAND
from skinnode.model.pose import Pose

TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"


def transforms(skeleton: Skeleton, t_ns: int) -> Any:
    """Return the poses of all patches on their links, and of all links in the hand.

    Args:
        skeleton: The poses.
        t_ns: Time since 1970, ns.
    """
    poses = [_transform(HAND, link, pose, t_ns) for link, pose in skeleton.link_poses.items() if link != HAND]
    poses += [
        _transform(mount.link, patch_frame(patch), mount.pose, t_ns)
        for patch, mount in skeleton.mounts.items()
    ]
    return message_type(TRANSFORMS)(poses)


def _transform(parent: str, child: str, pose: Pose, t_ns: int) -> Any:
    vector, quaternion, transform, stamped = (
        message_type(f"geometry_msgs/msg/{name}")
        for name in ("Vector3", "Quaternion", "Transform", "TransformStamped")
    )
    placed = transform(vector(*pose.position_m), quaternion(*pose.quaternion_xyzw))
    return stamped(header(t_ns, parent), child, placed)
