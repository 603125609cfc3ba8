"""Binds a scene to a hand: checks every touch on its patch, and returns one :class:`PatchScene` per patch."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from skinnode.config import HandConfig, PatchConfig
from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from vcan_sim.contact.layer import Layer
from vcan_sim.scenes.history import History
from vcan_sim.scenes.motions import Pose, highest_level, pose_at, yaws_rad
from vcan_sim.scenes.patch import PatchScene
from vcan_sim.scenes.response import Electrodes
from vcan_sim.scenes.shapes import Float
from vcan_sim.scenes.tables import SceneConfig, SkinConfig, TouchConfig, read_scene
from vcan_sim.scenes.window import FRICTION_MARGIN, MARGIN, BodyKey, TooMuch, Window, window_of

DEEPEST: Final = 0.9
"""Largest depth of a body, relative to the thickness of the layer and to the height of the electrodes."""
APART: Final = 3.0
"""Least distance between the contacts of two bodies on a patch, in thicknesses of the layer or, if that is
less, in half widths of the larger contact. A contact does not feel the displacement due to the other, which
is at most 3 % of the depth there (an incompressible layer 2 mm thick under a sphere of 40 mm radius)."""


def load_scene(path: Path | str, hand: HandConfig) -> SceneConfig:
    """Read a scene file and check it with the hand whose patches it touches.

    Args:
        path: The file.
        hand: The hand.

    Raises:
        ConfigError: The file cannot be read, is not a scene, or has a touch that is impossible on its patch.
            The message is one line with file, line and column.
    """
    scene = read_scene(path)
    bind_scene(scene, hand)
    return scene


def bind_scene(scene: SceneConfig, hand: HandConfig) -> dict[str, PatchScene]:
    """Return the scene of each patch of a hand, also of patches that nothing touches.

    Args:
        scene: The scene.
        hand: The hand.

    Raises:
        ConfigError: A touch names an unknown patch, is deeper than the layer, leaves the patch, or comes too
            close to another touch.
    """
    names = [patch.name for patch in hand.patches]
    for i, touch in enumerate(scene.touches):
        if touch.patch not in names:
            raise _error(
                scene, f"touches[{i}].patch", touch.patch, f"a patch of the hand: {', '.join(names)}"
            )
    return {patch.name: _patch_scene(scene, hand, patch, i) for i, patch in enumerate(hand.patches)}


def layer_of(skin: SkinConfig, patch: PatchConfig, layout: PatchLayout) -> Layer:
    """Return the elastic layer of a patch: the values of the scene, else those of the hand file.

    Args:
        skin: Values of the scene.
        patch: The patch in the hand file.
        layout: Its layout, whose height is the default thickness.
    """
    calibration = patch.calibration
    return Layer(
        layout.height_m if skin.thickness_m is None else skin.thickness_m,
        calibration.young_pa if skin.young_pa is None else skin.young_pa,
        calibration.poisson if skin.poisson is None else skin.poisson,
    )


def _patch_scene(scene: SceneConfig, hand: HandConfig, patch: PatchConfig, number: int) -> PatchScene:
    layout = patch.layout.build()
    layer = layer_of(scene.skin, patch, layout)
    touches = [(i, touch) for i, touch in enumerate(scene.touches) if touch.patch == patch.name]
    windows = {i: _window(scene, i, touch, layer, layout) for i, touch in touches}
    places = np.ascontiguousarray(layout.upper_m[..., :2].reshape(-1, 2))
    paths = {i: _path(touch, scene.step_s) for i, touch in touches}
    for i, touch in touches:
        _check_on_patch(scene, i, touch, windows[i], paths[i], places, layout.pitch_m)
        for j, other in touches:
            if j < i:
                _check_apart(scene, (i, touch, windows[i], paths[i]), (j, other, windows[j], paths[j]), layer)
    if not touches:
        return PatchScene(layout, hand.simulation, number, scene.step_s, scene.repeat_s, ())
    electrodes = Electrodes.of(layer, places, float(np.median(layout.upper_m[..., 2])))
    histories = []
    for i, touch in touches:
        body = scene.body(touch.body)
        histories += [
            History(each, body.build(), body.friction, windows[i], scene.step_s, electrodes)
            for each in touch.each
        ]
    return PatchScene(layout, hand.simulation, number, scene.step_s, scene.repeat_s, tuple(histories))


def _window(scene: SceneConfig, number: int, touch: TouchConfig, layer: Layer, layout: PatchLayout) -> Window:
    """Return the window of a touch. Raises ConfigError if the touch is deeper than the layer."""
    most = DEEPEST * min(layer.thickness_m, layout.height_m)
    level, key = highest_level(touch), "force_n" if touch.by_force else "depth_m"
    path = f"touches[{number}].{key}"
    for j, motion in enumerate(touch.motions):
        if motion.kind == "press" and getattr(motion, key) == level != getattr(touch, key):
            path = f"touches[{number}].motions[{j}].{key}"
    if not touch.by_force and level > most:
        allowed = f"at most {most:.3g} m, nine tenths of the layer of {touch.patch!r}"
        raise _error(scene, path, level, allowed)
    body = scene.body(touch.body)
    shape, margin = BodyKey(body.build()), MARGIN + FRICTION_MARGIN * body.friction
    try:
        return window_of(layer, shape, yaws_rad(touch), level, touch.by_force, most, scene.cells, margin)
    except TooMuch as error:
        allowed = f"at most {error.most_n:.3g} N, the force at a depth of {most:.3g} m"
        raise _error(scene, path, level, allowed) from None


def _path(touch: TouchConfig, step_s: float) -> dict[int, Pose]:
    """Return the pose at each time step of a touch, each time that it is made."""
    return {
        number: pose_at(each, number * step_s)
        for each in touch.each
        for number in range(int(each.from_s / step_s), int(each.to_s / step_s) + 2)
    }


def _check_on_patch(  # noqa: PLR0913 - what a touch is checked with
    scene: SceneConfig,
    number: int,
    touch: TouchConfig,
    window: Window,
    path: dict[int, Pose],
    places_m: Float,
    pitch_m: float,
) -> None:
    """Raise ConfigError if the deepest contact of a touch would extend half a pitch over the electrodes."""
    half = np.array(window.half_m)
    low = places_m.min(axis=0) - 0.5 * pitch_m + half
    high = places_m.max(axis=0) + 0.5 * pitch_m - half
    if (low > high).any():
        size = 2e3 * half
        allowed = f"a contact that fits on {touch.patch!r}; this one is {size[0]:.3g} × {size[1]:.3g} mm"
        raise _error(scene, f"touches[{number}].body", touch.body, allowed)
    room = (
        f"x from {low[0]:.4g} to {high[0]:.4g}, y from {low[1]:.4g} to {high[1]:.4g} m on {touch.patch!r}, "
        "so that the contact stays on the patch"
    )
    for step, pose in path.items():
        place = np.array(pose.place_m)
        if ((place >= low - 1e-9) & (place <= high + 1e-9)).all():
            continue
        key, got = f"touches[{number}].at_m", list(touch.at_m)
        t = step * scene.step_s
        for j, motion in enumerate(touch.motions):
            if motion.kind in ("slide", "shear", "roll", "walk") and motion.from_s < t:
                name = "reach_m" if motion.kind == "walk" else "by_m"
                key, got = f"touches[{number}].motions[{j}].{name}", getattr(motion, name)
        shown = list(got) if isinstance(got, tuple) else got
        where = (
            "" if key.endswith("at_m") else f"; at {t:.3g} s the body is at [{place[0]:.4g}, {place[1]:.4g}]"
        )
        raise _error(scene, key, shown, room + where)


def _check_apart(
    scene: SceneConfig,
    late: tuple[int, TouchConfig, Window, dict[int, Pose]],
    early: tuple[int, TouchConfig, Window, dict[int, Pose]],
    layer: Layer,
) -> None:
    """Raise ConfigError if two touches come so close at some time that one would move the other's skin."""
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
            f"a place or time at which its contact stays {1e3 * gap:.3g} mm away from that of touches[{j}]; "
            f"at {number * scene.step_s:.3g} s it is {1e3 * float(np.hypot(*beyond)):.3g} mm away"
        )
        raise _error(scene, f"touches[{i}].at_m", list(touch.at_m), allowed)


def _error(scene: SceneConfig, key: str, got: object, allowed: str) -> ConfigError:
    return ConfigError(key, got, allowed, where=scene.where(key))
