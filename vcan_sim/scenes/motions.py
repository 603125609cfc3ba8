"""Motion of a body during a touch, as a pure function of scene time."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from vcan_sim.scenes.tables import MotionConfig, TouchConfig
from vcan_sim.smooth import ease, glide

_EVERY_S = 0.5
"""Default interval between the targets of a random walk, in s."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a body at one instant.

    Attributes:
        place_m: Position (x, y) of the lowest point of the body in the patch frame, in metres.
        slid_m: Displacement (x, y) of the body along the skin since the touch began, excluding rolling,
            metres.
        yaw_rad: Rotation about z, rad.
        level: Depth (m) of a depth-controlled touch, or normal force (N) of a force-controlled touch; 0 if
            there is no contact.
    """

    place_m: tuple[float, float]
    slid_m: tuple[float, float]
    yaw_rad: float
    level: float


def pose_at(touch: TouchConfig, t_s: float) -> Pose:
    """Return the pose of the body at a given scene time.

    Args:
        touch: Touch that the body performs.
        t_s: Scene time, in s.
    """
    x, y = touch.at_m
    slid_x = slid_y = 0.0
    yaw = touch.yaw_rad
    level = touch.force_n if touch.force_n is not None else touch.depth_m or 0.0
    for motion in touch.motions:
        share = (t_s - motion.from_s) / (motion.to_s - motion.from_s)
        if motion.kind == "turn":
            yaw += (motion.by_rad or 0.0) * ease(share)
        elif motion.kind == "press":
            target = motion.force_n if touch.by_force else motion.depth_m
            level += ((target or 0.0) - level) * ease(share)
        else:
            way_x, way_y = _way_m(motion, share, t_s)
            x, y = x + way_x, y + way_y
            if motion.kind != "roll":
                slid_x, slid_y = slid_x + way_x, slid_y + way_y
    down = ease((t_s - touch.from_s) / touch.ramp_s)
    lifted = ease((t_s - (touch.to_s - touch.ramp_s)) / touch.ramp_s)
    return Pose((x, y), (slid_x, slid_y), yaw, level * down * (1.0 - lifted))


def highest_level(touch: TouchConfig) -> float:
    """Return the maximum of a touch's controlled quantity: normal force (N) or depth (m)."""
    levels = [touch.force_n if touch.by_force else touch.depth_m]
    levels += [motion.force_n if touch.by_force else motion.depth_m for motion in touch.motions]
    return max(level for level in levels if level is not None)


def yaws_rad(touch: TouchConfig) -> tuple[float, ...]:
    """Return yaw angles (rad), at most 0.25 rad apart, that span the rotation during a touch."""
    turned = sum(abs(motion.by_rad or 0.0) for motion in touch.motions)
    if not turned:
        return (touch.yaw_rad,)
    return tuple(float(each) for each in touch.yaw_rad + np.linspace(-turned, turned, 2 + int(8 * turned)))


def _way_m(motion: MotionConfig, share: float, t_s: float) -> tuple[float, float]:
    """Return the displacement (x, y) in metres since a motion began."""
    if motion.kind == "walk":
        return _walked_m(motion, t_s)
    way_x, way_y = motion.by_m or (0.0, 0.0)
    out_and_back = motion.kind == "shear"
    gone = ease(2.0 * share) - ease(2.0 * share - 1.0) if out_and_back else glide(share)
    return way_x * gone, way_y * gone


def _walked_m(motion: MotionConfig, t_s: float) -> tuple[float, float]:
    """Return the displacement (x, y) in metres during a random walk.

    Between targets, the body follows a minimum-jerk profile.
    """
    targets = _targets_m(motion)
    elapsed = min(max(t_s, motion.from_s), motion.to_s) - motion.from_s
    step_s = (motion.to_s - motion.from_s) / (len(targets) - 1)
    index = min(int(elapsed / step_s), len(targets) - 2)
    share = ease(elapsed / step_s - index)
    (x0, y0), (x1, y1) = targets[index], targets[index + 1]
    return x0 + (x1 - x0) * share, y0 + (y1 - y0) * share


@functools.lru_cache(maxsize=256)
def _targets_m(motion: MotionConfig) -> tuple[tuple[float, float], ...]:
    """Return the targets (x, y) of a random walk in metres, relative to its start.

    The first target is the start itself. The other targets are distributed uniformly over a disc of radius
    ``reach_m``.
    """
    count = max(1, round((motion.to_s - motion.from_s) / (motion.every_s or _EVERY_S)))
    random = np.random.default_rng(1 if motion.seed is None else motion.seed)
    r = (motion.reach_m or 0.0) * np.sqrt(random.uniform(0.0, 1.0, count))
    angle = random.uniform(0.0, 2.0 * math.pi, count)
    return (
        (0.0, 0.0),
        *((float(x), float(y)) for x, y in zip(r * np.cos(angle), r * np.sin(angle), strict=True)),
    )
