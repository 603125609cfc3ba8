"""Define the state that the supervisor stores for each node."""

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
"""Maximum time for a node that has sent any frame to respond by SDO, or to tare itself, s."""

LEAST_NS: Final = 300_000_000
"""Minimum time between two bring-ups of a node that restarts in a loop, ns."""


class Phase(enum.StrEnum):
    """Phase of a supervised node; see :mod:`skinnode.host.supervisor`."""

    AWAITED = "awaited"
    JOINING = "joining"
    STARTING = "starting"
    RUNNING = "running"


@dataclass(frozen=True, slots=True)
class NodeStats:
    """Bring-up statistics of a node."""

    phase: Phase
    rejoins: int
    """Number of bring-ups after the host's start that ended with the node running."""
    failures: int
    """Number of bring-ups after the host's start that failed."""
    baselines: int
    """Number of new baselines with which scans have been solved."""
    complaint: str | None
    """Reason why the last bring-up failed; None if it succeeded."""


@dataclass(frozen=True, slots=True)
class Joined:
    """Result of a job that brought up a node or read its baseline."""

    solver: ScanSolver | None
    withholdings: int


@dataclass(slots=True)
class Supervised:
    """State of one supervised node. Used only by the supervisor's thread."""

    remote: RemoteNode
    phase: Phase
    since_ns: int
    read_ns: int
    """Earliest monotonic time for the next reading of the node's baseline, ns."""
    job: Future[Joined | None] | None = None
    """Running job that communicates with the node; the result is None if the job only reads the error
    register."""
    searching: Future[bool] | None = None
    abandon: threading.Event = field(default_factory=clock.event)
    """Event that aborts the running job."""
    pause: Pause = field(default_factory=Pause)
    not_before_ns: int = 0
    """Monotonic time at which the pause after a failed bring-up or a defect ends, ns."""
    was_silent: bool = True
    """Whether any frame from the node ends the pause, because the node was silent or refused."""
    begun_ns: int = 0
    """Monotonic start time of the most recent bring-up, ns."""
    defects: int = 0
    """Number of the node's reported defects that have been handled."""
    upset: bool = False
    """Whether supervising the node raised an exception, so that its state is unknown."""
    probe_ns: int = 0
    search_ns: int = 0
    register_ns: int = 0
    mute_ns: int = 0
    unconfigured: bool = False
    """Whether a job has detected that the node lost its configuration."""
    rejoins: int = 0
    failures: int = 0
    baseline_ohm: Float | None = None
    """(U, K) ohm: baseline with which the node's scans are solved; None before the first bring-up."""
    announced: bool = False
    """Whether the node has announced a new baseline with which scans are not yet solved."""
    baselines: int = 0
    complaint: str | None = None
