"""Scenes defined in files: rigid bodies press on a hand's patches, and slide, roll or turn while in contact.

::

    scene file -> tables (keys, checks) -> bind (touch_checks: is the touch possible on its patch?)
        -> PatchScene of each patch
    shapes, motions (body pose at a time) -> window (cells under the body) -> history (contact at each step)
        -> response (displacement of the electrodes) -> patch (state at any time) -> truth
    faults (checks with the hand) -> vcan_sim.fault_schedule

The contact mechanics are computed in :mod:`vcan_sim.contact`, which shares no code with the solvers. The skin
is undeformed before and after each touch. Each touch is computed at fixed time steps, always from its start.
The state at a given time therefore does not depend on which times are requested, or in which order.
"""

from vcan_sim.scenes.bind import bind_scene, load_scene
from vcan_sim.scenes.faults import schedule_of
from vcan_sim.scenes.patch import PatchScene
from vcan_sim.scenes.tables import (
    BodyConfig,
    FaultConfig,
    MotionConfig,
    SceneConfig,
    SkinConfig,
    TouchConfig,
    parse_scene,
    read_scene,
)
from vcan_sim.scenes.truth import BodyContact, PatchTruth

__all__ = [
    "BodyConfig",
    "BodyContact",
    "FaultConfig",
    "MotionConfig",
    "PatchScene",
    "PatchTruth",
    "SceneConfig",
    "SkinConfig",
    "TouchConfig",
    "bind_scene",
    "load_scene",
    "parse_scene",
    "read_scene",
    "schedule_of",
]
