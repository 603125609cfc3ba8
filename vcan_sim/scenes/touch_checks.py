"""Checks a touch against its patch: depth or force, position, and distance from other touches.

Checks that do not require a patch (keys, times, bodies) are in :mod:`vcan_sim.scenes.tables`.
"""

from __future__ import annotations

import bisect
from typing import Final

import numpy as np

from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from vcan_sim.contact.layer import Layer
from vcan_sim.scenes.motions import Pose, highest_level, pose_at, yaws_rad
from vcan_sim.scenes.shapes import Float
from vcan_sim.scenes.tables import KEY_OF_TRAVEL, SceneConfig, TouchConfig
from vcan_sim.scenes.window import FRICTION_MARGIN, MARGIN, BodyKey, TooMuch, Window, window_of

DEEPEST: Final = 0.9
"""Maximum depth of a body, relative to the layer thickness or the electrode height, whichever is smaller."""
APART: Final = 3.0
"""Minimum gap between simultaneous contacts on a patch, as a multiple of the layer thickness or of the larger
contact's half width, whichever is smaller. Contacts are computed independently of each other. For a sphere of
radius 40 mm on an incompressible layer 2 mm thick, the displacement neglected at this gap is at most 3 % of
the depth."""


def window_of_touch(
    scene: SceneConfig, number: int, touch: TouchConfig, layer: Layer, layout: PatchLayout
) -> Window:
    """Return the window of a touch. Raises ConfigError if the touch is too deep for the layer."""
    most = DEEPEST * min(layer.thickness_m, layout.height_m)
    level, key = highest_level(touch), "force_n" if touch.by_force else "depth_m"
    path = f"touches[{number}].{key}"
    for j, motion in enumerate(touch.motions):
        if motion.kind == "press" and getattr(motion, key) == level != getattr(touch, key):
            path = f"touches[{number}].motions[{j}].{key}"
    if not touch.by_force and level > most:
        allowed = (
            f"at most {most:.3g} m, nine tenths of the layer thickness or electrode height on {touch.patch!r}"
        )
        raise error_at(scene, path, level, allowed)
    body = scene.body(touch.body)
    shape, margin = BodyKey(body.build()), MARGIN + FRICTION_MARGIN * body.friction
    try:
        return window_of(layer, shape, yaws_rad(touch), level, touch.by_force, most, scene.cells, margin)
    except TooMuch as error:
        allowed = f"at most {error.most_n:.3g} N, the force at a depth of {most:.3g} m"
        raise error_at(scene, path, level, allowed) from None


def path_of(touch: TouchConfig, step_s: float) -> dict[int, Pose]:
    """Return the poses of the body during a touch and its repetitions, by time step number.

    While the body is at rest, all time steps have the same pose, so a long touch is cheap to check.
    """
    path = {}
    for each in touch.each:
        changes = [(each.from_s, each.from_s + each.ramp_s), (each.to_s - each.ramp_s, each.to_s)]
        changes += [(motion.from_s, motion.to_s) for motion in each.motions]
        edges = sorted({edge for change in changes for edge in change})
        resting: dict[int, Pose] = {}
        for number in range(int(each.from_s / step_s), int(each.to_s / step_s) + 2):
            t_s = number * step_s
            interval = bisect.bisect(edges, t_s)
            pose = resting.get(interval)
            if pose is None:
                pose = pose_at(each, t_s)
                if not any(from_s <= t_s < to_s for from_s, to_s in changes):
                    resting[interval] = pose
            path[number] = pose
    return path


def check_on_patch(  # noqa: PLR0913 - all inputs of the check
    scene: SceneConfig,
    number: int,
    touch: TouchConfig,
    window: Window,
    path: dict[int, Pose],
    places_m: Float,
    pitch_m: float,
) -> None:
    """Raise ConfigError if a contact extends more than half a pitch beyond the outermost electrodes."""
    half = np.array(window.half_m)
    low = places_m.min(axis=0) - 0.5 * pitch_m + half
    high = places_m.max(axis=0) + 0.5 * pitch_m - half
    if (low > high).any():
        size = 2e3 * half
        allowed = f"a contact that fits on {touch.patch!r}; this contact is {size[0]:.3g} × {size[1]:.3g} mm"
        raise error_at(scene, f"touches[{number}].body", touch.body, allowed)
    room = (
        f"x from {low[0]:.4g} to {high[0]:.4g}, y from {low[1]:.4g} to {high[1]:.4g} m on {touch.patch!r}, "
        "so that the contact stays on the patch"
    )
    (low_x, low_y), (high_x, high_y) = (low - 1e-9).tolist(), (high + 1e-9).tolist()
    for step, pose in path.items():
        place = x, y = pose.place_m
        if low_x <= x <= high_x and low_y <= y <= high_y:
            continue
        key, got = f"touches[{number}].at_m", list(touch.at_m)
        t = step * scene.step_s
        for j, motion in enumerate(touch.motions):
            name = KEY_OF_TRAVEL.get(motion.kind)
            if name and motion.from_s < t:
                key, got = f"touches[{number}].motions[{j}].{name}", getattr(motion, name)
        shown = list(got) if isinstance(got, tuple) else got
        where = (
            "" if key.endswith("at_m") else f"; at {t:.3g} s the body is at [{place[0]:.4g}, {place[1]:.4g}]"
        )
        raise error_at(scene, key, shown, room + where)


def check_apart(
    scene: SceneConfig,
    late: tuple[int, TouchConfig, Window, dict[int, Pose]],
    early: tuple[int, TouchConfig, Window, dict[int, Pose]],
    layer: Layer,
) -> None:
    """Raise ConfigError if simultaneous contacts on a patch are closer than ``APART`` allows."""
    (i, touch, window, path), (j, _, other_window, other_path) = late, early
    both = np.array(window.half_m) + np.array(other_window.half_m)
    gap = APART * min(layer.thickness_m, max(*window.half_m, *other_window.half_m))
    for number in sorted(path.keys() & other_path.keys()):
        pose, other = path[number], other_path[number]
        if not (pose.level > 0.0 and other.level > 0.0):
            continue
        beyond = np.maximum(np.abs(np.subtract(pose.place_m, other.place_m)) - both, 0.0)
        if float(np.hypot(*beyond)) >= gap:
            continue
        allowed = (
            f"a position at least {1e3 * gap:.3g} mm from the contact of touches[{j}], or another time; "
            f"at {number * scene.step_s:.3g} s, the distance is {1e3 * float(np.hypot(*beyond)):.3g} mm"
        )
        raise error_at(scene, f"touches[{i}].at_m", list(touch.at_m), allowed)


def error_at(scene: SceneConfig, key: str, got: object, allowed: str) -> ConfigError:
    """Return a ConfigError that gives the file, line and column of an invalid value in a scene."""
    return ConfigError(key, got, allowed, where=scene.where(key))
