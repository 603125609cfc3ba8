"""Converts patch and link poses to ``tf2_msgs/TFMessage``."""

from __future__ import annotations

from typing import Any, Final

from skinnode.host.skeleton import Skeleton
from skinnode.messages.topics import patch_frame
from skinnode.messages.typestore import header, message_type
from skinnode.model.hand_contact import HAND
from skinnode.model.pose import Pose

TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"


def transforms(skeleton: Skeleton, t_ns: int) -> Any:
    """Return all patch poses on their links, and all link poses in the hand.

    Args:
        skeleton: Patch and link poses.
        t_ns: Unix time, in ns.
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
