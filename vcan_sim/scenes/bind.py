"""Applies a scene to a hand: checks the touches and creates a :class:`PatchScene` for each patch."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from skinnode.config import HandConfig, PatchConfig
from skinnode.model.layout import PatchLayout
from vcan_sim.contact.layer import Layer
from vcan_sim.scenes.faults import schedule_of
from vcan_sim.scenes.history import History
from vcan_sim.scenes.patch import PatchScene
from vcan_sim.scenes.response import Electrodes
from vcan_sim.scenes.tables import SceneConfig, SkinConfig, TouchConfig, read_scene
from vcan_sim.scenes.touch_checks import check_apart, check_on_patch, error_at, path_of, window_of_touch
from vcan_sim.scenes.window import BodyKey, Window


def load_scene(path: Path | str, hand: HandConfig) -> SceneConfig:
    """Read a scene file, and check that a hand can play it.

    Args:
        path: Scene file.
        hand: Hand whose patches the scene touches.

    Raises:
        ConfigError: If the file cannot be read, is not a valid scene, or contains a touch or fault that is
            impossible on the hand. The message gives the file, line and column of the error.
    """
    scene = read_scene(path)
    bind_scene(scene, hand)
    schedule_of(scene, hand)
    return scene


def bind_scene(scene: SceneConfig, hand: HandConfig) -> dict[str, PatchScene]:
    """Return the scene of each patch in a hand, by patch name, including untouched patches.

    Args:
        scene: Scene of the hand.
        hand: Hand whose patches the scene touches.

    Raises:
        ConfigError: If a touch names an unknown patch, is too deep for the elastic layer, leaves the patch,
            or comes too close to another touch.
    """
    names = [patch.name for patch in hand.patches]
    for i, touch in enumerate(scene.touches):
        if touch.patch not in names:
            raise error_at(
                scene, f"touches[{i}].patch", touch.patch, f"a patch of the hand: {', '.join(names)}"
            )
    return {patch.name: _patch_scene(scene, hand, patch, i) for i, patch in enumerate(hand.patches)}


def layer_of(skin: SkinConfig, patch: PatchConfig, layout: PatchLayout) -> Layer:
    """Return the elastic layer of a patch.

    Values in the scene file override those in the hand file.

    Args:
        skin: The scene file's ``[skin]`` table.
        patch: The patch in the hand file.
        layout: Layout of the patch. The height of its upper electrodes is the default thickness.
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
    windows = {i: window_of_touch(scene, i, touch, layer, layout) for i, touch in touches}
    places = np.ascontiguousarray(layout.upper_m[..., :2].reshape(-1, 2))
    paths = {i: path_of(touch, scene.step_s) for i, touch in touches}
    for i, touch in touches:
        check_on_patch(scene, i, touch, windows[i], paths[i], places, layout.pitch_m)
        for j, other in touches:
            if j < i:
                check_apart(scene, (i, touch, windows[i], paths[i]), (j, other, windows[j], paths[j]), layer)
    if not touches:
        return PatchScene(layout, hand.simulation, number, scene.step_s, scene.repeat_s, ())
    histories = []
    for i, touch in touches:
        body = scene.body(touch.body)
        key = BodyKey(body.build())
        histories += [
            _history(each, key, body.friction, windows[i], scene.step_s, layer, layout) for each in touch.each
        ]
    return PatchScene(layout, hand.simulation, number, scene.step_s, scene.repeat_s, tuple(histories))


@functools.lru_cache(maxsize=16)
def _history(  # noqa: PLR0913 - all inputs of a touch
    touch: TouchConfig,
    body: BodyKey,
    friction: float,
    window: Window,
    step_s: float,
    layer: Layer,
    layout: PatchLayout,
) -> History:
    """Return the history of a touch, cached because a program's tests start the same scene many times."""
    places = np.ascontiguousarray(layout.upper_m[..., :2].reshape(-1, 2))
    electrodes = Electrodes.of(layer, places, float(np.median(layout.upper_m[..., 2])))
    return History(touch, body.shape, friction, window, step_s, electrodes)
