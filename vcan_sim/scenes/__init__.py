"""Scenes from files: rigid bodies press on the patches of a hand, and slide, roll or turn on the skin.

::

    scene file -> tables (keys, checks) -> bind (touch_checks: is the touch possible on its patch?)
        -> PatchScene of each patch
    shapes, motions (pose of the body) -> window (cells under the body) -> history (contact at each step)
        -> response (displacement of the electrodes) -> patch (state at any time) -> truth
    faults (checked against the hand) -> vcan_sim.fault_schedule

:mod:`vcan_sim.contact`, which shares no code with the solvers, computes the contact mechanics. The skin is
undeformed before and after each touch. A touch is always computed from its start, at fixed time steps, so the
state at a given time does not depend on which times are requested or in which order.
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
