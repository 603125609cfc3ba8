"""Where a patch sits on the hand, against turns that can be done in the head and against SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.model.layout import PatchLayout
from skinnode.model.pose import Pose, positions_in_hand_m
from skinnode.model.status import Status

ANGLE = st.floats(-math.pi, math.pi)


def test_a_quarter_turn_about_z() -> None:
    pose = Pose.from_rpy((0.1, 0.2, 0.3), (0.0, 0.0, math.pi / 2))
    np.testing.assert_allclose(pose.points_m([1.0, 0.0, 0.0]), [0.1, 1.2, 0.3], atol=1e-15)
    np.testing.assert_allclose(pose.vectors([0.0, 1.0, 0.0]), [-1.0, 0.0, 0.0], atol=1e-15)


@given(ANGLE, ANGLE, ANGLE)
def test_roll_pitch_yaw_are_those_of_urdf(roll: float, pitch: float, yaw: float) -> None:
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw])  # lower case: fixed axes
    pose = Pose.from_rpy((0.0, 0.0, 0.0), (roll, pitch, yaw))
    np.testing.assert_allclose(pose.rotation, expected.as_matrix(), atol=1e-12)
    given_as = Pose((0.0, 0.0, 0.0), tuple(expected.as_quat()))
    np.testing.assert_allclose(given_as.rotation, expected.as_matrix(), atol=1e-12)


def test_a_field_in_the_frame_of_the_hand() -> None:
    layout = PatchLayout.preset("staggered")
    displacement_m = np.random.default_rng(1).normal(0, 1e-4, layout.upper_m.shape)
    field = FieldFrame(
        displacement_m,
        np.ones_like(displacement_m),
        (Status.CONVERGED,) * layout.shape[0],
        np.zeros(layout.shape[0]),
        SolveStats(0, 0, 0, 0.0),
    )
    upside_down = Pose((0.0, 0.0, 0.05), (1.0, 0.0, 0.0, 0.0))  # half a turn about x
    there_m = positions_in_hand_m(field, layout, upside_down)
    here_m = layout.upper_m + displacement_m
    np.testing.assert_allclose(there_m[..., 0], here_m[..., 0], atol=1e-15)
    np.testing.assert_allclose(there_m[..., 1], -here_m[..., 1], atol=1e-15)
    np.testing.assert_allclose(there_m[..., 2], 0.05 - here_m[..., 2], atol=1e-15)


@pytest.mark.parametrize(
    "quaternion", [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)]
)
def test_what_is_no_orientation(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="must be"):
        Pose((0.0, 0.0, 0.0), quaternion)
