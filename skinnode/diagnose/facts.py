"""The facts of a bus and its patches, as plain data: the checks see nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from skinnode.canopen.lss import LssAddress
from skinnode.config import PatchConfig
from skinnode.diagnose.bus_listener import Emergency
from skinnode.diagnose.discovery import FoundNode
from skinnode.diagnose.node_info import NodeInfo
from skinnode.model.layout import Float
from skinnode.protocol.scan import AssemblerStats

Counts = NDArray[np.int64]


class Sure(StrEnum):
    """Certainty of a finding."""

    CERTAIN = "certain"
    """A node or a counter reports it."""
    LIKELY = "likely"
    """The figures hardly have another cause."""
    POSSIBLE = "possible"
    """It may be intended; a person must look."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault."""

    area: str
    """Area: bus, nodes, configuration, wires, baseline, timing or losses."""
    where: str
    what: str
    sure: Sure
    evidence: str
    advice: str


@dataclass(frozen=True, slots=True, eq=False)
class ScanFacts:
    """Captured scans of one patch: T scans, U upper wires, K lower wires."""

    ratio: Float
    """(T, U, K) R/R0; NaN where there is no measurement."""
    n_open: Counts
    n_short: Counts
    n_over: Counts
    """(U, K) number of scans in which a crossing was open, shorted, out of range."""
    t_s: Float
    """(T,) time of the last frame since the first scan, s."""
    latency_s: Float
    """(T,) time from SYNC to the last frame, s; NaN if no SYNC was heard."""
    device_us: Counts
    """(T,) clock of the node, µs; -1 if the summary was lost."""
    complete: NDArray[np.bool_]
    """(T,)"""
    step: float
    """One code as a share of R0."""
    stated_noise: float
    """Relative noise of the converter in the hand file."""
    stats: AssemblerStats

    @property
    def scans(self) -> int:
        """Number of scans."""
        return len(self.ratio)


@dataclass(frozen=True, slots=True, eq=False)
class PatchFacts:
    """One patch: its configuration and what was found; None if unknown."""

    name: str
    node_id: int
    wanted: PatchConfig | None = None
    layout_hash: int | None = None
    """Layout hash of the hand file."""
    inhibit_100us: int | None = None
    """Inhibit time that the host sets; None if it configures no node of this bus."""
    eds_problem: str = ""
    """Why the EDS of the hand file is not that of the patch; empty if it is, or none is given."""
    found: FoundNode | None = None
    info: NodeInfo | None = None
    failure: str = ""
    """Why ``info`` is missing although the node was found."""
    boot_ups: int = 0
    """Boot-up messages heard while listening."""
    emergencies: tuple[Emergency, ...] = ()
    scans: ScanFacts | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BusFacts:
    """One bus and the patches on it."""

    name: str
    interface: str
    channel: str
    bitrate_bps: int
    failure: str = ""
    """Why the bus does not open, or failed; empty if it works."""
    link_state: str | None = None
    """State of the controller in the kernel (ERROR-ACTIVE …)."""
    link_bitrate_bps: int | None = None
    seconds: float = 0.0
    """Time of listening."""
    frames: int = 0
    load: float = 0.0
    """Share of the bus taken by frames, in the busiest second of scans; without scans, in the last second."""
    error_frames: int = 0
    dropped: int = 0
    outages: int = 0
    foreign: Mapping[int, int] = field(default_factory=dict)
    """Number of unexplained frames by COB-ID."""
    unconfigured: tuple[LssAddress, ...] = ()
    strangers: tuple[FoundNode, ...] = ()
    """Nodes that are not in the hand file."""
    period_s: float | None = None
    """SYNC period in the hand file."""
    sync_s: Float = field(default_factory=lambda: np.empty(0))
    """Times of SYNCs heard, s; empty if the doctor sends them."""
    sync_counters: tuple[int, ...] = ()
    """Their counters; 0 if a SYNC has none."""
    sync_ours: bool = False
    own_period_s: float = 0.0
    """Period of the doctor's own SYNC; 0 if another node sends it. Longer than ``period_s`` if a node that
    no host has configured needs longer for a scan."""
    active: bool = False
    """Whether nodes that did not run were to be started."""
    role: str = "master"
    """Role of the host on this bus in the hand file."""
    nmt_commands: int = 0
    """NMT commands heard that a host of this hand does not send."""
    master_node_id: int | None = None
    """Node-ID of the host's heartbeat in the hand file."""
    master_beats_s: Float | None = None
    """Times at which that heartbeat was heard, s."""
    heartbeat_ms: int | None = None
    """Heartbeat period in the hand file."""
    patches: tuple[PatchFacts, ...] = ()

    @property
    def running(self) -> bool:
        """Whether a host runs the hand."""
        return any(patch.found is not None and patch.found.state == "operational" for patch in self.patches)
