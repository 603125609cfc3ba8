"""State that the supervisor keeps for each node."""

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
"""Maximum time in s for a node that has sent any frame to send its first SDO response or to tare itself."""

LEAST_NS: Final = 300_000_000
"""Minimum time from one bring-up of a node to the next, for nodes that restart in a loop."""


class Phase(enum.StrEnum):
    """Phase of a node in the supervisor."""

    AWAITED = "awaited"
    JOINING = "joining"
    STARTING = "starting"
    RUNNING = "running"


@dataclass(frozen=True, slots=True)
class NodeStats:
    """The supervisor's statistics for a node."""

    phase: Phase
    rejoins: int
    """Number of bring-ups after the host's start that ended with the node running."""
    failures: int
    """Number of bring-ups after the host's start that failed."""
    baselines: int
    """Number of times that a new baseline came into use."""
    complaint: str | None
    """Why the last bring-up failed; None if it succeeded."""


@dataclass(frozen=True, slots=True)
class Joined:
    """Result of a job."""

    solver: ScanSolver | None
    withholdings: int


@dataclass(slots=True)
class Supervised:
    """State of one node. Used only by the supervisor's thread."""

    remote: RemoteNode
    phase: Phase
    since_ns: int
    read_ns: int
    """Earliest time for the next reading of the node's baseline."""
    job: Future[Joined | None] | None = None
    """Job that communicates with the node; its result is None if the job only reads the error register."""
    searching: Future[bool] | None = None
    abandon: threading.Event = field(default_factory=clock.event)
    """Set to stop the job."""
    pause: Pause = field(default_factory=Pause)
    not_before_ns: int = 0
    """End of the pause after a failed bring-up or a defect."""
    was_silent: bool = True
    """Whether the node was silent, so that any frame from it ends the pause."""
    begun_ns: int = 0
    """Start time of the newest bring-up."""
    defects: int = 0
    """Number of reported defects already handled."""
    upset: bool = False
    """Whether supervising the node raised an exception, so that its state is unknown."""
    probe_ns: int = 0
    search_ns: int = 0
    register_ns: int = 0
    mute_ns: int = 0
    unconfigured: bool = False
    """Whether a job found that the node has lost its configuration."""
    rejoins: int = 0
    failures: int = 0
    baseline_ohm: Float | None = None
    """Baseline with which the node's scans are solved; None before the first bring-up."""
    announced: bool = False
    """Whether the node announced a new baseline that is not in use yet."""
    baselines: int = 0
    complaint: str | None = None
