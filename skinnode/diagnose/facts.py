"""Data classes for the facts about a bus and its patches. The checks use no other input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from skinnode.canopen.lss import LssAddress
from skinnode.config import MAX_BUS_LOAD, PatchConfig
from skinnode.diagnose.bus_listener import Emergency
from skinnode.diagnose.discovery import FoundNode
from skinnode.diagnose.node_info import NodeInfo
from skinnode.model.layout import Float
from skinnode.protocol.scan import AssemblerStats

Counts = NDArray[np.int64]


class Sure(StrEnum):
    """Certainty of a finding."""

    CERTAIN = "certain"
    """A node or a counter reports the fault directly."""
    LIKELY = "likely"
    """There is hardly any other explanation for the evidence."""
    POSSIBLE = "possible"
    """The condition may be intended; only the user can tell."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Fault found by a check."""

    area: str
    """Area of the check: bus, nodes, configuration, wires, baseline, timing or losses."""
    where: str
    what: str
    sure: Sure
    evidence: str
    advice: str


@dataclass(frozen=True, slots=True, eq=False)
class ScanFacts:
    """T captured scans of a patch with U upper and K lower wires."""

    ratio: Float
    """(T, U, K) R/R0; NaN where there is no valid code."""
    n_open: Counts
    n_short: Counts
    n_over: Counts
    """(U, K) number of scans in which each crossing was open, shorted or out of range, respectively."""
    t_s: Float
    """(T,) reception time of the last frame of each scan, relative to the first scan, in s."""
    latency_s: Float
    """(T,) time from SYNC to the last frame of the scan, in s; NaN if the SYNC was not received."""
    device_us: Counts
    """(T,) time of the scan on the node's clock, in µs; -1 if the summary was lost."""
    complete: NDArray[np.bool_]
    """(T,) mask of the complete scans."""
    step: float
    """Size of one code step relative to R0."""
    stated_noise: float
    """Relative noise of the converter, according to the hand file."""
    stats: AssemblerStats
    conversions: int | None = None
    """Number of scans with a new conversion since the previous scan; None if the patch does not count its
    conversions."""
    repeated: int = 0
    """Number of scans without a new conversion since the previous scan."""

    @property
    def scans(self) -> int:
        """Number of scans."""
        return len(self.ratio)


@dataclass(frozen=True, slots=True, eq=False)
class PatchFacts:
    """Configured and observed properties of one patch; None stands for an unknown value."""

    name: str
    node_id: int
    wanted: PatchConfig | None = None
    layout_hash: int | None = None
    """Hash of the layout in the hand file."""
    inhibit_100us: int | None = None
    """Inhibit time that the host sets, in units of 100 µs; None if the host does not configure the nodes on
    the bus."""
    eds_problem: str = ""
    """Difference between the EDS and the patch in the hand file; empty if they match or no EDS is given."""
    found: FoundNode | None = None
    info: NodeInfo | None = None
    failure: str = ""
    """Reason why ``info`` is missing although the node was found."""
    boot_ups: int = 0
    """Number of boot-up messages received."""
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
    """Reason why the bus could not be opened or later failed; empty if it works."""
    link_state: str | None = None
    """State of the CAN controller reported by the kernel, such as ``ERROR-ACTIVE``."""
    link_bitrate_bps: int | None = None
    seconds: float = 0.0
    """Listening time, in s."""
    frames: int = 0
    load: float = 0.0
    """Bus load (fraction) in the busiest second of the capture, or in the last second if nothing was
    captured."""
    max_load: float = MAX_BUS_LOAD
    """Maximum planned bus load (fraction) from the hand file."""
    error_frames: int = 0
    dropped: int = 0
    outages: int = 0
    foreign: Mapping[int, int] = field(default_factory=dict)
    """Number of frames of unknown origin, by COB-ID."""
    unconfigured: tuple[LssAddress, ...] = ()
    strangers: tuple[FoundNode, ...] = ()
    """Nodes that are not in the hand file."""
    period_s: float | None = None
    """SYNC period from the hand file, in s."""
    sync_s: Float = field(default_factory=lambda: np.empty(0))
    """Reception times of the SYNCs, in s; empty if the doctor sent SYNC."""
    sync_counters: tuple[int, ...] = ()
    """Counters of the SYNCs received; 0 for a SYNC without a counter."""
    sync_ours: bool = False
    own_period_s: float = 0.0
    """SYNC period of the doctor, in s; 0 if it sent no SYNC. The period is longer than ``period_s`` if a node
    that no host has configured needs more time for a scan."""
    active: bool = False
    """Whether the doctor was allowed to start nodes that were not running."""
    role: str = "master"
    """Host's role on this bus, from the hand file."""
    nmt_commands: int = 0
    """Number of received NMT commands that this hand's host would not send."""
    master_node_id: int | None = None
    """Node-ID of the host's own heartbeat, from the hand file; None if the host sends none."""
    master_beats_s: Float | None = None
    """Reception times of the host's heartbeat, in s."""
    heartbeat_ms: int | None = None
    """Heartbeat period from the hand file, in ms."""
    patches: tuple[PatchFacts, ...] = ()

    @property
    def running(self) -> bool:
        """Whether a host is running the hand."""
        return any(patch.found is not None and patch.found.state == "operational" for patch in self.patches)
