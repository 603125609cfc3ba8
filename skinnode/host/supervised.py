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
"""Maximum time (s) to wait for the SDO response or the tare of a node that has already sent a frame."""

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
    """Bring-up statistics of a node."""

    phase: Phase
    rejoins: int
    """Number of successful bring-ups since the host finished starting."""
    failures: int
    """Number of failed bring-ups since the host finished starting."""
    baselines: int
    """Number of times the solver has switched to a new baseline."""
    complaint: str | None
    """Reason why the last bring-up failed; None if that bring-up succeeded."""


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
    """Earliest monotonic time (ns) at which to read the node's baseline again."""
    job: Future[Joined | None] | None = None
    """Running job that communicates with the node. The job's result is None if the job reads only the error
    register.
    """
    searching: Future[bool] | None = None
    abandon: threading.Event = field(default_factory=clock.event)
    """Event that aborts the running job."""
    pause: Pause = field(default_factory=Pause)
    not_before_ns: int = 0
    """Monotonic time (ns) at which the pause after a failed bring-up or an unexpected exception ends."""
    was_silent: bool = True
    """Whether the pause ends at the node's next frame, because the node did not respond or was refused."""
    begun_ns: int = 0
    """Monotonic time (ns) at which the most recent bring-up started."""
    defects: int = 0
    """Number of the node's unexpected exceptions that the supervisor has already handled."""
    upset: bool = False
    """Whether the node's state is unknown because supervising the node raised an exception."""
    probe_ns: int = 0
    search_ns: int = 0
    register_ns: int = 0
    mute_ns: int = 0
    unconfigured: bool = False
    """Whether a job has detected that the node lost its configuration."""
    rejoins: int = 0
    failures: int = 0
    baseline_ohm: Float | None = None
    """(U, K) ohm: baseline used to solve the node's scans; None before the first bring-up."""
    announced: bool = False
    """Whether the node has announced a new baseline that the solver does not use yet."""
    baselines: int = 0
    complaint: str | None = None
