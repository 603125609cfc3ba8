"""Poses of patches (``[patches.pose]``) and of the robot's links (``[[links]]``) in a hand file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from skinnode.config.table import Allowed, Name, Table
from skinnode.errors import ConfigError
from skinnode.model.hand_contact import HAND
from skinnode.model.pose import Pose

_Metres = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False), Allowed("a number from -10 to 10")]
_Angle = Annotated[
    float, Field(ge=-6.2832, le=6.2832, allow_inf_nan=False), Allowed("a number from -6.2832 to 6.2832")
]
_Part = Annotated[float, Field(ge=-1.001, le=1.001, allow_inf_nan=False), Allowed("a number from -1 to 1")]


class PoseConfig(Table):
    """Pose of a coordinate frame relative to its parent frame.

    In the frame of a patch, x points along the upper wires, y across them and z out of the skin.
    """

    position_m: Annotated[
        tuple[_Metres, _Metres, _Metres], Field(strict=False), Allowed("three numbers [x, y, z] in metres")
    ] = (0.0, 0.0, 0.0)
    """Origin of the frame in its parent frame, in metres."""
    quaternion_xyzw: Annotated[
        tuple[_Part, _Part, _Part, _Part] | None,
        Field(strict=False),
        Allowed("a unit quaternion [x, y, z, w]"),
    ] = None
    """Orientation as a unit quaternion, real part last."""
    rpy_rad: Annotated[
        tuple[_Angle, _Angle, _Angle] | None,
        Field(strict=False),
        Allowed("three numbers [roll, pitch, yaw] in radians"),
    ] = None
    """Roll, pitch and yaw (radians) about the fixed axes x, y and z, as in URDF."""

    @model_validator(mode="after")
    def _one_unit_orientation(self) -> PoseConfig:
        if self.quaternion_xyzw is not None and self.rpy_rad is not None:
            raise ConfigError("rpy_rad", list(self.rpy_rad), "only without quaternion_xyzw")
        try:
            self.build()
        except ValueError as error:
            got = list(self.quaternion_xyzw or ())
            raise ConfigError("quaternion_xyzw", got, f"unit length ({error})") from None
        return self

    def build(self) -> Pose:
        """Return the pose as a :class:`~skinnode.model.pose.Pose`."""
        if self.rpy_rad is not None:
            return Pose.from_rpy(self.position_m, self.rpy_rad)
        return Pose(self.position_m, self.quaternion_xyzw or (0.0, 0.0, 0.0, 1.0))


class LinkConfig(Table):
    """Robot link on which patches are mounted."""

    name: Name
    """Name of the link, used in the key ``link`` of each patch."""
    pose: PoseConfig = PoseConfig()
    """Pose of the link's coordinate frame in the hand's frame, used until the program sets another pose
    (``HandFrame.at``)."""

    @field_validator("name")
    @classmethod
    def _not_the_hand(cls, value: str) -> str:
        if value == HAND:
            raise ValueError(f"a name other than {HAND!r}, which is the frame of the hand itself")
        return value
