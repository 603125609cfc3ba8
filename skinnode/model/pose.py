"""Poses of coordinate frames, and conversion of points and vectors between frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout

UNIT_TOLERANCE: Final = 1e-3
"""Maximum deviation of a quaternion's length from 1, large enough to accept rounded input."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and orientation of a coordinate frame, such as a patch's, relative to its parent frame.

    In the frame of a patch, x points along the upper wires, y across them, and z out of the skin.

    Args:
        position_m: Origin of the frame in the parent frame, in metres.
        quaternion_xyzw: Orientation of the frame as a unit quaternion, real part last.

    Raises:
        ValueError: If a number is not finite, or the quaternion does not have unit length.
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if not all(math.isfinite(part) for part in (*self.position_m, *self.quaternion_xyzw)):
            raise ValueError(f"pose: got {self.position_m}, {self.quaternion_xyzw}, must be finite")
        length = math.hypot(*self.quaternion_xyzw)
        if abs(length - 1) > UNIT_TOLERANCE:
            raise ValueError(f"quaternion_xyzw: got length {length:.4g}, must be 1")

    @classmethod
    def from_rpy(cls, position_m: tuple[float, float, float], rpy_rad: tuple[float, float, float]) -> Self:
        """Return a pose from roll, pitch and yaw, as in URDF.

        Args:
            position_m: Origin of the frame in the parent frame, in metres.
            rpy_rad: Rotations in radians about the fixed axes x (roll), y (pitch) and z (yaw) of the parent
                frame, applied in that order.
        """
        (sr, sp, sy), (cr, cp, cy) = (
            tuple(function(angle / 2) for angle in rpy_rad) for function in (math.sin, math.cos)
        )
        return cls(
            position_m,
            (
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
                cr * cp * cy + sr * sp * sy,
            ),
        )

    @property
    def rotation(self) -> Float:
        """(3, 3) rotation matrix that converts vectors from this frame to the parent frame."""
        x, y, z, w = self._unit()
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    def vectors(self, inner: ArrayLike) -> Float:
        """Convert (..., 3) vectors, such as displacements or forces, from this frame to the parent frame."""
        turned: Float = np.asarray(inner, np.float64) @ self.rotation.T
        return turned

    def points_m(self, inner_m: ArrayLike) -> Float:
        """Convert (..., 3) points, in metres, from this frame to the parent frame."""
        points: Float = self.vectors(inner_m) + np.array(self.position_m)
        return points

    def __matmul__(self, inner: Pose) -> Pose:
        """Convert the pose ``inner`` from this frame to the parent frame."""
        x, y, z, w = self._unit()
        a, b, c, d = inner._unit()
        x_m, y_m, z_m = self.points_m(inner.position_m).tolist()
        return Pose(
            (x_m, y_m, z_m),
            (
                w * a + x * d + y * c - z * b,
                w * b - x * c + y * d + z * a,
                w * c + x * b - y * a + z * d,
                w * d - x * a - y * b - z * c,
            ),
        )

    def inverse(self) -> Pose:
        """Return the pose of the parent frame in this frame."""
        x, y, z, w = self._unit()
        back = Pose((0.0, 0.0, 0.0), (-x, -y, -z, w))
        x_m, y_m, z_m = (-back.vectors(self.position_m)).tolist()
        return Pose((x_m, y_m, z_m), back.quaternion_xyzw)

    def _unit(self) -> tuple[float, float, float, float]:
        """Return the quaternion scaled to unit length, so that rounding errors do not accumulate."""
        length = math.hypot(*self.quaternion_xyzw)
        x, y, z, w = self.quaternion_xyzw
        return x / length, y / length, z / length, w / length


def positions_in_hand_m(field: FieldFrame, layout: PatchLayout, pose: Pose) -> Float:
    """Return the (U, N, 3) positions of the upper electrodes in the hand's frame, in metres.

    ``pose`` is the pose of the patch's frame in the hand's frame.
    """
    return pose.points_m(layout.upper_m + field.displacement_m)
