"""What the doctor knows, as plain data: the checks see nothing else."""

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
    """How sure a finding is."""

    CERTAIN = "certain"
    """A node or a counter says so."""
    LIKELY = "likely"
    """The figures have hardly another cause."""
    POSSIBLE = "possible"
    """It may be as it should be: somebody has to look."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong."""

    area: str
    """bus, nodes, configuration, wires, baseline, timing or losses"""
    where: str
    what: str
    sure: Sure
    evidence: str
    advice: str


@dataclass(frozen=True, slots=True, eq=False)
class ScanFacts:
    """Scans of one patch as they came, T of them, U upper and K lower wires."""

    ratio: Float
    """(T, U, K) R/R0, NaN where there was no measurement."""
    n_open: Counts
    n_short: Counts
    n_over: Counts
    """(U, K) scans in which a crossing was open, shorted, out of range."""
    t_s: Float
    """(T,) when the last frame came, since the first scan."""
    latency_s: Float
    """(T,) from SYNC to the last frame, NaN where no SYNC was heard."""
    device_us: Counts
    """(T,) the node's clock, -1 where the summary was lost."""
    complete: NDArray[np.bool_]
    """(T,)"""
    step: float
    """A code as a share of R0."""
    told_noise: float
    """Relative, of the converter, as the hand file says."""
    stats: AssemblerStats

    @property
    def scans(self) -> int:
        return len(self.ratio)


@dataclass(frozen=True, slots=True, eq=False)
class PatchFacts:
    """One patch: what is wanted of it and what is there. None where it is not known."""

    name: str
    node_id: int
    wanted: PatchConfig | None = None
    layout_hash: int | None = None
    """The one that the hand file asks for."""
    inhibit_100us: int | None = None
    """Inhibit time that the host sets; None if it configures no node of this bus."""
    eds_problem: str = ""
    """Why the EDS of the hand file is not that of the patch; empty where it is, or where none is given."""
    found: FoundNode | None = None
    info: NodeInfo | None = None
    failure: str = ""
    """Why there is no ``info`` of a node that was found."""
    boot_ups: int = 0
    """Heard while listening."""
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
    """Why it does not open, or failed; empty where it is well."""
    link_state: str | None = None
    """Of the controller, as the kernel tells (ERROR-ACTIVE …)."""
    link_bitrate_bps: int | None = None
    seconds: float = 0.0
    """How long was listened."""
    frames: int = 0
    load: float = 0.0
    """Share of the bus that frames took, in the busiest second in which scans were waited for; in the last
    one where none could come."""
    error_frames: int = 0
    dropped: int = 0
    outages: int = 0
    foreign: Mapping[int, int] = field(default_factory=dict)
    """Frames by COB-ID that nothing explains."""
    unconfigured: tuple[LssAddress, ...] = ()
    strangers: tuple[FoundNode, ...] = ()
    """Nodes that are not in the hand."""
    period_s: float | None = None
    """Of SYNC, as the hand file says."""
    sync_s: Float = field(default_factory=lambda: np.empty(0))
    """When SYNCs were heard; not our own."""
    sync_counters: tuple[int, ...] = ()
    """As they came with them; 0 where there was none."""
    sync_ours: bool = False
    own_period_s: float = 0.0
    """Period of our own SYNC; 0 if another node sends it. Longer than ``period_s`` if a node that no host has
    configured needs longer for a scan."""
    active: bool = False
    """Whether nodes that do not run were to be started."""
    role: str = "master"
    """Of the host on this bus, as the hand file says."""
    nmt_commands: int = 0
    """NMT commands heard that a host of this hand does not send."""
    master_node_id: int | None = None
    """With which the host beats, as the hand file says."""
    master_beats_s: Float | None = None
    """When that was heard."""
    heartbeat_ms: int | None = None
    """As the hand file wants it."""
    patches: tuple[PatchFacts, ...] = ()

    @property
    def running(self) -> bool:
        """Whether somebody runs the hand."""
        return any(patch.found is not None and patch.found.state == "operational" for patch in self.patches)
