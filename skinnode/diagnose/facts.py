"""Defines the facts about a bus and its patches as plain data, the only input of the checks."""

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
    """A node or a counter reports the fault."""
    LIKELY = "likely"
    """Hardly any other cause can explain the evidence."""
    POSSIBLE = "possible"
    """The condition may be intentional; the user must decide."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Fault found by a check."""

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
    """(T, U, K) R/R0; NaN for a crossing without a measurement."""
    n_open: Counts
    n_short: Counts
    n_over: Counts
    """(U, K) numbers of scans in which each crossing was open, shorted or out of range, respectively."""
    t_s: Float
    """(T,) time from the end of the first scan to the end of each scan, s."""
    latency_s: Float
    """(T,) time from SYNC to the last frame of the scan, s; NaN if no SYNC was received."""
    device_us: Counts
    """(T,) clock of the node, µs; -1 if the summary was lost."""
    complete: NDArray[np.bool_]
    """(T,) whether each scan is complete."""
    step: float
    """Size of one code step relative to R0."""
    stated_noise: float
    """Relative noise of the converter, from the hand file."""
    stats: AssemblerStats
    conversions: int | None = None
    """Number of scans whose conversion differs from the previous scan's; None if the patch does not count its
    conversions."""
    repeated: int = 0
    """Number of scans that repeat the conversion of the previous scan."""

    @property
    def scans(self) -> int:
        """Number of scans."""
        return len(self.ratio)


@dataclass(frozen=True, slots=True, eq=False)
class PatchFacts:
    """Configuration and observations of one patch; an observation is None if unknown."""

    name: str
    node_id: int
    wanted: PatchConfig | None = None
    layout_hash: int | None = None
    """Hash of the layout in the hand file."""
    inhibit_100us: int | None = None
    """Inhibit time that the host sets, in units of 100 µs; None if the host does not configure the nodes of
    this bus."""
    eds_problem: str = ""
    """Why the EDS in the hand file does not match the patch; empty if it matches or no EDS is given."""
    found: FoundNode | None = None
    info: NodeInfo | None = None
    failure: str = ""
    """Why ``info`` is missing although the node was found."""
    boot_ups: int = 0
    """Boot-up messages received while listening."""
    emergencies: tuple[Emergency, ...] = ()
    scans: ScanFacts | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BusFacts:
    """Facts about one bus and the patches on it."""

    name: str
    interface: str
    channel: str
    bitrate_bps: int
    failure: str = ""
    """Why the bus could not be opened or why it failed; empty if it works."""
    link_state: str | None = None
    """State of the CAN controller according to the kernel (ERROR-ACTIVE …)."""
    link_bitrate_bps: int | None = None
    seconds: float = 0.0
    """Listening time, s."""
    frames: int = 0
    load: float = 0.0
    """Bus load (fraction) in the busiest second of the capture, or in the last second if no scan arrived."""
    error_frames: int = 0
    dropped: int = 0
    outages: int = 0
    foreign: Mapping[int, int] = field(default_factory=dict)
    """Number of unexplained frames, keyed by COB-ID."""
    unconfigured: tuple[LssAddress, ...] = ()
    strangers: tuple[FoundNode, ...] = ()
    """Nodes that are not in the hand file."""
    period_s: float | None = None
    """SYNC period from the hand file, s."""
    sync_s: Float = field(default_factory=lambda: np.empty(0))
    """Times of the SYNCs received, s; empty if the doctor sends SYNC."""
    sync_counters: tuple[int, ...] = ()
    """Counters of the SYNCs received; 0 for a SYNC without a counter."""
    sync_ours: bool = False
    own_period_s: float = 0.0
    """Period of the SYNC that the doctor sends, s; 0 if another node sends SYNC. It is
    longer than ``period_s`` if an unconfigured node needs more time for a scan."""
    active: bool = False
    """Whether the doctor was allowed to start nodes that were not running."""
    role: str = "master"
    """Host's role on this bus, from the hand file."""
    nmt_commands: int = 0
    """Number of NMT commands received that a host of this hand would not send."""
    master_node_id: int | None = None
    """Node-ID in the host's heartbeat, from the hand file."""
    master_beats_s: Float | None = None
    """Times at which the host's heartbeat was received, s."""
    heartbeat_ms: int | None = None
    """Heartbeat period from the hand file, ms."""
    patches: tuple[PatchFacts, ...] = ()

    @property
    def running(self) -> bool:
        """Whether a host is running the hand."""
        return any(patch.found is not None and patch.found.state == "operational" for patch in self.patches)
