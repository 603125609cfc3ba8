"""Define the state that the supervisor keeps for each node."""

from __future__ import annotations

import enum
import threading
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Final

from skinnode.host.remote_node import RemoteNode
from skinnode.host.retry_pause import Pause
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.layout import Float
from skinnode.process import clock

JOIN_DEADLINE_S: Final = 1.0
"""Time limit (s) for the first SDO response, and for the tare, once the node has sent a frame."""

LEAST_NS: Final = 300_000_000
"""Minimum time (ns) between two bring-ups of a node that restarts in a loop."""


class Phase(enum.StrEnum):
    """Phase of a supervised node; see :mod:`skinnode.host.supervisor`."""

    AWAITED = "awaited"
    JOINING = "joining"
    STARTING = "starting"
    RUNNING = "running"


@dataclass(frozen=True, slots=True)
class NodeStats:
    """Bring-up counters of a node."""

    phase: Phase
    rejoins: int
    """Number of successful bring-ups since the host finished starting."""
    failures: int
    """Number of failed bring-ups since the host finished starting."""
    baselines: int
    """Number of new baselines used by the solver."""
    complaint: str | None
    """Reason why the last bring-up failed; None if it succeeded."""


@dataclass(frozen=True, slots=True)
class Joined:
    """Result of a job that has brought up a node or read its baseline."""

    solver: ScanSolver | None
    withholdings: int


@dataclass(slots=True)
class Supervised:
    """State of one supervised node. Used only by the supervisor's thread."""

    remote: RemoteNode
    phase: Phase
    since_ns: int
    read_ns: int
    """Earliest monotonic time (ns) for the next read of the baseline."""
    job: Future[Joined | None] | None = None
    """Job in progress for the node. A job that reads only the error register returns None."""
    searching: Future[bool] | None = None
    abandon: threading.Event = field(default_factory=clock.event)
    """Event that aborts the running job."""
    pause: Pause = field(default_factory=Pause)
    not_before_ns: int = 0
    """End (monotonic time, ns) of the pause after a failed bring-up or an unexpected exception."""
    was_silent: bool = True
    """Whether the next frame from the node ends the pause, because the node was silent or refused."""
    begun_ns: int = 0
    """Start (monotonic time, ns) of the last bring-up."""
    defects: int = 0
    """Number of unexpected exceptions that the supervisor has already handled."""
    upset: bool = False
    """Whether supervising the node has raised an exception, leaving the node's state unknown."""
    probe_ns: int = 0
    search_ns: int = 0
    register_ns: int = 0
    mute_ns: int = 0
    unconfigured: bool = False
    """Whether a job has found that the node has lost its configuration."""
    rejoins: int = 0
    failures: int = 0
    baseline_ohm: Float | None = None
    """(U, K) baseline used by the solver, in ohms; None before the first bring-up."""
    announced: bool = False
    """Whether the node has announced a baseline that the solver is not using yet."""
    baselines: int = 0
    complaint: str | None = None
