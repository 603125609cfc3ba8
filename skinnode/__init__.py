"""skinnode: robot skin on a CAN bus. Use ``import skinnode as sk`` and the names in ``__all__``.

Public names are imported on first use, which keeps ``import skinnode`` and every ``--help`` fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from skinnode.host import HandFrame, Host, RunningHand
    from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
    from skinnode.model.elastic import Rubber
    from skinnode.model.forward import jacobian, resistance_ohm
    from skinnode.model.frames import Contact, FieldFrame, ResistanceFrame, ScanStamp, SolveStats
    from skinnode.model.hand_contact import HandContact, Wrench
    from skinnode.model.layout import PatchLayout
    from skinnode.model.pose import Pose
    from skinnode.model.status import Status
    from skinnode.model.tolerances import Tolerances
    from skinnode.record import Recorder, replay
    from skinnode.remote import RemoteHand, connect, publish
    from skinnode.solve.operators.result import PointKind
    from skinnode.solve.operators.system import solve_system
    from skinnode.solve.options import PosteriorOptions, TrackerOptions
    from skinnode.solve.paths.path import PathResult, solve_path
    from skinnode.solve.paths.step_control import Adaptive, Periodic, Uniform
    from skinnode.solve.posterior.posterior import Posterior
    from skinnode.solve.tracker import Tracker

_HOME = {
    "HandContact": "skinnode.model.hand_contact",
    "HandFrame": "skinnode.host",
    "Host": "skinnode.host",
    "RunningHand": "skinnode.host",
    "PatchLayout": "skinnode.model.layout",
    "Rubber": "skinnode.model.elastic",
    "resistance_ohm": "skinnode.model.forward",
    "jacobian": "skinnode.model.forward",
    "Contact": "skinnode.model.frames",
    "DataFault": "skinnode.model.data_fault",
    "FaultKind": "skinnode.model.data_fault",
    "FaultyPart": "skinnode.model.data_fault",
    "FieldFrame": "skinnode.model.frames",
    "ResistanceFrame": "skinnode.model.frames",
    "ScanStamp": "skinnode.model.frames",
    "SolveStats": "skinnode.model.frames",
    "Pose": "skinnode.model.pose",
    "Status": "skinnode.model.status",
    "Tolerances": "skinnode.model.tolerances",
    "Wrench": "skinnode.model.hand_contact",
    "Adaptive": "skinnode.solve.paths.step_control",
    "Periodic": "skinnode.solve.paths.step_control",
    "Uniform": "skinnode.solve.paths.step_control",
    "Recorder": "skinnode.record",
    "replay": "skinnode.record",
    "RemoteHand": "skinnode.remote",
    "connect": "skinnode.remote",
    "publish": "skinnode.remote",
    "PathResult": "skinnode.solve.paths.path",
    "solve_path": "skinnode.solve.paths.path",
    "Posterior": "skinnode.solve.posterior.posterior",
    "PosteriorOptions": "skinnode.solve.options",
    "PointKind": "skinnode.solve.operators.result",
    "solve_system": "skinnode.solve.operators.system",
    "Tracker": "skinnode.solve.tracker",
    "TrackerOptions": "skinnode.solve.options",
}

__all__ = [
    "Adaptive",
    "Contact",
    "DataFault",
    "FaultKind",
    "FaultyPart",
    "FieldFrame",
    "HandContact",
    "HandFrame",
    "Host",
    "PatchLayout",
    "PathResult",
    "Periodic",
    "PointKind",
    "Pose",
    "Posterior",
    "PosteriorOptions",
    "Recorder",
    "RemoteHand",
    "ResistanceFrame",
    "Rubber",
    "RunningHand",
    "ScanStamp",
    "SolveStats",
    "Status",
    "Tolerances",
    "Tracker",
    "TrackerOptions",
    "Uniform",
    "Wrench",
    "__version__",
    "connect",
    "jacobian",
    "publish",
    "replay",
    "resistance_ohm",
    "solve_path",
    "solve_system",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'skinnode' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
